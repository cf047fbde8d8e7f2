"""Rejects matches that lie behind the prior's depth over a region: mirrors and glass.

Data flow: matches + metric depth of the prior's first estimate
    -> share of each match's confidence that remains.
Paper: S5.2 (transparent and mirroring surfaces are where a second view misleads and the prior knows).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.matching.matches import Matches

__all__ = ["reject_reflections"]

#: Half the side of the window over which matches must agree, in image sides; with a smaller one, gaps that
#: the prior misses would be taken for reflections.
REGION = 0.08
#: How far behind the prior a reflection lies: in spreads of the matches around the prior's log depth, and at
#: least, in log depth; from there to a multiple of it, a match's weight falls to nothing.
SPREADS, LEAST_DISTANCE, MULTIPLE = 2.0, 0.2, 1.6
#: Confidence above which a match counts in that spread, and the least spread that is assumed, in log depth.
SPREAD_CONFIDENCE, LEAST_SPREAD = 0.3, 0.05
#: Larger differences in log depth count as this one.
LARGEST = 1.5


@torch.no_grad()
def reject_reflections(matches: Matches, depth_m: Tensor) -> Tensor:
    """What remains of each match, given the depth that the prior saw before any match moved it.

    One-sided: a reflection and what is seen through glass lie behind the surface, never before it. A prior
    that is right to 5 % can name a reflection, one that errs by 30 % cannot.

    Args:
        matches: of a chunk of samples, ``(B, 1, H, W)``.
        depth_m: ``(B, 1, H, W)`` metres, > 0, the prior's first estimate with the search's scale.

    Returns:
        ``(B, 1, H, W)`` in [0, 1]; 1 where a match, or the region around it, is not behind the prior by more
        than chance.
    """
    weight = matches.confidence.float()
    behind = -(matches.inverse_depth * depth_m).clamp_min(1e-6).log().clamp(-LARGEST, LARGEST)
    counted = torch.where(weight > SPREAD_CONFIDENCE, behind, torch.full_like(behind, torch.nan)).flatten(1)
    middle = counted.nanmedian(1, keepdim=True).values
    spread = 1.4826 * (counted - middle).abs().nanmedian(1).values
    spread = spread.nan_to_num(LARGEST).clamp_min(LEAST_SPREAD)
    least = (SPREADS * spread).clamp_min(LEAST_DISTANCE)[:, None, None, None]
    radius = max(1, round(REGION * max(depth_m.shape[-2:])))
    region = _window_mean(behind * weight, radius) / _window_mean(weight, radius).clamp_min(1e-6)
    rejected = ((torch.minimum(region, behind) / least - 1.0) / (MULTIPLE - 1.0)).clamp(0.0, 1.0)
    return 1.0 - rejected


def _window_mean(x: Tensor, radius: int) -> Tensor:
    side = 2 * radius + 1
    return F.avg_pool2d(F.avg_pool2d(x, (1, side), 1, (0, radius)), (side, 1), 1, (radius, 0))
