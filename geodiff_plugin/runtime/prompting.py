"""Matches and points as a dense depth map, for priors that take a depth prompt.

Data flow: one ``Evidence`` per image -> ``(N, 1, h, w)`` metres.
Paper: none (Prompt Depth Anything, arXiv 2412.14015, takes a phone's lidar of 256 x 192).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.correction import prior_error, refine_depth
from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.known import stacked
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.matching import with_points

__all__ = ["PROMPT_LONG_EDGE", "prompt_of"]

#: Longer side of the prompt, pixels.
PROMPT_LONG_EDGE = 256


def prompt_of(evidence: Sequence[Evidence], config: GuidanceConfig) -> Tensor | None:
    """Matches that are sure and points, spread along surfaces.

    Args:
        evidence: one entry per image, all of one size.
        config: how they are spread.

    Returns:
        ``(N, 1, h, w)`` metres everywhere, the median of what is known far from all of it; ``None`` where of
        an image nothing is known.
    """
    maps = [found for one in evidence if (found := _dense(one, config)) is not None]
    return torch.cat(maps) if len(maps) == len(evidence) else None


def _dense(evidence: Evidence, config: GuidanceConfig) -> Tensor | None:
    """``(1, 1, h, w)`` metres: a flat map brought to what is known, as a prior's own would be."""
    sure, points = stacked([evidence.sure]), stacked([evidence.points])
    known = sure if points is None else with_points(sure, points)
    if known is None:
        return None
    height, width = evidence.left_01.shape[-2:]
    factor = min(1.0, PROMPT_LONG_EDGE / max(height, width))
    size = max(1, round(height * factor)), max(1, round(width * factor))
    median = 1.0 / known.inverse_depth[known.confidence > 0].median()
    flat = median.expand(1, 1, height, width)
    left = evidence.left_01[None]
    error = prior_error(flat, known, left, config=config)
    depth_m = refine_depth(flat, known, left, error, config=config).depth_m
    return F.interpolate(depth_m, size, mode="bilinear", antialias=True)
