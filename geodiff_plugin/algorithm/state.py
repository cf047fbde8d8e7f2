"""``Trajectory``: scale, shift, g_s, optimizers and matches of a chunk of samples, step by step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate, groupby
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.depth_range import (
    fit_depth_range,
    refit_depth_range,
    search_one_number,
    span_of_points,
    within_range,
)
from geodiff_plugin.algorithm.map_error import regional_error
from geodiff_plugin.algorithm.match_fitting import (
    MeasuredError,
    fit_depth,
    fit_target,
    local_error,
    measure_error,
)
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS, SUMMED, FiniteWatch
from geodiff_plugin.algorithm.terms import Given, Loss, Objective
from geodiff_plugin.cameras import PosedViews, valid_pixels
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches, reject_reflections
from geodiff_plugin.matching.repetition import settle
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.scale.space import DepthRange, MetricMap, PriorMaps, cat_samples
from geodiff_plugin.types import StepReport

#: Number of times that the scale of a given map is refined without reflections: each finds further ones.
REFITS = 2
#: Maximum error of a given map with its own scale, relative to its error with the fitted one, with which it
#: keeps its own scale.
OWN_ERROR = 1.1
#: Maximum median difference in log depth between both scales with which it keeps its own.
OWN_DIFFERENCE = 0.07


def _samples_of_images(image_of_sample: Sequence[int]) -> list[slice]:
    """Return the samples of every image as slices; samples of one image are consecutive."""
    counts = [len(list(samples)) for _, samples in groupby(image_of_sample)]
    return [slice(last - count, last) for count, last in zip(counts, accumulate(counts), strict=True)]


def chunk_views(evidence: Sequence[Evidence]) -> list[PosedViews]:
    """Return the views of every sample of a chunk on the evidence grid, equal in number and size.

    An image with fewer views than another repeats its first one. The terms use the best view of each pixel,
    so repetition changes nothing.
    """
    grids = [image.grid for image in evidence]
    columns = []
    for v in range(max(len(grid.rights) for grid in grids)):
        views = [grid.rights[v if v < len(grid.rights) else 0] for grid in grids]
        height, width = (max(view.size[axis] for view in views) for axis in (0, 1))
        columns.append([view.resized((height, width)) for view in views])
    rights = zip(*columns, strict=True) if columns else [()] * len(grids)
    return [PosedViews(grid.left, tuple(views)) for grid, views in zip(grids, rights, strict=True)]


def _valid_maps(valid: Tensor | None, evidence: Sequence[Evidence]) -> Tensor | None:
    """Return where the prior gives a depth and the left image is valid, ``(B, 1, h, w)`` bool."""
    images = valid_pixels([sample.grid.left for sample in evidence])
    if images is None:
        return valid
    if valid is None:
        return images
    return F.interpolate(valid.float(), images.shape[-2:], mode="nearest-exact").bool() & images


class StepTime(NamedTuple):
    """Index and timestep of a denoising step."""

    number: int  # index in the schedule, from 0
    timestep: float  # of the scheduler


class Trajectory:
    """State of one chunk of samples throughout the schedule.

    Args:
        config: the hyperparameters.
        evidence: evidence of every image of the call.
        image_of_sample: image index of each sample of the chunk; samples of one image are consecutive.
        maps: known properties of the prior's maps.
        lr_latents: step size of a gradient update of the latent.
    """

    affine: AffineState  # after the latest update; set by ``find_scale``
    match_weight: Tensor | None = None  # (B, 1, H, W), factor on the confidence of matches
    certainty: Tensor | None = None  # (B, 1, H, W), ``Settled.certainty`` of the first estimate
    own_scale: Tensor | None = None  # (B, 1, 1, 1), 1 for given maps that keep their own scale, else 0
    error: Tensor | None = None  # (B, 1, 1, 1), ``prior_error`` of the first estimate; per pixel if given
    occluded: Tensor | None = None  # (B, V, 1, H, W) bool, pixels occluded in the right views
    rank_correlation: Tensor | None = None  # (B,), of the prior's first map with matches or points
    prior_depth_m: Tensor | None = None  # (B, 1, h, w) metres, a metric prior's first estimate
    on_edge: Tensor | None = None  # (B,) bool, whether the last search ended at the edge of its range

    def __init__(
        self,
        config: GuidanceConfig,
        evidence: Sequence[Evidence],
        image_of_sample: Sequence[int],
        maps: PriorMaps,
        lr_latents: float = 0.0,
    ) -> None:
        self.evidence = [evidence[image] for image in image_of_sample]  # one per sample
        self.config = config
        self.maps = replace(maps, valid=_valid_maps(maps.valid, self.evidence))
        self.metric = MetricMap(maps.space, config.positive)
        self.objective = Objective(chunk_views(self.evidence), self.metric, config)
        self.matches = Matches.stack([e.matches for e in self.evidence])
        self.points = Matches.stack([e.points for e in self.evidence])
        pixels = math.prod(self.objective.size) if config.optimizer == SUMMED else 1
        self.latent_optimizer = OPTIMIZERS[config.optimizer](lr_latents * pixels)
        self.scale_optimizer, self.shift_optimizer = (
            OPTIMIZERS[config.optimizer](config.lr_affine) for _ in range(2)
        )
        self._images = _samples_of_images(image_of_sample)
        self._affine_start: AffineState | None = None  # search result, target of the affine regularization
        self.history: list[StepReport] = []
        self.watch = FiniteWatch()
        self.step = StepTime(0, 0.0)

    def record(self, name: str, tensor: Tensor) -> None:
        """Record whether a tensor of this step is finite."""
        self.watch.record(name, self.step.number, tensor)

    def prepare(self, x: Tensor, z0: Tensor) -> None:
        """Find the scale of an estimate ``x``, decoded from ``z0``; the first call also assesses matches."""
        self.record("the network's clean latent", z0)
        self.record("the decoded map", x)
        if self.maps.depth_range is not None and self.prior_depth_m is None:
            near_m, far_m, _ = self.maps.depth_range
            self.prior_depth_m = self.metric(x, self.metric.from_range(near_m, far_m))
        if self.rank_correlation is None:
            self.rank_correlation = self._rank_correlation(x)
        self.find_scale(x)
        self._assess_matches(x)

    def find_scale(self, x: Tensor) -> None:
        """Search g_s and the initial scale and shift of a relative map (S7.3), or refine the current ones.

        A given map is the same at every step, and its first scale is better, because it is chosen with
        weighted matches.
        """
        is_first = self._affine_start is None
        if self.maps.given and not is_first:
            return
        if self.config.search == "volume":
            current = self.maps.depth_range
            if not is_first:
                current = DepthRange(*self.metric.range_of(self.affine), self.on_edge)
            near_m, far_m, self.on_edge = self._fitted_range(x, current)
            self.affine = self._affine_start = self.metric.from_range(near_m, far_m)
        elif is_first:
            if self.config.search == "one-number":
                start, self.on_edge = search_one_number(x, self.objective)
            else:
                near_m, far_m, self.on_edge = span_of_points(self.evidence)
                start = self.metric.from_range(near_m, far_m)
            self.affine = self._affine_start = start

    def _fitted_range(self, x: Tensor, current: DepthRange | None) -> DepthRange:
        """Run ``fit_depth_range`` for every image."""
        ranges = []
        for samples, evidence in zip(self._images, self._valid_evidence, strict=True):
            before = None if current is None else current.of(samples)
            valid = None if self.maps.valid is None else self.maps.valid[samples][:1]
            ranges.append(fit_depth_range(x[samples], evidence, self.metric, self.config, before, valid))
        near_m, far_m, on_edge = (cat_samples(values) for values in zip(*ranges, strict=True))
        return DepthRange(near_m, far_m, on_edge)

    @cached_property
    def _valid_evidence(self) -> list[Evidence]:
        """Evidence of every image, restricted to pixels with a prior depth."""
        firsts = [samples.start for samples in self._images]
        valid = self.maps.valid
        if valid is None:
            return [self.evidence[first] for first in firsts]
        return [self.evidence[first].within(valid[first]) for first in firsts]

    def _rank_correlation(self, x: Tensor) -> Tensor:
        """Compute the rank correlation ``(B,)`` of the prior with matches or points; NaN for too few."""
        correlations = []
        for samples, evidence in zip(self._images, self._valid_evidence, strict=True):
            target = evidence.matches or evidence.points
            of_image = x[samples]
            if target is None:
                correlations.append(x.new_full((len(of_image),), torch.nan))
            else:
                correlations.append(order_agreement(of_image, target, self.metric.space))
        return cat_samples(correlations)

    def _assess_matches(self, x: Tensor) -> None:
        """At the first estimate, find matches that look like reflections and measure the prior's error."""
        if self.error is not None or (self.matches is None and self.points is None):
            return
        refits = self.maps.given and self.config.search == "volume" and self.matches is not None
        if self.matches is not None and self.match_weight is None:
            self._weigh_matches(self.matches, x)
            for _ in range(REFITS if refits else 0):
                self._refit_scale(x)
                self._weigh_matches(self.matches, x)
        if not (self.config.fit_matches or self.config.refine_edges):
            return
        measured = self._measure_error(x)
        if refits and self.maps.own_range is not None:
            measured = self._with_own_scale(x, measured, self.maps.own_range)
        self.error = self._regional_error(x, measured)

    def _weigh_matches(self, matches: Matches, x: Tensor) -> None:
        """Find the matches that are reflections of the estimate ``x``, or off by a period of a pattern."""
        depth_m = self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        self.match_weight = self._weight_by_reflections(matches, depth_m)
        if (settled := settle(matches, depth_m)) is not None:
            self.match_weight = self.match_weight * settled.weight
            self.certainty = settled.certainty

    def _refit_scale(self, x: Tensor) -> None:
        """Refine the scale of given maps with the weights of the matches; synchronizes with the device.

        A sky that a map places too near is fitted at first, and shifts all other depths.
        """
        assert self.match_weight is not None  # set by _weigh_matches
        current = DepthRange(*self.metric.range_of(self.affine), self.on_edge)
        ranges = []
        for samples, evidence in zip(self._images, self._valid_evidence, strict=True):
            assert evidence.matches is not None  # every image has matches
            confidence = self.match_weight[samples.start] * evidence.matches.confidence
            matches = replace(evidence.matches, confidence=confidence)
            of_image = x[samples], matches, self.metric, self.config, current.of(samples)
            ranges.append(refit_depth_range(*of_image))
        near_m, far_m, _ = zip(*ranges, strict=True)
        self.affine = self._affine_start = self.metric.from_range(cat_samples(near_m), cat_samples(far_m))

    def _with_own_scale(self, x: Tensor, fitted: MeasuredError, own_range: DepthRange) -> MeasuredError:
        """Keep the own scale of given maps in metres that fits the matches as well as the fitted one does.

        Returns the error with the chosen scale. A fit is biased by the matches' common errors, and a good
        map in metres is more accurate than that.
        """
        assert self.matches is not None and self.match_weight is not None
        affine, weight, certainty = self.affine, self.match_weight, self.certainty
        fitted_m = self.objective.metric_depth(x, affine)
        known = own_range.near_m.isfinite()
        ends = zip(own_range[:2], self.metric.range_of(affine), strict=True)
        near_m, far_m = (torch.where(known, own, fitted) for own, fitted in ends)
        self.affine = self.metric.from_range(*within_range(near_m, far_m, self.config))
        self._weigh_matches(self.matches, x)
        own = self._measure_error(x)
        ratio = self.objective.metric_depth(x, self.affine) / fitted_m
        near_enough = known & (self._median_where_valid(ratio.log().abs()) < OWN_DIFFERENCE)
        keep = near_enough.view(-1, 1, 1, 1) & (own.error <= OWN_ERROR * fitted.error)
        self.own_scale = keep.float()
        self.affine = self._affine_start = self.affine.where(keep.flatten(), affine)
        self.match_weight = torch.where(keep, self.match_weight, weight)
        if self.certainty is not None and certainty is not None:
            self.certainty = torch.where(keep, self.certainty, certainty)
        pairs = zip(own, fitted, strict=True)
        return MeasuredError(*(torch.where(keep, of_own, of_fitted) for of_own, of_fitted in pairs))

    def _median_where_valid(self, values: Tensor) -> Tensor:
        """Return the median ``(B,)`` of ``(B, 1, H, W)`` at pixels with a prior depth, NaN without any."""
        if self.maps.valid is None:
            return values.flatten(1).median(1).values
        inside = F.interpolate(self.maps.valid.float(), values.shape[-2:], mode="nearest-exact") > 0
        return torch.stack([each[use].median() for each, use in zip(values, inside, strict=True)])

    def _measured_target(self, depth_m: Tensor) -> Matches:
        """Return the matches and points that measure the error of an estimate."""
        target = self._target(depth_m)
        assert target is not None  # there are matches or points
        return target if self.maps.valid is None else target.within(self.maps.valid)

    def _measure_error(self, x: Tensor) -> MeasuredError:
        """Measure the error of an estimate ``x``."""
        depth_m = self.objective.metric_depth(x, self.affine)
        return measure_error(depth_m, self._measured_target(depth_m), self.objective.left_01, self.config)

    def _regional_error(self, x: Tensor, measured: MeasuredError) -> Tensor:
        """Return the prior's error, ``(B, 1, 1, 1)``, or ``(B, 1, H, W)`` for a given map and two views."""
        volumes = [evidence.volume for evidence in self.evidence if evidence.volume is not None]
        if not self.maps.given or self.matches is None or len(volumes) < len(self.evidence):
            return measured.error
        target = self._measured_target(self.objective.metric_depth(x, self.affine))
        return regional_error(measured, target, volumes)

    def _weight_by_reflections(self, matches: Matches, depth_m: Tensor) -> Tensor:
        """Return the factor ``(B, 1, H, W)`` on the confidence of matches that removes reflections."""
        if not self.config.reject_reflections:
            return torch.ones_like(depth_m)
        valid = self.maps.valid
        if valid is None:
            return reject_reflections(matches, depth_m)
        weight = reject_reflections(matches.within(valid), depth_m)
        inside = F.interpolate(valid.float(), depth_m.shape[-2:], mode="nearest-exact")
        return torch.where(inside > 0, weight, 1.0)  # without a prior depth no match is a reflection

    def _target(self, depth_m: Tensor) -> Matches | None:
        error = local_error(self.error, self.maps.valid)
        return fit_target(self.matches, self.points, self.match_weight, error, depth_m)

    def find_occluded(self, x: Tensor) -> None:
        """Find the pixels of a map that are occluded in the right views, for all updates of a round."""
        compared = self.config.weights.get("photometric") and self.objective.rights_01
        if self.config.occlusion_mask and compared:
            self.occluded = self.objective.occluded(x, self.affine)

    @torch.no_grad()
    def fitted(self, x: Tensor) -> Tensor:
        """Fit a relative map ``x (B, 1, h, w)`` to matches and points; returns ``x`` if there are none."""
        depth_m = self.objective.metric_depth(x, self.affine)
        target = self._target(depth_m)
        error = local_error(self.error, self.maps.valid)
        if target is None or error is None:
            return x
        fit = fit_depth(depth_m, target, self.objective.left_01, error, self.config, self.own_scale)
        # Resample the factor: a resampled difference of maps would be wrong on both sides of an edge.
        change = F.interpolate(fit.log_change, x.shape[-2:], mode="bilinear", antialias=True)
        return self.metric.relative(self.metric(x, self.affine) * torch.exp(-change), self.affine)

    def loss(self, x: Tensor, affine: AffineState, z0: Tensor, anchor: Tensor) -> Loss:
        """Compute the loss of an estimate ``x`` with known scale, decoded from ``z0`` (``Objective``)."""
        assert self._affine_start is not None  # set by find_scale
        matches = None  # without reflections
        if self.matches is not None and self.match_weight is not None:
            matches = replace(self.matches, confidence=self.match_weight * self.matches.confidence)
        start, points, occluded = self._affine_start, self.points, self.occluded
        return self.objective(x, Given(affine, start, z0, anchor, matches, points, occluded))

    def report(self, loss: Loss | None) -> None:
        """Append a ``StepReport``; tensors stay on their device, so that nothing synchronizes."""
        report = StepReport(*self.step, self.affine.s_hat, self.affine.t_hat, self.affine.g_s)
        if loss is not None:
            terms = {name: value.detach() for name, value in loss.terms.items()}
            seen = loss.visible_fraction
            report = replace(report, loss=loss.total.detach(), terms=terms, visible_fraction=seen)
        self.history.append(report)

    def result(self, x: Tensor) -> Tensor:
        """Return the metric depth ``(B, 1, H, W)`` of the final latents' maps, on the padded grid."""
        self.record("the map of the final latent", x)
        return self.metric(x, self.affine)

    def members(self, x: Tensor, depth_m: Tensor) -> list[Member]:
        """Make the members for phase 3 from the maps ``x`` without padding and from their ``result``."""
        near_m, far_m = (end.view(-1, 1, 1, 1) for end in depth_m.flatten(1).aminmax(dim=1))
        measured = {
            "match_weight": self.match_weight,
            "certainty": self.certainty,
            "own_scale": self.own_scale,
            "error": self.error,
            "valid": self.maps.valid,
            "rank_correlation": self.rank_correlation,
            "on_edge": self.on_edge,
            "prior_depth_m": self.prior_depth_m,
        }
        return [
            Member(
                self.metric,
                self.affine.of(sample),
                relative=x[sample],
                near_m=near_m[sample],
                far_m=far_m[sample],
                **{name: None if values is None else values[sample] for name, values in measured.items()},
            )
            for sample in (slice(i, i + 1) for i in range(len(self.evidence)))
        ]
