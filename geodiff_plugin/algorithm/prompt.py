"""Makes depth maps from matches and points, for networks that take a depth prompt."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.match_fitting import fit_depth, prior_error
from geodiff_plugin.cameras import scaled_size
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches, with_points

#: Longer side of the depth prompt, pixels; such networks were trained with phone lidar maps.
PROMPT_LONG_EDGE = 256


def depth_prompt(evidence: Sequence[Evidence], config: GuidanceConfig) -> Tensor | None:
    """Fit flat maps to matches and points, ``(N, 1, h, w)`` metres; ``None`` if any image has none."""
    maps = [_prompt_of(image, config) for image in evidence]
    known = [depth_m for depth_m in maps if depth_m is not None]
    return torch.cat(known) if len(known) == len(maps) else None


def _prompt_of(evidence: Evidence, config: GuidanceConfig) -> Tensor | None:
    """Make the prompt ``(1, 1, h, w)`` of one image, metres."""
    confident, points = Matches.stack([evidence.reliable]), Matches.stack([evidence.points])
    target = confident if points is None else with_points(confident, points)
    if target is None:
        return None
    size = evidence.grid.size
    factor = min(1.0, PROMPT_LONG_EDGE / max(size))
    median = 1.0 / target.inverse_depth[target.confidence > 0].median()
    flat = median.expand(1, 1, *size)
    left = evidence.grid.left.image_01[None]
    fit = fit_depth(flat, target, left, prior_error(flat, target, left, config), config)
    return F.interpolate(fit.depth_m, scaled_size(size, factor, factor), mode="bilinear", antialias=True)
