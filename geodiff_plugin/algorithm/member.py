"""``Member``: result of phase 2 for one ensemble member of one image, used by phase 3."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import MetricMap


@dataclass(frozen=True)
class Member:
    """The map of one ensemble member, its scale, and measurements of its prior; a batch of one.

    Values that were not measured are ``None``.
    """

    metric: MetricMap
    affine: AffineState  # (1,) each
    relative: Tensor  # (1, 1, h, w) map of the final latent, on the processing grid
    near_m: Tensor  # (1, 1, 1, 1) metres, nearest pixel of the map; resampling may overshoot it
    far_m: Tensor  # (1, 1, 1, 1) metres, farthest pixel
    match_weight: Tensor | None  # (1, 1, h, w) factor on the confidence of matches, 0 for reflections
    error: Tensor | None  # (1, 1, 1, 1) or (1, 1, h, w) error of the prior in log depth, where it is valid
    valid: Tensor | None  # (1, 1, h, w) bool, where the prior gives a depth; ``None``: everywhere
    rank_correlation: Tensor | None  # (1,) of the prior's first map with matches or points; NaN for too few
    on_edge: Tensor | None  # (1,) bool, whether the scale search ended at the edge of its range
    prior_depth_m: Tensor | None  # (1, 1, h, w) metres, first estimate of a metric prior
    own_scale: Tensor | None = None  # (1, 1, 1, 1) 1 if the map keeps its own scale, else 0
    certainty: Tensor | None = None  # (1, 1, h, w) of the right period on repeated patterns, in [0, 1]

    @property
    def depth_m(self) -> Tensor:
        """Metric depth ``(1, 1, h, w)`` on the processing grid."""
        return self.metric(self.relative, self.affine)
