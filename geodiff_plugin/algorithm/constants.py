"""Constants shared by reference implementations and kernels; others are defined next to their function."""

from __future__ import annotations

# Solver of smooth fields.

#: Maximum length of the coarsest grid's shorter side, pixels.
COARSEST_SIDE = 24
#: Conjugate-gradient steps on the coarsest grid, enough for a nearly exact solution.
COARSEST_STEPS = 80

# Match fitting.

#: Longer side in pixels of the grid for which ``smoothness``, ``IMAGE_EDGE`` and ``DEPTH_EDGE`` are defined.
#: They are rescaled on other grids, so that a match affects the same fraction of the image.
REFERENCE_SIDE = 512.0
#: Error of the prior for which ``smoothness`` and ``TIKHONOV`` are defined.
REFERENCE_ERROR = 0.05
#: Exponent with which smoothness and Tikhonov weight fall with the prior's error: the map of a weak prior
#: yields to its matches.
STIFFNESS_POWER = 4.0
#: Minimum smoothness: even with a useless prior, a match still affects its neighbours.
MIN_SMOOTHNESS = 0.03
#: Maximum smoothness: even with an exact prior, the map can still change over wide regions.
MAX_SMOOTHNESS = 100.0
#: Weight of the squared change, so that pixels far from every match keep their depth.
TIKHONOV = 0.015
#: Minimum Tikhonov weight in the last pass; with 0 the change far from matches would be undetermined.
MIN_TIKHONOV = 5e-4
#: Maximum Tikhonov weight; a larger one would reduce the change at the matches themselves.
MAX_TIKHONOV = 0.03
#: Tikhonov weight of a map with its own scale, relative to a match with the same error. It is below 1,
#: because neighbouring matches have similar errors, and so has the map in neighbouring pixels.
OWN_DEPTH_WEIGHT = 0.2
#: Number of passes of a fit. Smoothness falls geometrically from a broad value to the one for the prior's
#: error.
PASSES = 3
#: Minimum smoothness of the first pass, which changes whole regions.
BROAD_SMOOTHNESS = 50.0
#: Minimum Tikhonov weight of the first pass, low enough to change regions far from any match.
BROAD_TIKHONOV = 1e-4
#: Minimum error assumed for a prior, in log depth: matches cannot measure a smaller one.
MIN_PRIOR_ERROR = 0.01
#: Maximum error assumed for a prior, in log depth, as for a useless one.
MAX_PRIOR_ERROR = 0.5
#: Brightness step across which affinities fall to 1/e.
IMAGE_EDGE = 0.1
#: Log-depth step across which affinities fall to 1/e.
DEPTH_EDGE = 0.1
#: Minimum affinity across any edge, as a fraction of the smoothness.
MIN_AFFINITY = 1e-3
#: Log-depth step that counts as an edge.
EDGE_STEP = 0.3
#: Prior error above which ``EDGE_STEP`` grows with the error's third power, since such a prior's edges are
#: misplaced.
EDGE_ERROR = 0.11
#: Quantile of the correct matches' residuals that measures the prior's error. The median would miss a prior
#: that puts a fifth of the scene on a wrong surface.
MATCHED_FRACTION = 0.8
#: The same quantile of the absolute value of a standard normal variable, used as the divisor.
NORMAL_QUANTILE = 1.2816

# Edge sharpening.

#: Samples of a window on each side of its centre.
HALF_WINDOW = 2
#: Standard deviation of a neighbour's Gaussian weight, samples; the window's border still contributes.
WINDOW_SIGMA = 1.5
#: Distance from a ramp to the surfaces on both sides, in pixels of the prior's grid.
SURFACE_DISTANCE = 3
#: Minimum relative step in inverse depth from a ramp pixel to each of two opposite neighbours.
MIN_STEP = 0.02
#: Minimum ratio of a ramp's slope to the slopes of the surfaces on both sides.
MIN_STEEPNESS = 2.0
#: Slope in log depth at which a ramp pixel's neighbour has half the weight.
SLOPE = 0.04
#: Brightness difference at which a neighbour's weight at a ramp falls to 1/e.
RAMP_BRIGHTNESS = 0.12
