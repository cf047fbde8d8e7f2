"""Act 3 for one image: from the maps of its ensemble to depth at full size, confidence and verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from torch import Tensor

from geodiff_plugin._checks import InputError
from geodiff_plugin.algorithm.correction import correction_target, fit_depth, local_error
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import image_size, resize_intrinsics
from geodiff_plugin.matching import Matches, build_cost_volume, known_share, match_volume
from geodiff_plugin.matching.rows import HiddenStrips, hidden_strips, with_hidden
from geodiff_plugin.messages import Message
from geodiff_plugin.result.confidence import (
    Grounds,
    depth_confidence,
    determined,
    grounds_of,
    reprojection,
)
from geodiff_plugin.result.ensemble import ensemble_metric, median, spread_around
from geodiff_plugin.result.flattening import flatten
from geodiff_plugin.result.indicators import indicators_of, measure_indicators, read_numbers
from geodiff_plugin.result.misfit import NO_MISFIT, misfit_of, share_left
from geodiff_plugin.result.verdict import judge, points_agreement
from geodiff_plugin.result.voting import vote_depth
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.scale.space import joined
from geodiff_plugin.types import Indicators, Verdict

#: Least depth of a metric prior, metres: its nearest pixel may be 0.
LEAST_M = 1e-6


@dataclass(frozen=True)
class ResultOptions:
    """What a call asks of its results."""

    config: GuidanceConfig
    resampling: str = "bilinear"  # of the members of an ensemble, as the pipeline resizes its result
    reduction: str = "median"  # of an ensemble, or ``"mean"``
    has_unit: bool = True  # whether lengths are in metres
    doubts: tuple[Message, ...] = ()  # warnings about the input, each of which forbids trust
    centre_assumed: bool = False  # the right camera's cx is assumed to be the left one's


@dataclass(frozen=True, eq=False)
class ImageResult:
    """Everything that is known about the depth of one image; what does not apply is ``None``.

    Maps are ``(1, 1, H, W)``, of the size of ``depth_m``; tensors are on the device of the call.
    """

    evidence: Evidence
    depth_m: Tensor  # metres
    K: Tensor  # (3, 3) pixels of ``depth_m``
    relative: Tensor  # the prior's map, about [0, 1]
    scale: Tensor  # (E,) of the members of its ensemble
    shift: Tensor  # (E,)
    global_scale: Tensor  # (E,) metres
    verdict: Verdict
    visible_share: float = 1.0  # of the pixels that a right view sees; 1 without a right view
    uncertainty: Tensor | None = None  # metres
    visible: Tensor | None = None  # bool, whether a right view sees the pixel
    photometric_error: Tensor | None = None  # [0, 1]
    confidence: Tensor | None = None  # [0, 1]
    support: Tensor | None = None  # [0, 1]
    prior_error: Tensor | None = None  # (1, 1, 1, 1), or per pixel, log depth
    over_prior: Tensor | None = None  # (E, h w) ratio of the depth to a metric prior's


class Refined(NamedTuple):
    """A map ``(1, 1, H, W)`` metres fitted to its matches and points, and how far these determine it."""

    depth_m: Tensor
    support: Tensor
    grounds: Grounds  # of its confidence


def finish(
    evidence: Evidence,
    members: Sequence[Member],
    depth_m: Tensor,
    uncertainty: Tensor | None,
    options: ResultOptions,
) -> ImageResult:
    """The result of one image.

    Args:
        evidence: of the image, from act 1.
        members: of its ensemble, from act 2.
        depth_m: ``(1, 1, H, W)`` metres, the members reduced, at the image's or at the processing size; it is
            changed in place.
        uncertainty: ``(1, 1, H, W)`` metres, their spread; ``None`` where none is asked for.
        options: what the call asks for.
    """
    native = evidence.native
    depth_m, uncertainty = _one_map(members, depth_m.float().to(native.left_01.device), uncertainty, options)
    left_01 = _resized(native.left_01[None], image_size(depth_m))
    K = resize_intrinsics(native.K_left[None], native.size, image_size(depth_m))
    uncertainty = None if uncertainty is None else uncertainty.to(depth_m)
    refined = refine(evidence, members, depth_m, left_01, options.config) if options.config.crisp else None
    prior_error, confidence, support = _error_of(members), None, None
    if refined is not None:
        depth_m = refined.depth_m.clamp(max=_farthest_m(evidence, options.config))
        if uncertainty is not None:
            uncertainty = _spread_of_members(evidence, members, depth_m, left_01, options)
        spread = None if uncertainty is None else uncertainty / depth_m
        confidence, support = depth_confidence(refined.grounds, spread, prior_error), refined.support
        del refined  # maps of the size of the image, which large ones need room for
    visible, error = reprojection(native.views, depth_m, left_01, K) if native.views else (None, None)
    relative = median(joined([member.relative for member in members]), 0)[None]
    measured = _Measured(depth_m, relative, confidence, _over_prior(members, depth_m), visible)
    numbers = read_numbers(_numbers(evidence, members, measured, options))
    verdict = judge(_indicators(evidence, numbers, options))
    if confidence is not None:
        confidence = confidence * _share_kept(evidence, depth_m, K[0], verdict.indicators, options.config)
    return ImageResult(
        evidence=evidence,
        depth_m=depth_m,
        K=K[0],
        relative=_resized(relative, image_size(depth_m), antialias=False),
        scale=joined([member.affine.scale for member in members]),
        shift=joined([member.affine.shift for member in members]),
        global_scale=joined([member.affine.g_s for member in members]),
        verdict=verdict,
        visible_share=numbers.get("visible", 1.0),
        uncertainty=uncertainty,
        visible=visible,
        photometric_error=error,
        confidence=confidence,
        support=support,
        prior_error=prior_error,
        over_prior=measured.over_prior,
    )


def _share_kept(
    evidence: Evidence, depth_m: Tensor, K: Tensor, found: Indicators, config: GuidanceConfig
) -> Tensor:
    """Share ``(1, 1, H, W)`` of a confidence that stays by what its whole run shows; 0 where no depth is."""
    native, misfit = evidence.native, misfit_of(found, evidence.native.size)
    share = points_agreement(found) * (depth_m < _farthest_m(evidence, config))
    return share if misfit == NO_MISFIT else share * share_left(depth_m, K, native.views, misfit)


def _resized(x: Tensor, size: tuple[int, int], antialias: bool = True) -> Tensor:
    if image_size(x) == size:
        return x
    return F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=antialias)


def _within_range(depth_m: Tensor, members: Sequence[Member]) -> Tensor:
    """A map clamped, in place, to the range of the members that it was made of: resizing may overshoot."""
    near_m, far_m = (joined([getattr(m, name) for m in members]).to(depth_m) for name in ("near_m", "far_m"))
    if len(members) > 1:
        near_m, far_m = near_m.amin(0, keepdim=True), far_m.amax(0, keepdim=True)
    return depth_m.clamp_(near_m, far_m)


def _farthest_m(evidence: Evidence, config: GuidanceConfig) -> float:
    """Metres that a result is clamped to, and from which on there is no depth: confidence is 0.

    It is what the cameras can measure, or the far end of the range that the user gave, if that is further;
    infinity without a second view. Matches at infinity pull a fit without bound, in log depth, wherever
    nothing else holds it.
    """
    if evidence.volume is None:
        return math.inf
    _, reach_m = evidence.volume.reach_m
    return reach_m if config.depth_range is None else max(reach_m, config.depth_range[1])


def _mean(members: Sequence[Member], name: str) -> Tensor | None:
    """Mean of what was measured of each member, ``(1, 1, h, w)``; ``None`` where nothing was."""
    values = [value for member in members if (value := getattr(member, name)) is not None]
    if len(values) > 1:
        return torch.cat(values).float().mean(0, keepdim=True)
    return values[0].float() if values else None


def _error_of(members: Sequence[Member]) -> Tensor | None:
    """Error of the prior in log depth, ``local_error`` of the members' mean."""
    return local_error(_mean(members, "error"), _mean(members, "valid"))


def refine(
    evidence: Evidence, members: Sequence[Member], depth_m: Tensor, left_01: Tensor, config: GuidanceConfig
) -> Refined | None:
    """Sharpen the edges of a map of these members, fit it to its matches, let these vote, and flatten it.

    Edges are sharpened first: then the fit does not carry the depth of one surface over to the next. Strips
    that a nearer surface hides from the right view are fitted to the depth behind it, which the grounds of
    confidence do not count as matches. Walls are flattened last, as votes make patches of a wall whose
    matches are not precise.
    ``left_01 (1, 3, H, W)`` has the size of the map. ``None`` if there are neither matches nor points.
    """
    matches, points = Matches.stack([evidence.matches]), Matches.stack([evidence.points])
    if matches is None and points is None:
        return None
    weight, error = _mean(members, "reflection_weight"), _error_of(members)
    spacing, denoised_m = max(image_size(depth_m)) / max(image_size(members[0].relative)), depth_m
    depth_m = sharpen_edges(depth_m, left_01, max(1, round(spacing)))
    target = correction_target(matches, points, weight, error, depth_m)
    if target is None or error is None:
        return None
    strips = None if matches is None else _hidden_strips(evidence, target.size)
    if strips is not None:
        target = with_hidden(target, strips)
    fit = fit_depth(depth_m, target, evidence.native.left_01[None], error, config)
    fitted_m, support = fit.depth_m, fit.support
    if matches is not None:
        measured = error.amin((2, 3), keepdim=True)  # its value where the prior gives a depth
        target = correction_target(matches, points, weight, error, fitted_m)
        assert target is not None  # there are matches
        completed = target if strips is None else with_hidden(target, strips)
        known = known_share(completed)
        fitted_m = vote_depth(fitted_m, evidence, completed, known, measured, spacing)
        fitted_m = flatten(fitted_m, completed, left_01, measured, denoised_m)
        support = fit.support * determined(known, image_size(fit.support))
    return Refined(fitted_m, support, grounds_of(denoised_m, fitted_m, target, fit.support))


def _hidden_strips(evidence: Evidence, size: tuple[int, int]) -> HiddenStrips | None:
    """What lies behind nearer surfaces, on a grid; ``None`` where no rows of the image were matched."""
    if evidence.rows is None:
        return None
    rows, native = evidence.rows.result(), evidence.native
    focal_px = float(native.K_left[0, 0]) * rows.shift.shape[1] / native.size[1]
    return hidden_strips(rows, size, focal_px)


def _member_at(size: tuple[int, int], member: Member, like: Tensor, options: ResultOptions) -> Tensor:
    """A member's map ``(1, 1, H, W)`` metres at a size, resized as the stock call resizes the ensemble's."""
    depth_m = member.depth_m.to(like)
    if image_size(depth_m) == size:
        return depth_m
    resized = MarigoldImageProcessor.resize_antialias(depth_m, size, options.resampling, is_aa=False)
    return _within_range(resized, [member])


def _one_map(
    members: Sequence[Member], depth_m: Tensor, uncertainty: Tensor | None, options: ResultOptions
) -> tuple[Tensor, Tensor | None]:
    """The map and the spread of an ensemble: as the stock call reduced it, or reduced at the map's size."""
    if options.config.ensemble_at == "processing" or len(members) == 1:
        return _within_range(depth_m, members), uncertainty
    maps = torch.cat([_member_at(image_size(depth_m), member, depth_m, options) for member in members])
    lower = options.config.even_ensemble == "lower"
    reduced_m, spread_m = ensemble_metric(maps, options.reduction, lower)
    return reduced_m, None if uncertainty is None else spread_m


def _spread_of_members(
    evidence: Evidence, members: Sequence[Member], depth_m: Tensor, left_01: Tensor, options: ResultOptions
) -> Tensor:
    """Spread of the members, each refined like ``depth_m``, around it, ``(1, 1, H, W)`` metres."""
    size, refined_m = image_size(depth_m), []
    for member in members:
        member_m = _member_at(size, member, depth_m, options)
        refined = refine(evidence, [member], member_m, left_01, options.config)
        assert refined is not None  # as the map of all members
        refined_m.append(refined.depth_m)
    return spread_around(depth_m, torch.cat(refined_m), options.reduction)


def _over_prior(members: Sequence[Member], depth_m: Tensor) -> Tensor | None:
    """``(E, h w)`` ratio of a map to a metric prior's own depth, on the prior's grid."""
    priors_m = [member.prior_depth_m for member in members if member.prior_depth_m is not None]
    if len(priors_m) < len(members):
        return None
    resized = F.interpolate(depth_m, priors_m[0].shape[-2:], mode="bilinear", align_corners=False)
    return (resized / joined(priors_m).clamp_min(LEAST_M)).flatten(1)


class _Measured(NamedTuple):
    """Maps of one image that its indicators are measured on."""

    depth_m: Tensor
    relative: Tensor
    confidence: Tensor | None
    over_prior: Tensor | None
    visible: Tensor | None


def _numbers(
    evidence: Evidence, members: Sequence[Member], measured: _Measured, options: ResultOptions
) -> dict[str, Tensor]:
    """What is to be read from the device of one image; if its run used no matches, they are made here."""
    correlations = [m.rank_correlation for m in members if m.rank_correlation is not None]
    together = joined(correlations)
    numbers = {"rank_correlation": together.nanmean() if len(together) > 1 else together[0]}
    if evidence.matches is None and evidence.native.views:
        with suppress(InputError):  # views without overlap: not judged
            matches = _matched(evidence, options.config)
            evidence = replace(evidence, matches=matches, points=None)
            correlation = order_agreement(measured.relative, matches, members[0].metric.space)
            numbers["rank_correlation"] = correlation.mean()
    edges = [m.on_edge for m in members if m.on_edge is not None]
    if edges:
        numbers["on_edge"] = joined(edges).any()
    if measured.confidence is not None:
        numbers["confidence"] = measured.confidence.mean()
    if measured.over_prior is not None and options.has_unit:
        numbers["prior_ratio"] = measured.over_prior.median()
    if measured.visible is not None:
        numbers["visible"] = measured.visible.float().mean()
    return numbers | measure_indicators(evidence, measured.depth_m, options.config.depth_range is not None)


def _indicators(evidence: Evidence, numbers: Mapping[str, float], options: ResultOptions) -> Indicators:
    names = ("rank_correlation", "confidence", "prior_ratio")
    further: dict[str, Any] = {name: numbers[name] for name in names if name in numbers}
    on_edge = numbers.get("on_edge", 0.0) > 0
    return indicators_of(
        evidence,
        numbers,
        options.has_unit,
        on_edge=on_edge,
        doubts=options.doubts,
        centre_assumed=options.centre_assumed,
        range_given=options.config.depth_range is not None,
        **further,
    )


def _matched(evidence: Evidence, config: GuidanceConfig) -> Matches:
    """Matches of an image whose configuration asks for none."""
    volume = evidence.volume
    if volume is None:
        volume = build_cost_volume(evidence.native, depth_range=config.depth_range, config=config)
    return match_volume(volume)
