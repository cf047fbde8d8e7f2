"""Matching constants shared by reference implementations and kernels; others are next to their function."""

from __future__ import annotations

from geodiff_plugin.matching.census import COST_LEVELS

# Aggregation.

#: Penalty of a step of one plane between neighbouring pixels, relative to the maximum matching cost.
STEP_PENALTY = 0.15
#: Penalty of a step of one plane in levels.
STEP_LEVELS = round(COST_LEVELS * STEP_PENALTY)
#: Penalty of any larger step where the image is uniform.
JUMP_PENALTY = 1.2
#: Brightness difference that halves the penalty of a larger step: depth edges often are image edges.
JUMP_CONTRAST = 0.1
#: Steps (rows, columns) of the paths, each used in both directions: vertical and horizontal.
AXES = ((1, 0), (0, 1))
#: Number of aggregation paths.
PATHS = 2 * len(AXES)

# Winner selection.

#: Larger than any sum over the paths; marks a plane that must not win.
NEVER = 20_000
#: Cost on planes where no right view sees the pixel, as for unrelated texture: neither good nor bad.
UNSEEN_LEVEL = 78
#: Packs a path sum and its plane into one integer, so that a single minimum finds both.
PACKED_PLANES = 1 << 12
#: Planes on both sides of the winner that define its sharpness: wider than the minimum of textured pixels.
NEIGHBOUR_PLANES = 4

# Evidence of right views.

#: Log-odds that a checked match is correct, linear in its features, from logistic regression on pairs with
#: ground truth (``python -m tests.benchmarks.confidence`` refits them).
LOG_ODDS = (5.8, 0.8, -5.9, -0.62)
#: Maximum difference in planes at which matches of two views agree.
AGREEMENT_PLANES = 1.5
#: Half width in pixels of the window in which a match's mean cost must be below the mean plane's by
#: ``MIN_CONTRAST`` for full confidence. Otherwise aggregation would carry matches across textureless walls.
CONTRAST_RADIUS = 15
#: Minimum contrast for full confidence, relative to the maximum cost.
MIN_CONTRAST = 0.03
#: Doubt, one minus the probability of a match, at which its standard deviation is one plane. On pairs with
#: ground truth the error of matches grows with the square root of the doubt.
DOUBT_OF_A_PLANE = 0.04
#: Window mean of the sharpness below which the deviation grows in inverse proportion: if neighbouring planes
#: have similar costs, noise selects the winner.
MIN_SHARPNESS = 0.1
#: Maximum factor by which low sharpness increases the deviation.
MAX_BLUR = 100.0
#: Row spacing of the right view's winners: every second row is matched.
EVERY_ROW = 2

# Data support by the matches in a window.

#: Half width in pixels of the window that averages the precision of matches, equal to the contrast's.
KNOWN_RADIUS = CONTRAST_RADIUS
#: Mean precision, in 1 / planes squared, at which the matches of a window determine the depth fully.
ENOUGH_KNOWN = 0.3
#: Minimum deviation of a match, in planes: differences between finer subplane positions are chance.
MIN_DEVIATION = 0.5
#: Number of planes from infinity below which an error of one plane is such a large fraction of the inverse
#: depth that matches must be more precise than ``ENOUGH_KNOWN``, in inverse proportion to that number.
FAR_PLANES = 50.0
#: Confidence in a half-occlusion whose surrounding matches determine the depth. It assumes that the farther
#: surface continues, and on a textureless wall the end of the strip is uncertain as well.
OCCLUDED_CONFIDENCE = 0.8
#: Minimum confidence of a match in a half-occlusion that is kept.
MIN_KEPT_CONFIDENCE = 0.05

# Reflections.

#: Minimum distance of a reflection behind the prior, in standard deviations of the matches around the prior's
#: log depth. With a lower value, a wall that the prior misses would be rejected.
SPREADS = 3.0
#: Minimum distance of a reflection behind the prior, in log depth.
MIN_DISTANCE = 0.2
#: Multiple of that distance at which a match's weight has fallen to 0.
MULTIPLE = 1.6
#: Minimum confidence of matches that measure the standard deviation.
SPREAD_CONFIDENCE = 0.3
#: Quantile of the distances that measures the standard deviation. The median would not notice that nearly
#: half of the scene is on a wrong surface.
SPREAD_FRACTION = 0.6
#: The same quantile of the absolute value of a standard normal variable, used as the divisor.
NORMAL_QUANTILE = 0.8416
#: Upper bound of differences in log depth.
LARGEST = 1.5
