"""Assemble everything known about a guided call on the grid of its output.

Hop: stock output in metres + ``GuidedRun`` -> ``MetricDepthOutput``.
Paper: Eq. 14's re-rendered left image, as a per-pixel report.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold import MarigoldDepthOutput
from torch import Tensor

from geodiff_plugin.confidence import depth_confidence
from geodiff_plugin.ensembling import median
from geodiff_plugin.evidence import as_fine_as, match_target
from geodiff_plugin.geometry.cameras import resize_intrinsics
from geodiff_plugin.geometry.warping import warp_right_to_left
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.integration.run import GuidedRun
from geodiff_plugin.matching import RightView, gate_matches, with_points
from geodiff_plugin.refinement import refine_depth
from geodiff_plugin.terms import MatchTarget
from geodiff_plugin.terms.exposure import match_exposure
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["assemble_output"]

#: A visible share below this is told to the user: scale then rests on little.
LITTLE_OVERLAP = 0.3


def assemble_output(
    stock: MarigoldDepthOutput,
    run: GuidedRun,
    guidance: GeometryGuidance,
    lefts_01: Tensor,
    match_input_resolution: bool,
    output_type: str,
) -> MetricDepthOutput:
    """Everything of ``MetricDepthOutput`` but ``latent``.

    Args:
        stock: output of the stock call, already in metres.
        run: the finished run.
        guidance: what was configured.
        lefts_01: ``(N, 3, H, W)`` left images at native size.
        match_input_resolution: whether the output grid is the input's.
        output_type: ``"np"`` or ``"pt"``.
    """
    count, size = lefts_01.shape[0], tuple(lefts_01.shape[-2:])
    depth_m = _as_maps(stock.prediction).to(lefts_01.device)  # (N, 1, H, W) or the processing grid
    depth_m, support = _refined(run, depth_m, lefts_01)
    grid = tuple(depth_m.shape[-2:])
    lefts = lefts_01 if grid == size else F.interpolate(lefts_01, grid, mode="bilinear", antialias=True)
    known = [own.on(depth_m.device) for own in guidance.inputs]
    K = resize_intrinsics(torch.stack([K_left for _, K_left, _ in known]), size, grid)
    seen = [
        _reprojection(rights, *(x[i : i + 1] for x in (depth_m, lefts, K)))
        for i, (rights, _, _) in enumerate(known)
        if rights
    ]
    visible, error = (torch.cat(maps) for maps in zip(*seen, strict=True)) if seen else (None, None)
    confidence = None
    if support is not None:
        spread = None if stock.uncertainty is None else _as_maps(stock.uncertainty).to(depth_m) / depth_m
        nowhere = torch.zeros_like(depth_m)
        shown = (nowhere, nowhere.bool()) if error is None else (error, visible)
        confidence = depth_confidence(support, *shown, spread)
    relative = torch.cat(run.relative)
    relative = median(relative.reshape(count, -1, *relative.shape[1:]), 1)  # (N, 1, h, w)
    if match_input_resolution:
        relative = F.interpolate(relative, size, mode="bilinear", align_corners=False)
    affine = [t.affine for t in run.trajectories]

    def members(name: str) -> Tensor:
        return torch.cat([getattr(a, name) for a in affine]).reshape(count, -1).cpu()

    def out(x: Tensor | None) -> Any:
        return x if output_type == "pt" or x is None else x.permute(0, 2, 3, 1).cpu().numpy()

    return MetricDepthOutput(
        prediction=out(depth_m),
        uncertainty=stock.uncertainty,
        relative=out(relative),
        scale=members("scale"),
        shift=members("shift"),
        global_scale=members("g_s"),
        visible=out(visible),
        photometric_error=out(error),
        confidence=out(confidence),
        K=K if output_type == "pt" else K.cpu().numpy(),
        history=[report for t in run.trajectories for report in t.history],
        extras=getattr(stock, "extras", {}),
        warnings=_warnings(run, visible),
    )


def _as_maps(values: Any) -> Tensor:
    """``(N, 1, H, W)`` float32 of what the pipeline gives, numpy or torch."""
    if isinstance(values, Tensor):
        return values.float()
    return torch.from_numpy(values).permute(0, 3, 1, 2).float()


def _refined(run: GuidedRun, depth_m: Tensor, lefts_01: Tensor) -> tuple[Tensor, Tensor | None]:
    """The depth of every image brought to what is known, and how far that decided it."""
    if not run.config.refine:
        return depth_m, None
    depths = depth_m.split(1)
    known = [_known(run, i, depth) for i, depth in enumerate(depths)]
    if any(target is None for target in known):
        return depth_m, None
    refined = [refine_depth(*each) for each in zip(depths, known, lefts_01.split(1), strict=True)]
    return torch.cat([r.depth_m for r in refined]), torch.cat([r.support for r in refined])


def _known(run: GuidedRun, image: int, depth_m: Tensor) -> MatchTarget | None:
    """What a depth ``(1, 1, H, W)`` is brought to: the matches that it and the prior believe, and points."""
    evidence = run.evidence[image]
    matches, points = match_target([evidence.sweep_matches]), match_target([evidence.sweep_points])
    if matches is not None:
        size = tuple(matches.confidence.shape[-2:])
        depth = F.interpolate(depth_m, size, mode="bilinear", align_corners=False)
        own = [t.belief[i] for t in run.trajectories for i, owner in enumerate(t.owners) if owner == image]
        belief = torch.stack(own).mean(0, keepdim=True)  # over the members of an ensemble
        belief = F.interpolate(belief, size, mode="bilinear", align_corners=False)
        gated = gate_matches(matches, depth, run.config.gate)
        matches = replace(matches, confidence=belief * gated)
    return matches if points is None else with_points(matches, points)


def _reprojection(
    rights: Sequence[RightView], depth_m: Tensor, left_01: Tensor, K_left: Tensor
) -> tuple[Tensor, Tensor]:
    """Where any right view sees the pixel, and the least mean absolute error to the re-rendered left image.

    The error is that of the view that explains the pixel best, compared in the left image's exposure; both
    are at the output's resolution.
    """
    best, visible = torch.full_like(depth_m, torch.inf), torch.zeros_like(depth_m, dtype=torch.bool)
    for image, K_right, T in rights:
        image, K_right = as_fine_as(image, K_right, K_left[0])
        warped = warp_right_to_left(image[None], depth_m, K_left, K_right[None], T[None])
        matched = match_exposure(warped.image, left_01, warped.visible)
        error = (matched - left_01).abs().mean(1, keepdim=True)
        best = torch.where(warped.visible, torch.minimum(best, error), best)
        visible |= warped.visible
    return visible, best.where(visible, torch.zeros_like(best))


def _warnings(run: GuidedRun, visible: Tensor | None) -> list[str]:
    found = []
    if any(bool(t.on_edge.any()) for t in run.trajectories):
        found.append(
            "The search for the scale ended on the edge of its range: the depth may lie beyond it. "
            "Check the calibration (units of the baseline, order of left and right) or widen depth_range."
        )
    share = 1.0 if visible is None else visible.float().mean().item()
    if share < LITTLE_OVERLAP:
        found.append(
            f"Only {share:.0%} of the left image is seen by a right camera at this depth; "
            "scale rests on little."
        )
    found.extend(sentence for e in run.evidence for sentence in e.warnings)
    return found
