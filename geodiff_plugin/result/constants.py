"""Constants of the result shared by reference implementations and kernels."""

from __future__ import annotations

from geodiff_plugin.algorithm.constants import HALF_WINDOW

# Weighted median filtering.

#: Brightness difference at which a neighbour's weight falls to 1/e.
BRIGHTNESS = 0.1
#: Window offsets of the values, in samples: every second one, which is as good as all of them.
WINDOW = [
    (v, u)
    for v in range(-HALF_WINDOW, HALF_WINDOW + 1)
    for u in range(-HALF_WINDOW, HALF_WINDOW + 1)
    if (v + u) % 2 == 0
]
#: Pixels between samples of the window, which must extend beyond the ragged border of the sweep's matches.
SPACING = 4
#: Weight of a row match or half-occlusion relative to a certain match of the sweep. Rows place edges on a
#: finer grid.
ROW_WEIGHT = 1.5
#: Weight of a gap filled from the farther surface, which is a guess.
FILLED_WEIGHT = 0.5
#: Prior error above which the map's own value has its minimum weight.
WEAK_PRIOR = 0.2
#: Minimum weight of the map's value, as a fraction of a window full of certain matches. It grows with the
#: inverse cube of a smaller error, since a good prior has accurate edges.
MAP_VOTE = 0.03
#: Difference between match and map, in prior errors, at which a match has a quarter of its weight.
OUTLIER_ERRORS = 2.0
#: Maximum prior error used for that difference; with a useless map every wrong match would count.
MAX_VOTE_ERROR = 0.1
#: Radius in which a depth edge of the map is searched, pixels.
NEAR_RADIUS = 4
#: Radius beyond which the edge must not continue, pixels; otherwise it is the slope of a wide surface.
WIDE_RADIUS = 12
#: Minimum depth edge in log depth.
MIN_EDGE = 0.1
#: Maximum ratio of the depth range within the larger radius to that within the smaller one.
MAX_RISE = 2.2
#: Width of a sharp edge, pixels.
STEP_PX = 2
#: Exponent with which a map with soft edges raises its prior's error at edges.
SOFTNESS_POWER = 4.0
#: Maximum prior error after that: soft edges do not make the matches better.
MAX_SOFT_ERROR = 0.14
#: Minimum prior error, to avoid division by zero.
MIN_ERROR = 1e-3
#: Minimum depth before taking the logarithm, metres.
MIN_DEPTH_M = 1e-9
#: Distance from the weighted median, pixels, at which the weight of a value falls to a quarter.
NEAR_PX = 1.0
#: Bisection steps of the weighted median.
ROUNDS = 7
#: Decay of a value's weight with its squared distance, in pixels of the filter's grid, for upsampling.
DISTANCE_DECAY = 2.0
#: Window size of the final median filter, pixels of the filter's grid.
MEDIAN = 5

# Confidence.

#: Log-odds from logistic regression on pairs with ground truth, every pair with equal weight (``python -m
#: tests.benchmarks.confidence`` refits them): constant, certainty, closeness, stability, evenness, and
#: relative ensemble spread (set by hand: 10 % quarter the odds).
DEPTH_LOG_ODDS = (-2.95, 0.36, 1.04, 0.94, 0.36, -15.0)
#: Lower bound of the remaining error, below which differences do not matter.
MIN_REMAINING_ERROR = 0.0005
#: Upper bound of the remaining error.
MAX_REMAINING_ERROR = 0.05
#: Half width in pixels, on the grid of the matches, of the window that averages residual and change.
FEATURE_RADIUS = 15
#: Lower bound of the match residual, planes.
MIN_RESIDUAL = 0.5
#: Upper bound of the match residual, planes.
MAX_RESIDUAL = 10.0
#: Mean confidence of pseudo-matches with the maximum residual that are added to a window: a few matches may
#: be close by chance, and without matches none is close.
PSEUDO_CONFIDENCE = 0.02
#: Lower bound of the change of log depth.
MIN_CHANGE = 0.005
#: Upper bound of the change of log depth.
MAX_CHANGE = 0.2
#: Half width in pixels, on the grid of the matches, of the window that measures the depth discontinuity.
#: Errors at depth edges and in half-occlusions extend over a few pixels.
DISCONTINUITY_RADIUS = 4
#: Lower bound of the range of log depth in that window; surfaces have slopes.
MIN_DISCONTINUITY = 0.01
#: Upper bound of the range of log depth.
MAX_DISCONTINUITY = 0.5
#: Data support at which the prior's error is half known. It is measured where there are matches, and a prior
#: that is right on the street may be wrong on the trees above it.
HALF_SUPPORT = 0.1

# Planar regularization.

#: Weight of a slope without data support. All slopes count a little, since a wall without matches has no
#: others.
MIN_SLOPE_WEIGHT = 0.01
#: Weight of the smoothed slopes relative to the values.
SLOPES = 40.0
#: Weight of a value without data support, for a prior of ``WEAK_PRIOR`` or worse; it preserves wide shapes.
MIN_VALUE_WEIGHT = 0.015
#: Maximum weight of a value, which keeps the depth unchanged.
MAX_VALUE_WEIGHT = 1e3
#: Minimum inverse depth, about 1 on average, for relative changes, since depth is nearly unbounded.
MIN_INVERSE = 1e-3
