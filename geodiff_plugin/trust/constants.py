"""Define constants that several checks and the kernels use."""

from __future__ import annotations

#: Minimum number of matches required for any conclusion about the depths of the scene.
MIN_MATCHES = 40
#: Quantiles of inverse depth that define the depth range of a scene.
RANGE_QUANTILES = (0.05, 0.95)
#: Hint for confirming lengths that look too large.
STATE_RANGE = (
    "If the scene really is that far away, set its depth range to confirm it (depth_range, --near, --far)."
)
