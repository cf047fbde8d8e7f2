"""Phase 3 for one image: turns the maps of its ensemble into full-size depth, confidence and a verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from torch import Tensor

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.match_fitting import fit_depth, fit_target, local_error
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.cameras import Camera, resized_mask
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching import Matches, build_cost_volume, known_fraction, match_volume
from geodiff_plugin.matching.matches import HalfOcclusions
from geodiff_plugin.matching.planes import parallax_of
from geodiff_plugin.matching.rows import half_occlusions, with_occluded
from geodiff_plugin.result.confidence import (
    RIGHT_WITHIN,
    data_support,
    depth_confidence,
    features_of,
    reprojection,
)
from geodiff_plugin.result.ensemble import ensemble_metric, median, spread_around
from geodiff_plugin.result.expected_error import MATCH_NOISE_PX, remaining_confidence
from geodiff_plugin.result.median import filter_depth
from geodiff_plugin.result.planar import flatten
from geodiff_plugin.result.records import ConfidenceFeatures
from geodiff_plugin.scale.points import depth_span, order_agreement
from geodiff_plugin.scale.space import cat_samples
from geodiff_plugin.trust import (
    NO_ERROR,
    Call,
    FactSheet,
    ResultStage,
    Verdict,
    confidence_factor,
    judge,
    match_error,
    measure_result,
)

#: Minimum depth of a metric prior, metres: its nearest pixel may be 0.
MIN_DEPTH_M = 1e-6
#: Upper bound on the confidence of depth at pixels that are not valid, where nothing was measured.
FILL_CONFIDENCE = 0.05


@dataclass(frozen=True)
class ResultOptions:
    """Options of a call that affect its results."""

    config: GuidanceConfig
    resampling: str = "bilinear"  # of ensemble members, like the pipeline's for its result
    reduction: str = "median"  # of the ensemble, or ``"mean"``
    call: Call = Call()  # inputs of the call's checks
    fill: bool = False  # whether pixels that are not valid get a depth


@dataclass(frozen=True, eq=False)
class ImageResult:
    """All results for one image; fields that do not apply are ``None``.

    Maps are ``(1, 1, H, W)``, the size of ``depth_m``. Tensors are on the device of the call.
    """

    evidence: Evidence
    depth_m: Tensor  # metres
    camera: Camera  # of ``depth_m``
    relative: Tensor  # the prior's map, about [0, 1]
    scale: Tensor  # (E,) of the ensemble members
    shift: Tensor  # (E,)
    global_scale: Tensor  # (E,) metres
    verdict: Verdict
    uncertainty: Tensor | None = None  # metres
    visible: Tensor | None = None  # bool, whether a right view sees the pixel
    photometric_error: Tensor | None = None  # [0, 1]
    confidence: Tensor | None = None  # [0, 1]
    support: Tensor | None = None  # [0, 1]
    prior_error: Tensor | None = None  # (1, 1, 1, 1), or per pixel, log depth
    over_prior: Tensor | None = None  # (E, h w) ratio to a metric prior's depth, NaN where not valid
    measurable_m: Tensor | None = None  # (1,) metres, farthest measurable depth


class Refined(NamedTuple):
    """A map ``(1, 1, H, W)`` metres fitted to its matches and points, and its data support."""

    depth_m: Tensor
    support: Tensor
    features: ConfidenceFeatures  # confidence features


class _Maps(NamedTuple):
    """Full-size maps ``(1, 1, H, W)`` of a result; the last two are ``None`` without matches and points."""

    depth_m: Tensor
    uncertainty: Tensor | None  # metres; ``None`` if not requested
    confidence: Tensor | None = None
    support: Tensor | None = None


class _CheckedMaps(NamedTuple):
    """Maps of one image that the checks use."""

    result: _Maps
    relative: Tensor
    visible: Tensor | None
    over_prior: Tensor | None
    prior_error: Tensor | None


def finish(
    evidence: Evidence,
    members: Sequence[Member],
    depth_m: Tensor,
    uncertainty: Tensor | None,
    options: ResultOptions,
) -> ImageResult:
    """Compute the result of one image.

    Args:
        evidence: evidence of the image, from phase 1.
        members: ensemble members, from phase 2.
        depth_m: ``(1, 1, H, W)`` metres, the reduced ensemble, at any size; changed in place.
        uncertainty: ``(1, 1, H, W)`` metres, the ensemble spread; ``None`` if not requested.
        options: options of the call.
    """
    native = evidence.native
    depth_m = depth_m.float().to(native.left.image_01.device)
    maps = _one_map(members, depth_m, uncertainty, options)
    del depth_m, uncertainty  # freed when they are refined, to save memory
    left = native.left.resized(image_size(maps.depth_m))
    maps = _refined(maps, evidence, members, left.image_01[None], options)
    visible, error = reprojection(native.rights, maps.depth_m, left) if native.rights else (None, None)
    relative = median(cat_samples([member.relative for member in members]), 0)[None]
    over_prior = _over_prior(members, maps.depth_m, left.valid)
    checked = _CheckedMaps(maps, relative, visible, over_prior=over_prior, prior_error=_error_of(members))
    stage = _stage(evidence, members, checked, options)
    verdict = judge(evidence.facts.of_call(options.call) | measure_result(stage))
    if maps.confidence is not None:
        factor = _remaining(evidence, maps.depth_m, left.camera, verdict.facts, options.config)
        maps = maps._replace(confidence=maps.confidence * factor)
    if left.valid is not None:
        maps = _masked(maps, left.valid, options.fill)
    return ImageResult(
        evidence=evidence,
        **maps._asdict(),
        camera=left.camera,
        relative=_resized(relative, image_size(maps.depth_m), antialias=False),
        scale=cat_samples([member.affine.scale for member in members]),
        shift=cat_samples([member.affine.shift for member in members]),
        global_scale=cat_samples([member.affine.g_s for member in members]),
        verdict=verdict,
        visible=visible,
        photometric_error=error,
        prior_error=checked.prior_error,
        over_prior=checked.over_prior,
        measurable_m=_measurable_m(evidence, maps.depth_m),
    )


def _refined(
    maps: _Maps, evidence: Evidence, members: Sequence[Member], left_01: Tensor, options: ResultOptions
) -> _Maps:
    """Refine depth, and add confidence and data support; unchanged if there is nothing to fit it to."""
    refined = refine(evidence, members, maps.depth_m, left_01, options.config)
    if refined is None:
        return maps
    depth_m = refined.depth_m.clamp(max=_farthest_m(evidence, options.config))
    uncertainty = maps.uncertainty
    if uncertainty is not None:
        uncertainty = _spread_of_members(evidence, members, depth_m, left_01, options)
    spread = None if uncertainty is None else uncertainty / depth_m
    confidence = depth_confidence(refined.features, spread, _error_of(members))
    certainty = _mean(members, "certainty")
    if certainty is not None:
        confidence = confidence * F.interpolate(certainty, image_size(confidence), mode="bilinear")
    return _Maps(depth_m, uncertainty, confidence, refined.support)


def _masked(maps: _Maps, valid: Tensor, fill: bool) -> _Maps:
    """Set depth, uncertainty and confidence to 0 where pixels are not ``valid (H, W)``, or ``fill`` them."""
    confidence, uncertainty = maps.confidence, maps.uncertainty
    if fill:
        if confidence is not None:
            confidence = torch.where(valid, confidence, confidence.clamp_max(FILL_CONFIDENCE))
        return maps._replace(confidence=confidence)
    return maps._replace(
        depth_m=torch.where(valid, maps.depth_m, 0.0),
        uncertainty=None if uncertainty is None else torch.where(valid, uncertainty, 0.0),
        confidence=None if confidence is None else torch.where(valid, confidence, 0.0),
    )


def _remaining(
    evidence: Evidence, depth_m: Tensor, camera: Camera, facts: FactSheet, config: GuidanceConfig
) -> Tensor:
    """Compute the factor ``(1, 1, H, W)`` on confidence from the image's facts; 0 where there is no depth."""
    native = evidence.native
    error = match_error(facts)
    factor = confidence_factor(facts) * (depth_m < _farthest_m(evidence, config))
    return (
        factor if error == NO_ERROR else factor * remaining_confidence(depth_m, camera, native.rights, error)
    )


def _resized(x: Tensor, size: tuple[int, int], antialias: bool = True) -> Tensor:
    if image_size(x) == size:
        return x
    return F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=antialias)


def _within_range(depth_m: Tensor, members: Sequence[Member]) -> Tensor:
    """Clamp a map, in place, to the range of its members: resizing may overshoot."""
    near_m, far_m = (
        cat_samples([getattr(m, name) for m in members]).to(depth_m) for name in ("near_m", "far_m")
    )
    if len(members) > 1:
        near_m, far_m = near_m.amin(0, keepdim=True), far_m.amax(0, keepdim=True)
    return depth_m.clamp_(near_m, far_m)


def _farthest_m(evidence: Evidence, config: GuidanceConfig) -> float:
    """Return the distance in metres that a result is clamped to and beyond which confidence is 0.

    This is the limit of what the cameras can measure, or the far end of the given depth range if it is
    farther; infinity without a second view. Matches at infinity would otherwise increase log depth without
    bound where nothing else constrains the fit.
    """
    if evidence.volume is None:
        return math.inf
    _, reach_m = evidence.volume.reach_m
    return reach_m if config.depth_range is None else max(reach_m, config.depth_range[1])


def _measurable_m(evidence: Evidence, like: Tensor) -> Tensor | None:
    """Return the farthest depth ``(1,)`` in metres that a good match or a known point determines within 10 %.

    At that depth the noise of a good match is 10 % of the median pixel's shift. ``None`` without a second
    view.
    """
    if evidence.volume is None:
        return None
    shift_px = MATCH_NOISE_PX / RIGHT_WITHIN
    of_views_m = max(1.0 / view.inverse_depth_at(shift_px) for view in parallax_of(evidence.native))
    if evidence.points is None:
        return like.new_full((1,), of_views_m)
    _, of_points_m = depth_span(evidence.points)
    return of_points_m.clamp_min(of_views_m)[None]


def _mean(members: Sequence[Member], name: str) -> Tensor | None:
    """Average a measurement of the members, ``(1, 1, h, w)`` of any size; ``None`` if none has it."""
    values = [value for member in members if (value := getattr(member, name)) is not None]
    if len(values) > 1:
        return torch.cat(values).float().mean(0, keepdim=True)
    return values[0].float() if values else None


def _error_of(members: Sequence[Member]) -> Tensor | None:
    """Return the prior's error in log depth, the ``local_error`` of the members' mean."""
    return local_error(_mean(members, "error"), _mean(members, "valid"))


def refine(
    evidence: Evidence, members: Sequence[Member], depth_m: Tensor, left_01: Tensor, config: GuidanceConfig
) -> Refined | None:
    """Sharpen the edges of a map, fit it to its matches, filter it, and regularize planes.

    Edges are sharpened first, so that the fit does not spread the depth of one surface to the next.
    Half-occlusions are fitted to the depth of the background; the confidence features do not count them as
    matches. Planar regularization comes last, since filtering makes patches on walls with imprecise matches.
    ``left_01 (1, 3, H, W)`` has the size of the map. ``None`` without ``config.refine_edges``, or if there
    are neither matches nor points.
    """
    matches, points = Matches.stack([evidence.matches]), Matches.stack([evidence.points])
    if not config.refine_edges or (matches is None and points is None):
        return None
    weight, error = _mean(members, "match_weight"), _error_of(members)
    pixels_per_cell = max(image_size(depth_m)) / max(image_size(members[0].relative))
    sharp_m = sharpen_edges(depth_m, left_01, max(1, round(pixels_per_cell)))
    target = fit_target(matches, points, weight, error, sharp_m)
    if target is None or error is None:
        return None
    occlusions = None if matches is None else _half_occlusions_on(evidence, target.size)
    completed = target if occlusions is None else with_occluded(target, occlusions)
    own_scale = _mean(members, "own_scale")
    fit = fit_depth(sharp_m, completed, evidence.native.left.image_01[None], error, config, own_scale)
    if matches is None:
        return Refined(fit.depth_m, fit.support, features_of(depth_m, fit.depth_m, completed, fit.support))
    # Selected again, because the fit has moved the edges next to which matches are left out.
    target = fit_target(matches, points, weight, error, fit.depth_m)
    assert target is not None  # there are matches
    completed = target if occlusions is None else with_occluded(target, occlusions)
    known = known_fraction(completed)
    of_prior = error.amin((2, 3), keepdim=True)  # value where the prior gives a depth
    filtered_m = filter_depth(fit.depth_m, evidence, completed, known, of_prior, pixels_per_cell)
    flat_m = flatten(filtered_m, completed, left_01, of_prior, depth_m)
    support = fit.support * data_support(known, image_size(fit.support))
    return Refined(flat_m, support, features_of(depth_m, flat_m, target, fit.support))


def _half_occlusions_on(evidence: Evidence, size: tuple[int, int]) -> HalfOcclusions | None:
    """Return the half-occlusions on a grid; ``None`` if no rows of the image were matched."""
    if evidence.rows is None:
        return None
    rows = evidence.rows
    left = evidence.native.left
    focal_px = float(left.camera.K[0, 0]) * rows.shift.shape[1] / left.size[1]
    return half_occlusions(rows, size, focal_px)


def _member_at(size: tuple[int, int], member: Member, like: Tensor, options: ResultOptions) -> Tensor:
    """Resize a member's map to ``(1, 1, H, W)`` metres, as the stock call resizes the ensemble's."""
    depth_m = member.depth_m.to(like)
    if image_size(depth_m) == size:
        return depth_m
    resized = MarigoldImageProcessor.resize_antialias(depth_m, size, options.resampling, is_aa=False)
    return _within_range(resized, [member])


def _one_map(
    members: Sequence[Member], depth_m: Tensor, uncertainty: Tensor | None, options: ResultOptions
) -> _Maps:
    """Return map and spread of an ensemble, as reduced by the stock call or reduced at the map's size."""
    if options.config.ensemble_at == "processing" or len(members) == 1:
        return _Maps(_within_range(depth_m, members), uncertainty)
    maps = torch.cat([_member_at(image_size(depth_m), member, depth_m, options) for member in members])
    lower = options.config.even_ensemble == "lower"
    reduced_m, spread_m = ensemble_metric(maps, options.reduction, lower)
    return _Maps(reduced_m, None if uncertainty is None else spread_m)


def _spread_of_members(
    evidence: Evidence, members: Sequence[Member], depth_m: Tensor, left_01: Tensor, options: ResultOptions
) -> Tensor:
    """Refine each member like ``depth_m`` and compute the spread around it, ``(1, 1, H, W)`` metres."""
    size = image_size(depth_m)
    refined_m = []
    for member in members:
        member_m = _member_at(size, member, depth_m, options)
        refined = refine(evidence, [member], member_m, left_01, options.config)
        assert refined is not None  # like the map of all members
        refined_m.append(refined.depth_m)
    return spread_around(depth_m, torch.cat(refined_m), options.reduction)


def _over_prior(members: Sequence[Member], depth_m: Tensor, valid: Tensor | None) -> Tensor | None:
    """Compute the ratio ``(E, h w)`` of a map to a metric prior's own depth, on the prior's grid.

    NaN where pixels are not ``valid (H, W)`` bool, since nothing but the prior gives a depth there.
    """
    priors_m = [member.prior_depth_m for member in members if member.prior_depth_m is not None]
    if len(priors_m) < len(members):
        return None
    resized = F.interpolate(depth_m, priors_m[0].shape[-2:], mode="bilinear", align_corners=False)
    ratio = resized / cat_samples(priors_m).clamp_min(MIN_DEPTH_M)
    if valid is not None and bool((inside := resized_mask(valid, image_size(ratio))).any()):
        ratio = torch.where(inside, ratio, torch.nan)
    return ratio.flatten(1)


def _stage(
    evidence: Evidence, members: Sequence[Member], maps: _CheckedMaps, options: ResultOptions
) -> ResultStage:
    """Collect the inputs of the checks; matches are computed here if the run used none."""
    correlations = [m.rank_correlation for m in members if m.rank_correlation is not None]
    correlations_of_members = cat_samples(correlations)
    correlation = (
        correlations_of_members.nanmean() if len(correlations_of_members) > 1 else correlations_of_members[0]
    )
    matches, points = evidence.matches, evidence.points
    if matches is None and evidence.native.rights:
        with suppress(InputError):  # views without overlap are not assessed
            matches = _match(evidence, options.config)
            points = None
            correlation = order_agreement(maps.relative, matches, members[0].metric.space).mean()
    edges = [m.on_edge for m in members if m.on_edge is not None]
    volume = evidence.volume
    return ResultStage(
        options.call,
        evidence.native,
        matches,
        points,
        maps.result.depth_m,
        planes=None if volume is None else volume.inverse_depth,
        points_outside=evidence.points_outside,
        confidence=maps.result.confidence,
        visible=maps.visible,
        rank_correlation=correlation,
        prior_error=None if maps.prior_error is None else maps.prior_error.amin(),
        on_edge=cat_samples(edges).any() if edges else None,
        over_prior=maps.over_prior,
    )


def _match(evidence: Evidence, config: GuidanceConfig) -> Matches:
    """Match an image whose configuration needs no matches."""
    volume = evidence.volume
    if volume is None:
        volume = build_cost_volume(evidence.native, depth_range=config.depth_range, config=config)
    return match_volume(volume)
