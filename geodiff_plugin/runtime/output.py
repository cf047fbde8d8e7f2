"""The result of a finished call: ``MetricDepthOutput``, all on the grid of the output, with a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold import MarigoldDepthOutput
from torch import Tensor

from geodiff_plugin._checks import InputError
from geodiff_plugin.geometry import image_size, resize_intrinsics
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.matching import build_cost_volume, match_volume
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.pose.scale import NO_UNIT
from geodiff_plugin.runtime.confidence import depth_confidence, reprojection
from geodiff_plugin.runtime.finish import finish_images, median, spread_of_members
from geodiff_plugin.runtime.run import GuidedRun
from geodiff_plugin.runtime.verdict import Indicators, Verdict, judge, points_agreement, read_indicators
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.types import MetricDepthOutput

#: A visible share below this is reported to the user: the scale then rests on few pixels.
LITTLE_OVERLAP = 0.3
#: Metres; what a metric prior may say of its nearest pixel is 0.
LEAST_M = 1e-6


def _confidence(
    support: Tensor | None,
    depth_m: Tensor,
    shown: tuple[Tensor | None, Tensor | None],
    uncertainty: Tensor | None,
    prior_error: Tensor | None,
) -> Tensor | None:
    """``(N, 1, H, W)`` in [0, 1] from support and what the views show: visible, error; ``None`` without."""
    if support is None:
        return None
    visible, error = shown
    nothing = torch.zeros_like(depth_m)
    return depth_confidence(
        support,
        error=nothing if error is None else error,
        visible=nothing.bool() if visible is None else visible,
        spread=None if uncertainty is None else uncertainty / depth_m,
        prior_error=prior_error,
    )


def assemble_output(
    stock: MarigoldDepthOutput,
    run: GuidedRun,
    guidance: GeometryGuidance,
    call: Mapping[str, Any],
    warned: Mapping[str, bool],
) -> MetricDepthOutput:
    """Everything of ``MetricDepthOutput`` but ``latent``.

    ``stock`` is the output of the stock call, already in metres, and ``call`` its arguments by name;
    ``warned`` has the warnings so far, and whether each forbids trust.
    """
    natives = [evidence.native_left for evidence in run.evidence]
    # A single large picture is not copied.
    lefts_01 = natives[0][None] if len(natives) == 1 else torch.stack(natives)
    count, size, has_unit = len(natives), image_size(lefts_01), guidance.unit is not None
    depth_m = run.within_range(_as_maps(stock.prediction).to(lefts_01.device))  # or the processing grid
    grid = image_size(depth_m)
    lefts = lefts_01 if grid == size else F.interpolate(lefts_01, grid, mode="bilinear", antialias=True)
    depth_m, support = finish_images(run, depth_m, lefts)
    uncertainty = None if stock.uncertainty is None else _as_maps(stock.uncertainty).to(depth_m)
    if uncertainty is not None and support is not None:
        uncertainty = spread_of_members(run, depth_m, lefts, call)
    Ks = [torch.as_tensor(i.K_left, dtype=torch.float32, device=depth_m.device) for i in guidance.inputs]
    K = resize_intrinsics(torch.stack(Ks), size, grid)
    visible, error = _reprojected(run, depth_m, lefts, K)
    prior_error = run.prior_error()  # (N, 1, 1, 1), or of every pixel with the measured one as the least
    confidence = _confidence(support, depth_m, (visible, error), uncertainty, prior_error)
    over_prior = _over_prior(run, depth_m)
    relative = torch.cat(run.relative)
    relative = median(relative.reshape(count, -1, *relative.shape[1:]), 1)  # (N, 1, h, w)
    doubts = tuple(sentence for sentence, forbids in warned.items() if forbids)
    verdicts = []
    for i, K_left in enumerate(Ks):
        own_ratio = math.nan
        if over_prior is not None and has_unit:
            own_ratio = float(over_prior.reshape(count, -1)[i].median())
        indicators = _indicators(
            run,
            i,
            K_left,
            depth_m[i],
            relative[i : i + 1],
            has_unit=has_unit,
            doubts=doubts,
            confidence=math.nan if confidence is None else float(confidence[i].mean()),
            own_ratio=own_ratio,
        )
        verdicts.append(judge(indicators))
    if confidence is not None:
        agreement = confidence.new_tensor([points_agreement(verdict.indicators) for verdict in verdicts])
        confidence = confidence * agreement.view(-1, 1, 1, 1)
    if call["match_input_resolution"]:
        relative = F.interpolate(relative, size, mode="bilinear", align_corners=False)

    def of_members(name: str) -> Tensor:
        return torch.cat([getattr(t.affine, name) for t in run.trajectories]).reshape(count, -1).cpu()

    def out(x: Tensor | None) -> Any:
        return x if call["output_type"] == "pt" or x is None else x.permute(0, 2, 3, 1).cpu().numpy()

    estimated = guidance.estimated
    output = MetricDepthOutput(
        prediction=out(depth_m),
        uncertainty=out(uncertainty),
        relative=out(relative),
        space=run.prior.space,
        scale=of_members("scale"),
        shift=of_members("shift"),
        global_scale=of_members("g_s"),
        own_scale=None if over_prior is None else over_prior.median(1).values.reshape(count, -1).cpu(),
        visible=out(visible),
        photometric_error=out(error),
        confidence=out(confidence),
        support=out(support),
        prior_error=None if prior_error is None else prior_error.amin((1, 2, 3)).cpu(),
        K=K if call["output_type"] == "pt" else K.cpu().numpy(),
        history=[report for t in run.trajectories for report in t.history],
        poses=[evidence.pose for evidence in run.evidence if evidence.pose is not None],
        extras=getattr(stock, "extras", {}),
        verdicts=verdicts,
        unit=guidance.unit,
        warnings=[
            *_warnings(run, visible, verdicts),
            *(() if estimated is None else estimated.warnings),
            *(sentence for sentence, forbids in warned.items() if not forbids),  # doubts are reasons already
        ],
        assumed=list(guidance.assumed),
        scale_from=None if estimated is None else estimated.scale.source,
        scale_spread=None if estimated is None else estimated.scale.spread,
    )
    if not has_unit and over_prior is not None:
        return _in_the_priors_metres(output, over_prior)
    return output


def _reprojected(
    run: GuidedRun, depth_m: Tensor, lefts: Tensor, K: Tensor
) -> tuple[Tensor, Tensor] | tuple[None, None]:
    """Visibility and photometric error of every image, ``(N, 1, H, W)``; nothing where no view is."""
    maps = [
        reprojection(evidence.native, depth_m[i : i + 1], lefts[i : i + 1], K[i : i + 1])
        for i, evidence in enumerate(run.evidence)
        if evidence.native
    ]
    if not maps:
        return None, None
    visible, error = zip(*maps, strict=True)
    return torch.cat(visible), torch.cat(error)


def _over_prior(run: GuidedRun, depth_m: Tensor) -> Tensor | None:
    """``(N * E, h w)`` the depth ``(N, 1, H, W)`` over a metric prior's own, on the prior's grid."""
    maps = [t.prior_depth for t in run.trajectories if t.prior_depth is not None]
    if len(maps) < len(run.trajectories):
        return None
    priors_m = torch.cat(maps)
    resized = F.interpolate(depth_m, priors_m.shape[-2:], mode="bilinear", align_corners=False)
    return (resized[run.owners] / priors_m.clamp_min(LEAST_M)).flatten(1)


def _in_the_priors_metres(output: MetricDepthOutput, over_prior: Tensor) -> MetricDepthOutput:
    """The output of estimated poses without a unit, in the metres of a prior that has some.

    Everything that is a length is multiplied by the factor that brings the depth to the prior's at half of
    the pixels; how much that factor differs from pixel to pixel tells how uncertain it is.
    """
    factor = 1.0 / float(over_prior.median())
    spread = 1.4826 * float((over_prior * factor).clamp_min(1e-9).log().abs().median())

    def moved(E: np.ndarray) -> np.ndarray:
        return np.block([[E[:3, :3], factor * E[:3, 3:]], [E[3:]]])

    warning = (
        f"No length is known: the metres are the prior's own, and as wrong as those. From pixel to pixel its "
        f"depth and that of the views differ by {100 * spread:.0f} % in the middle."
    )
    output.prediction = output.prediction * factor
    output.uncertainty = None if output.uncertainty is None else output.uncertainty * factor
    for name in ("global_scale", "own_scale"):
        setattr(output, name, getattr(output, name) * factor)
    output.history = [replace(step, g_s=step.g_s * factor) for step in output.history]
    output.poses = [
        replace(pose, E=tuple(map(moved, pose.E)), E_given=tuple(map(moved, pose.E_given)))
        for pose in output.poses
    ]
    output.unit, output.scale_from, output.scale_spread, output.rescaled = "m", "prior", spread, factor
    output.warnings = [sentence for sentence in output.warnings if sentence != NO_UNIT] + [warning]
    return output


def _indicators(
    run: GuidedRun,
    image: int,
    K_left: Tensor,
    depth_m: Tensor,
    relative: Tensor,
    *,
    has_unit: bool,
    doubts: tuple[str, ...],
    confidence: float,
    own_ratio: float,
) -> Indicators:
    """Indicators of one image; matches to judge it by are made here, where its run used none."""
    samples = [(t, i) for t in run.trajectories for i, owner in enumerate(t.owners) if owner == image]
    evidence, config = run.evidence[image], run.config
    order = float(torch.stack([t.order[i] for t, i in samples if t.order is not None]).nanmean())
    if evidence.matches is None and evidence.native:
        with suppress(InputError):  # views without overlap: not judged
            volume = evidence.volume or build_cost_volume(
                evidence.native_left,
                evidence.native,
                K_left,
                depth_range=config.depth_range,
                config=config,
            )
            matches = match_volume(volume)
            evidence = replace(evidence, matches=matches, points=None)
            order = float(order_agreement(relative, matches, run.prior.space))
    return read_indicators(
        evidence,
        K_left,
        depth_m,
        range_given=config.depth_range is not None,
        has_unit=has_unit,
        order=order,
        on_edge=any(t.on_edge is not None and bool(t.on_edge[i]) for t, i in samples),
        doubts=doubts,
        confidence=confidence,
        own_ratio=own_ratio,
    )


def _as_maps(values: Any) -> Tensor:
    """``(N, 1, H, W)`` float32 of what the pipeline gives, numpy or torch."""
    if isinstance(values, Tensor):
        return values.float()
    return torch.from_numpy(values).permute(0, 3, 1, 2).float()


def _warnings(run: GuidedRun, visible: Tensor | None, verdicts: Sequence[Verdict]) -> list[str]:
    warnings = []
    for i, verdict in enumerate(verdicts):
        sentences = [] if verdict.trusted else [verdict.sentence]
        sentences += verdict.remarks
        share = 1.0 if visible is None else visible[i].float().mean().item()
        if share < LITTLE_OVERLAP:
            sentences.append(
                f"Only {share:.0%} of the left image is seen by a right camera at this depth; "
                "scale rests on little."
            )
        reasons = {INVERSE, *verdict.indicators.mistakes}  # of a pose: in the verdict already
        sentences += [sentence for sentence in run.evidence[i].warnings if sentence not in reasons]
        prefix = "" if len(verdicts) == 1 else f"Image {i + 1}: "
        warnings += [prefix + sentence for sentence in sentences]
    return warnings
