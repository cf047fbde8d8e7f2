"""The result fitted to what is known, at full resolution: every image, and every member of its ensemble.

Data flow: decoded depth in metres, left images, ``Known`` of every image -> refined depth, support, spread.
Paper: none; its result is the decoded latent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from torch import Tensor

from geodiff_plugin.algorithm.correction import Refined
from geodiff_plugin.algorithm.known import Known
from geodiff_plugin.algorithm.sharpening import sharpen_edges
from geodiff_plugin.geometry.cameras import image_size
from geodiff_plugin.runtime.ensembling import spread_around
from geodiff_plugin.runtime.run import GuidedRun

__all__ = ["refine_result", "spread_of_members"]


def refine_result(
    run: GuidedRun, known_of: Sequence[Known], depth_m: Tensor, lefts_01: Tensor, lefts: Tensor
) -> tuple[Tensor, Tensor | None]:
    """The depth of every image refined, and how far matches and points decided it.

    Args:
        run: the finished run.
        known_of: of every image.
        depth_m: ``(N, 1, H, W)`` metres on the grid of the output.
        lefts_01: ``(N, 3, h, w)`` in [0, 1], at native size.
        lefts: ``(N, 3, H, W)``, the same on the grid of the output.

    Returns:
        ``(N, 1, H, W)`` metres, and support in [0, 1]; the depth as it was given and ``None`` where the
        result is not to be refined, or nothing is known of some image.
    """
    if not run.config.refine:
        return depth_m, None
    images = zip(known_of, depth_m.split(1), lefts_01.split(1), lefts.split(1), strict=True)
    fits = [fit for own, *maps in images if (fit := _refined(run, own, *maps)) is not None]
    if len(fits) < len(depth_m):
        return depth_m, None
    return torch.cat([fit.depth_m for fit in fits]), torch.cat([fit.support for fit in fits])


def spread_of_members(
    run: GuidedRun, depth_m: Tensor, lefts_01: Tensor, lefts: Tensor, call: Mapping[str, Any]
) -> Tensor:
    """How far the members of every ensemble, refined one by one, lie from its result: ``(N, 1, H, W)`` m.

    It costs a refinement a member: their spread before it is that of a map that is not given out.

    Args:
        run: the finished run.
        depth_m: ``(N, 1, H, W)`` metres, refined.
        lefts_01: as ``refine_result``.
        lefts: likewise.
        call: arguments of the stock call by name.
    """
    size, method = image_size(depth_m), call["resample_method_output"]
    reduction = (call["ensembling_kwargs"] or {}).get("reduction", "median")
    spreads = []
    for i, members in enumerate(run.members):
        members = members.float().to(depth_m.device)
        if image_size(members) != size:  # as the stock call brings the ensemble to its output
            members = MarigoldImageProcessor.resize_antialias(members, size, method, is_aa=False)
            members = run.within_range(members, i)
        views = lefts_01[i : i + 1], lefts[i : i + 1]
        fits = [_refined(run, run.known(i, m), member, *views) for m, member in enumerate(members.split(1))]
        refined = torch.cat([fit.depth_m for fit in fits if fit is not None])
        spreads.append(spread_around(depth_m[i : i + 1], refined, reduction))
    return torch.cat(spreads)


def _refined(run: GuidedRun, known: Known, depth_m: Tensor, left_01: Tensor, left: Tensor) -> Refined | None:
    """One map ``(1, 1, H, W)`` with its edges sharpened, fitted to what is known; ``None`` where nothing is.

    Edges first: a fit that finds them steep does not carry the depth of one surface over to the other, and
    the fit takes back what a poor prior's edges get wrong.
    """
    if run.config.sharpen and known.size is not None:
        spacing = max(1, round(max(image_size(depth_m)) / max(run.grid.content)))
        depth_m = sharpen_edges(depth_m, left, spacing)
    return known.refine(depth_m, left_01)
