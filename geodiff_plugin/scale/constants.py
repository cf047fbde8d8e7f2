"""Scale constants shared by reference implementations and kernels; others are next to their function."""

from __future__ import annotations

# The metric map.

#: Half-width of the smooth floor, in units of the relative map (range about [0, 1]). It is so small that a
#: street from 6 to 330 m gains a third of a metre at its nearest point and nothing elsewhere.
FLOOR_EPS = 0.001
#: Minimum scale and shift of a range: a flat map is valid, but a softplus cannot reach 0.
MIN_SHIFT_FRACTION = 1e-4
#: Value of the parameter ``positive`` that squares raw values instead of taking the softplus.
SQUARE = "square"
#: Spaces supported by the kernels, with their index there; other spaces use the reference.
KERNEL_FORMS = {"depth": 0, "disparity": 1, "log": 2, "log1p": 3, "sqrt_disparity": 4}

# The search by points or reliable matches.

#: Number of candidates of near, and of far: 1128 pairs.
BASIN_CANDIDATES = 48
#: Factor by which the candidates extend beyond the range of the points.
BASIN_RADIUS = 4.0
#: Width of the Cauchy cost in units of the points, about the error of a prior.
BASIN_CAUCHY = 32.0
#: Factor within which the current state's cost must be of the best for the state to be kept; a new state
#: restarts scale and shift.
BASIN_KEEP = 1.05

# The fit to matches.

#: Number of reweighted Gauss-Newton steps on near and far, fixed so that the GPU never has to synchronize.
FIT_ITERATIONS = 12
#: Standard deviation of a match of confidence .96, planes.
FIT_NOISE = 0.5
#: Minimum standard deviation of the map's residuals, log depth.
FIT_FLOOR = 4e-3
#: Width of the Cauchy weight, in combined standard deviations of match and map.
FIT_CAUCHY = 2.0
#: Maximum change of near in the fit, as a log factor; it keeps the fit in its basin.
NEAR_FACTOR = 1.4
#: Maximum change of far in the fit, as a log factor.
FAR_FACTOR = 0.7
#: Doubt, ``1 - confidence``, of a match with the standard deviation ``FIT_NOISE``. Variance is proportional
#: to doubt, as measured on pairs with ground truth.
REFERENCE_DOUBT = 0.04
#: Minimum doubt, as a fraction of the reference.
MIN_DOUBT = 0.16
#: Maximum ratio of near to far: an empty range has no scale.
FULLEST = 0.98

# The search in a cost volume.

#: Cost at which a pixel counts as an outlier: occluded, a reflection, or wrong in the prior.
COST_CLAMP = 0.35
#: Number of values of near, and of far, in the coarse grid: 1128 pairs.
COARSE_GRID = 48
#: Number of values of near, and of far, in each of the finer grids around the best pair.
FINE_GRIDS = (13, 13)
#: Maximum excess over the best cost for which the current state is kept; a new state restarts scale and
#: shift.
KEEP_MARGIN = 2e-3

# Quantiles.

#: Maximum number of values that are sorted for a quantile.
MAX_SORTED = 20_000
