"""Rank correlation between the prior's map and the matches.

Data flow: relative map ``x (B, 1, h, w)``, matches or points -> rank correlation per sample.
Paper: none; a check of the user's input, which the prior knows nothing of.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import SPACES

__all__ = ["SURE", "order_agreement"]

#: Matches that are looked at, how sure they must be, how few say nothing.
SAMPLES, SURE, FEWEST = 4000, 0.5, 40


def _ranks(values: Tensor) -> Tensor:
    """Ranks along the last axis, about 0 and of length 1; equal values share none, which noise evens out."""
    ranks = values.argsort(-1).argsort(-1).float()
    ranks = ranks - ranks.mean(-1, keepdim=True)
    return ranks / ranks.norm(dim=-1, keepdim=True).clamp_min(1e-12)


@torch.no_grad()
def order_agreement(x: Tensor, known: Matches, space: str) -> Tensor:
    """Spearman's rank correlation of nearness, as the map and as matches or points have it.

    Args:
        x: ``(B, 1, h, w)`` relative maps of one image, of the prior alone: before any match moved them.
        known: matches or points of that image, on any grid.
        space: what ``x`` is affine in, key of ``SPACES``.

    Returns:
        ``(B,)`` in [-1, 1]; NaN where fewer than 40 matches are sure.

    Convention:
        Cameras in the wrong order turn near into far: -1 where +1 is right.
    """
    at = known.above(SURE)
    if len(at) < FEWEST:
        return x.new_full((x.shape[0],), torch.nan)
    at = at[:: max(1, len(at) // SAMPLES)]
    values = F.interpolate(x.float(), known.size, mode="bilinear", align_corners=False).flatten(1)[:, at]
    nearness = -values if SPACES[space].grows_with_depth else values
    return (_ranks(nearness) * _ranks(known.inverse_depth.flatten()[at])[None]).sum(-1)
