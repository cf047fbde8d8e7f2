"""``Member``: what act 2 hands to act 3 of one member of the ensemble of one image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.scale.space import AffineState, MetricMap


@dataclass(frozen=True)
class Member:
    """The map of one member, how it was scaled, and what was found out about its prior; a batch of one.

    What was not measured is ``None``.
    """

    metric: MetricMap
    affine: AffineState  # (1,) each
    relative: Tensor  # (1, 1, h, w) map of the final latent, on the processing grid
    near_m: Tensor  # (1, 1, 1, 1) metres, the nearest pixel of its map, which resampling may overshoot
    far_m: Tensor  # (1, 1, 1, 1) metres, the farthest
    reflection_weight: Tensor | None  # (1, 1, h, w), factor on the confidence of matches, 0 for reflections
    error: Tensor | None  # (1, 1, 1, 1) of the prior in log depth, where it is valid
    valid: Tensor | None  # (1, 1, h, w) bool, where the prior gives a depth; ``None`` for everywhere
    rank_correlation: Tensor | None  # (1,) of the prior's first map with matches or points; NaN for too few
    on_edge: Tensor | None  # (1,) bool, whether the search for the scale ended on the edge of its range
    prior_depth_m: Tensor | None  # (1, 1, h, w) metres, a metric prior's own first estimate

    @property
    def depth_m(self) -> Tensor:
        """``(1, 1, h, w)`` metres on the processing grid."""
        return self.metric(self.relative, self.affine)
