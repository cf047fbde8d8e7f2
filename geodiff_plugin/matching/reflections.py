"""Rejects reflections, which matching places behind the mirror, using the prior's depth."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin._internal.statistics import MAX_SORTED
from geodiff_plugin.matching.constants import (
    LARGEST,
    MIN_DISTANCE,
    MULTIPLE,
    NORMAL_QUANTILE,
    SPREAD_CONFIDENCE,
    SPREAD_FRACTION,
    SPREADS,
)
from geodiff_plugin.matching.matches import Matches

#: Half side of the window over which matches must agree, relative to the longer image side. With a smaller
#: one, openings that the prior misses would be rejected as reflections.
REGION = 0.08


@torch.no_grad()
def reject_reflections(matches: Matches, depth_m: Tensor) -> Tensor:
    """Compute the remaining fraction ``(B, 1, H, W)`` of each match, given the prior's first scaled depth.

    One-sided: reflections and objects behind glass are behind the surface, never in front of it. A prior with
    a 5 % error can detect reflections, one with a 30 % error cannot.
    """
    return _remaining(matches, depth_m, max(1, round(REGION * max(depth_m.shape[-2:]))))


@has_kernel(
    "matching.kernels.reflections.remaining",
    when=lambda matches, depth_m, radius: depth_m.numel() < MAX_SORTED,
)
def _remaining(matches: Matches, depth_m: Tensor, radius: int) -> Tensor:
    """Compute ``reject_reflections`` with windows of this half width, pixels."""
    weight = matches.confidence.float()
    behind = -(matches.inverse_depth * depth_m).clamp_min(1e-6).log().clamp(-LARGEST, LARGEST)
    counted = torch.where(weight > SPREAD_CONFIDENCE, behind, torch.full_like(behind, torch.nan)).flatten(1)
    middle = counted.nanmedian(1, keepdim=True).values
    deviations = (counted - middle).abs()[:, :: 1 + counted.numel() // MAX_SORTED]
    spread = deviations.nanquantile(SPREAD_FRACTION, 1) / NORMAL_QUANTILE
    min_distance = (SPREADS * spread.nan_to_num(LARGEST)).clamp_min(MIN_DISTANCE)[:, None, None, None]
    behind_in_region, in_region = _window_sum(torch.cat([behind * weight, weight], 1), radius).chunk(2, 1)
    region = behind_in_region / in_region.clamp_min(1.0)
    rejected = ((torch.minimum(region, behind) / min_distance - 1.0) / (MULTIPLE - 1.0)).clamp(0.0, 1.0)
    return (1.0 - rejected).contiguous()  # the sums are column-major, which all later operations would copy


def _window_sum(x: Tensor, radius: int) -> Tensor:
    for _ in range(2):  # along rows, then along columns
        until = F.pad(F.pad(x.cumsum(-1), (0, radius, 0, 0), mode="replicate"), (radius + 1, 0))
        x = (until[..., 2 * radius + 1 :] - until[..., : -2 * radius - 1]).mT
    return x
