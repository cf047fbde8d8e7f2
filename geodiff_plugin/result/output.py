"""From decoded maps to ``MetricDepthOutput``: ensemble (S5.1), refinement, confidence, verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold import MarigoldDepthOutput
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from torch import Tensor

from geodiff_plugin._checks import InputError, check_choice
from geodiff_plugin.algorithm.correction import correction_target, fit_depth
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.geometry import image_size, resize_intrinsics
from geodiff_plugin.matching import Matches, build_cost_volume, match_volume
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.estimate import NO_UNIT
from geodiff_plugin.result.confidence import depth_confidence, reprojection
from geodiff_plugin.result.full_resolution import sharpen_edges, vote_depth
from geodiff_plugin.result.verdict import Indicators, Verdict, judge, points_agreement, read_indicators
from geodiff_plugin.runtime.run import GuidedRun
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.types import MetricDepthOutput

#: The user is warned if the visible share is below this: few pixels then determine the scale.
LITTLE_OVERLAP = 0.3
#: Least depth of a metric prior, metres: its nearest pixel may be 0.
LEAST_M = 1e-6


def _finish(
    run: GuidedRun, image: int, depth_m: Tensor, left: Tensor, member: int | None = None
) -> tuple[Tensor, Tensor] | None:
    """The refined map of an image or a member, ``(1, 1, H, W)`` metres, and its support.

    Edges are sharpened first: then the fit does not carry the depth of one surface over to the next.
    ``None`` if there are neither matches nor points.
    """
    evidence, (kept, error) = run.evidence[image], run.kept_and_error(image, member)
    matches, points = Matches.stack([evidence.matches]), Matches.stack([evidence.points])
    spacing = max(image_size(depth_m)) / max(run.grid.content)
    if matches is not None or points is not None:
        depth_m = sharpen_edges(depth_m, left, max(1, round(spacing)))
    target = correction_target(matches, points, kept, error, depth_m)
    if target is None or error is None:
        return None
    native = evidence.native_left[None]
    fitted_m, support, _ = fit_depth(depth_m, target, native, error, run.config)
    if matches is not None:
        target = correction_target(matches, points, kept, error, fitted_m)
        assert target is not None  # there are matches
        K = resize_intrinsics(evidence.K_left[None], image_size(evidence.left_01), image_size(native))[0]
        measured = error.amin((2, 3), keepdim=True)  # its value where the prior gives a depth
        fitted_m = vote_depth(fitted_m, native, K, evidence.native_views, target, measured, spacing)
    return fitted_m, support


def _finish_images(run: GuidedRun, depth_m: Tensor, lefts_01: Tensor) -> tuple[Tensor, Tensor | None]:
    """Refined maps ``(N, 1, H, W)`` and their support; maps unchanged, and ``None``, if one has no target."""
    results = []
    for i, (depth, left) in enumerate(zip(depth_m.split(1), lefts_01.split(1), strict=True)):
        result = _finish(run, i, depth, left) if run.config.crisp else None
        if result is None:
            return depth_m, None
        results.append(result)
    depths, supports = zip(*results, strict=True)
    return torch.cat(depths), torch.cat(supports)


def _spread_of_members(run: GuidedRun, depth_m: Tensor, lefts_01: Tensor, call: Mapping[str, Any]) -> Tensor:
    """Spread of the members of every ensemble, each refined, around its result: ``(N, 1, H, W)`` metres."""
    size, method = image_size(depth_m), call["resample_method_output"]
    reduction = (call["ensembling_kwargs"] or {}).get("reduction", "median")
    spreads = []
    for i, members in enumerate(run.members):
        members = members.float().to(depth_m.device)
        if image_size(members) != size:  # resized as the stock call resizes the ensemble
            members = MarigoldImageProcessor.resize_antialias(members, size, method, is_aa=False)
            members = run.within_range(members, i)
        results = [
            _finish(run, i, member, lefts_01[i : i + 1], m) for m, member in enumerate(members.split(1))
        ]
        finished = torch.cat([result[0] for result in results if result is not None])
        spreads.append(_spread_around(depth_m[i : i + 1], finished, reduction))
    return torch.cat(spreads)


def ensemble_metric(depth_m: Tensor, reduction: str = "median", lower: bool = False) -> tuple[Tensor, Tensor]:
    """Reduce members ``(E, 1, H, W)`` metres pixel by pixel to a map and its uncertainty, ``(1, 1, H, W)`` m.

    ``"median"`` has the median absolute deviation, ``"mean"`` the standard deviation.
    """
    check_choice(reduction, "ensembling_kwargs['reduction']", ("median", "mean"))
    middle = depth_m.mean(0, keepdim=True) if reduction == "mean" else median(depth_m, 0, lower)[None]
    return middle, _spread_around(middle, depth_m, reduction)


def _spread_around(middle: Tensor, depth_m: Tensor, reduction: str) -> Tensor:
    """How far members ``(E, 1, H, W)`` lie from a map ``(1, 1, H, W)``, pixel by pixel, metres."""
    away = depth_m - middle
    if reduction == "mean":
        return away.square().mean(0, keepdim=True).sqrt()
    return median(away.abs(), 0)[None]


def median(x: Tensor, dim: int, lower: bool = False) -> Tensor:
    """The median along ``dim``, which is dropped: of an even number the mean of the middle two, or the lower.

    ``torch.median``, and so Marigold-DC, takes the lower, which makes metres too near.
    """
    ordered, count = x.sort(dim=dim).values, x.shape[dim]
    below = ordered.select(dim, (count - 1) // 2)
    return below if lower else 0.5 * (below + ordered.select(dim, count // 2))


def assemble_output(
    stock: MarigoldDepthOutput,
    run: GuidedRun,
    guidance: GeometryGuidance,
    call: Mapping[str, Any],
    warned: Sequence[Message],
) -> MetricDepthOutput:
    """``MetricDepthOutput`` without ``latent``, from the stock call's output, whose maps are in metres.

    ``warned`` are the warnings so far; those that forbid trust are reasons of the verdict.
    """
    natives = [evidence.native_left for evidence in run.evidence]
    # A single large picture is not copied.
    lefts_01 = natives[0][None] if len(natives) == 1 else torch.stack(natives)
    count, size, has_unit = len(natives), image_size(lefts_01), guidance.unit is not None
    depth_m = run.within_range(stock.prediction.float().to(lefts_01.device))  # or the grid's size
    grid = image_size(depth_m)
    lefts_01 = lefts_01 if grid == size else F.interpolate(lefts_01, grid, mode="bilinear", antialias=True)
    depth_m, support = _finish_images(run, depth_m, lefts_01)
    uncertainty = None if stock.uncertainty is None else stock.uncertainty.to(depth_m)
    if uncertainty is not None and support is not None:
        uncertainty = _spread_of_members(run, depth_m, lefts_01, call)
    Ks = torch.stack([torch.as_tensor(i.K_left, device="cpu").float() for i in guidance.inputs]).to(depth_m)
    K = resize_intrinsics(Ks, size, grid)
    visible, error = _reprojected(run, depth_m, lefts_01, K)
    prior_error = run.prior_error()  # (N, 1, 1, 1), or per pixel: the measured error where valid
    confidence, over_prior = None, _over_prior(run, depth_m)
    if support is not None:
        unseen = torch.zeros_like(depth_m)
        seen = (unseen, unseen > 0) if error is None or visible is None else (error, visible)
        spread = None if uncertainty is None else uncertainty / depth_m
        confidence = depth_confidence(support, *seen, spread, prior_error)
    relative = torch.cat(run.relative)
    relative = median(relative.reshape(count, -1, *relative.shape[1:]), 1)  # (N, 1, h, w)
    doubts = tuple(message for message in warned if message.forbids_trust)
    known: dict[str, Any] = {"doubts": doubts, "has_unit": has_unit}
    maps = relative, confidence, over_prior if has_unit else None
    verdicts = [judge(_indicators(run, i, K, depth_m[i], *maps, **known)) for i, K in enumerate(Ks)]
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
        scale=of_members("scale"),
        shift=of_members("shift"),
        global_scale=of_members("g_s"),
        prior_scale=None if over_prior is None else over_prior.median(1).values.reshape(count, -1).cpu(),
        visible=out(visible),
        photometric_error=out(error),
        confidence=out(confidence),
        support=out(support),
        prior_error=None if prior_error is None else prior_error.amin((1, 2, 3)).cpu(),
        K=K if call["output_type"] == "pt" else K.cpu().numpy(),
        history=[report for t in run.trajectories for report in t.history],
        poses=[evidence.pose for evidence in run.evidence if evidence.pose is not None],
        extras={name: out(extra) for name, extra in getattr(stock, "extras", {}).items()},
        verdicts=verdicts,
        unit=guidance.unit,
        warnings=[
            *_warnings(run, visible, verdicts),
            *(() if estimated is None else estimated.warnings),
            *(message for message in warned if not message.forbids_trust),  # the others are reasons already
        ],
        assumed=list(guidance.assumed),
    )
    if estimated is not None:
        output.scale_from, output.scale_spread = estimated.scale.source, estimated.scale.spread
    if not has_unit and over_prior is not None:
        return _in_the_priors_metres(output, over_prior)
    return output


def _reprojected(
    run: GuidedRun, depth_m: Tensor, lefts_01: Tensor, K: Tensor
) -> tuple[Tensor, Tensor] | tuple[None, None]:
    """Visibility and photometric error of every image, ``(N, 1, H, W)``; ``None`` without right views."""
    maps = [
        reprojection(evidence.native_views, depth_m[i : i + 1], lefts_01[i : i + 1], K[i : i + 1])
        for i, evidence in enumerate(run.evidence)
        if evidence.native_views
    ]
    if not maps:
        return None, None
    visible, error = zip(*maps, strict=True)
    return torch.cat(visible), torch.cat(error)


def _over_prior(run: GuidedRun, depth_m: Tensor) -> Tensor | None:
    """``(N * E, h w)`` ratio of ``depth_m (N, 1, H, W)`` to a metric prior's depth, on the prior's grid."""
    maps = [t.prior_depth for t in run.trajectories if t.prior_depth is not None]
    if len(maps) < len(run.trajectories):
        return None
    priors_m = torch.cat(maps)
    resized = F.interpolate(depth_m, priors_m.shape[-2:], mode="bilinear", align_corners=False)
    return (resized[run.owners] / priors_m.clamp_min(LEAST_M)).flatten(1)


def _in_the_priors_metres(output: MetricDepthOutput, over_prior: Tensor) -> MetricDepthOutput:
    """Convert an output without a unit to the metres of a metric prior."""
    factor = 1.0 / float(over_prior.median())
    spread = 1.4826 * float((over_prior * factor).clamp_min(1e-9).log().abs().median())

    def moved(E: np.ndarray) -> np.ndarray:
        return np.block([[E[:3, :3], factor * E[:3, 3:]], [E[3:]]])

    warning = Message(
        "scale.from-prior",
        "No length is known: the metres are the prior's own, with its errors. Its depth and the depth from "
        f"the views differ by {100 * spread:.0f} % in the median.",
    )
    output.prediction = output.prediction * factor
    output.uncertainty = None if output.uncertainty is None else output.uncertainty * factor
    for name in ("global_scale", "prior_scale"):
        setattr(output, name, getattr(output, name) * factor)
    output.history = [replace(step, g_s=step.g_s * factor) for step in output.history]
    output.poses = [
        replace(pose, E=tuple(map(moved, pose.E)), E_given=tuple(map(moved, pose.E_given)))
        for pose in output.poses
    ]
    output.unit, output.scale_from, output.scale_spread, output.rescaled = "m", "prior", spread, factor
    output.warnings = [m for m in output.warnings if m.code != NO_UNIT.code] + [warning]
    return output


def _indicators(
    run: GuidedRun,
    image: int,
    K_left: Tensor,
    depth_m: Tensor,
    relative: Tensor,
    confidence: Tensor | None,
    over_prior: Tensor | None,
    **more: Any,
) -> Indicators:
    """Indicators of one image; if its run used no matches, they are made here for the verdict."""
    if confidence is not None:
        more["confidence"] = float(confidence[image].mean())
    if over_prior is not None:
        more["prior_ratio"] = float(over_prior.reshape(len(run.evidence), -1)[image].median())
    samples, evidence, config = run.samples_of(image), run.evidence[image], run.config
    order = float(torch.stack([t.order[i] for t, i in samples if t.order is not None]).nanmean())
    if evidence.matches is None and evidence.native_views:
        with suppress(InputError):  # views without overlap: not judged
            views = evidence.native_left, evidence.native_views, K_left
            volume = evidence.volume or build_cost_volume(
                *views, depth_range=config.depth_range, config=config
            )
            matches = match_volume(volume)
            evidence = replace(evidence, matches=matches, points=None)
            order = float(order_agreement(relative[image : image + 1], matches, run.prior.space))
    return read_indicators(
        evidence,
        K_left,
        depth_m,
        range_given=config.depth_range is not None,
        order=order,
        on_edge=any(t.on_edge is not None and bool(t.on_edge[i]) for t, i in samples),
        **more,
    )


def image_labels(count: int) -> list[str]:
    """What a sentence about each of so many images begins with."""
    return [""] if count == 1 else [f"Image {i}: " for i in range(1, count + 1)]


def _warnings(run: GuidedRun, visible: Tensor | None, verdicts: Sequence[Verdict]) -> list[Message]:
    warnings = []
    for i, (label, verdict) in enumerate(zip(image_labels(len(verdicts)), verdicts, strict=True)):
        messages = [] if verdict.message is None else [verdict.message]
        messages += verdict.remarks
        share = 1.0 if visible is None else visible[i].float().mean().item()
        if share < LITTLE_OVERLAP:
            sentence = (
                f"Only {share:.0%} of the left image is seen by a right camera at this depth; "
                "few pixels determine the scale."
            )
            messages.append(Message("views.overlap", sentence))
        # Mistakes of a pose are reasons of the verdict already.
        messages += [message for message in run.evidence[i].warnings if not message.forbids_trust]
        warnings += [message.labelled(label) for message in messages]
    return warnings
