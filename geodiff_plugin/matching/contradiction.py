"""Matches that lie behind what the prior says, over a region: mirrors and glass.

Hop: matches + metric depth of the prior's first estimate -> share of each match's confidence that remains.
Paper: S5.2 (transparent and mirroring surfaces are where a second view misleads and the prior knows).
"""

from __future__ import annotations

from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["believe_before_prior"]

#: Half the side of the window over which matches must agree to be taken for a reflection, in image sides: a
#: prior that misses a small gap between things must not close it.
REGION = 0.08
#: How far behind, in log depth: this many spreads of the image's own matches around the prior, and at least
#: the floor. A prior that is right to 5 % can name a reflection, one that errs by 30 % cannot.
SPREADS, FLOOR, LEAST_SPREAD = 2.0, 0.2, 0.05
#: From the threshold to this multiple of it, belief falls from all to nothing.
GONE = 1.6
#: Further than this factor in log depth, a match tells nothing more.
_MOST = 1.5
_SURE = 0.3


class _Known(Protocol):
    """``Matches`` or ``terms.MatchTarget``."""

    inverse_depth: Tensor
    confidence: Tensor


@torch.no_grad()
def believe_before_prior(matches: _Known, depth_m: Tensor) -> Tensor:
    """How far each match may still be believed, given the depth that the prior saw before any match moved it.

    One-sided: a reflection and what is seen through glass lie behind the surface, never before it.

    Args:
        matches: of a chunk of samples, ``(B, 1, H, W)``.
        depth_m: ``(B, 1, H, W)`` metres, > 0, the prior's first estimate with the search's scale.

    Returns:
        ``(B, 1, H, W)`` in [0, 1]; 1 where a match, or the region around it, is not behind the prior by more
        than chance.
    """
    weight = matches.confidence.float()
    behind = -(matches.inverse_depth * depth_m).clamp_min(1e-6).log().clamp(-_MOST, _MOST)
    sure = torch.where(weight > _SURE, behind, torch.full_like(behind, torch.nan)).flatten(1)
    middle = sure.nanmedian(1, keepdim=True).values
    spread = 1.4826 * (sure - middle).abs().nanmedian(1).values
    least = (SPREADS * spread.nan_to_num(_MOST).clamp_min(LEAST_SPREAD)).clamp_min(FLOOR)[:, None, None, None]
    radius = max(1, round(REGION * max(depth_m.shape[-2:])))
    region = _window_mean(behind * weight, radius) / _window_mean(weight, radius).clamp_min(1e-6)
    doubt = ((torch.minimum(region, behind) / least - 1.0) / (GONE - 1.0)).clamp(0.0, 1.0)
    return 1.0 - doubt


def _window_mean(x: Tensor, radius: int) -> Tensor:
    side = 2 * radius + 1
    return F.avg_pool2d(F.avg_pool2d(x, (1, side), 1, (0, radius)), (side, 1), 1, (radius, 0))
