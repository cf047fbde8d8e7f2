"""``Trajectory``: scale, shift and g_s, optimisers and matches of a chunk of samples, step by step."""

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

from geodiff_plugin.algorithm.correction import correction_target, fit_depth, local_error, prior_error
from geodiff_plugin.algorithm.depth_range import fit_depth_range, search_one_number, span_of_points
from geodiff_plugin.algorithm.gradients import RULES, SUMMED, FiniteWatch
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.algorithm.terms import Given, Loss, Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import resize_image, stacked
from geodiff_plugin.matching import Matches, reject_reflections
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.scale.space import AffineState, DepthRange, MetricMap, PriorMaps, joined
from geodiff_plugin.types import CameraView, PosedViews, StepReport


def _samples_of_images(image_of_sample: Sequence[int]) -> list[slice]:
    """The samples of every image, which lie side by side."""
    counts = [len(list(samples)) for _, samples in groupby(image_of_sample)]
    return [slice(last - count, last) for count, last in zip(counts, accumulate(counts), strict=True)]


def chunk_views(evidence: Sequence[Evidence]) -> PosedViews:
    """The views of every sample of a chunk on the grid of the evidence, images and K of one size.

    An image with fewer views than another repeats its first one: the terms take the best view of each pixel,
    so repetition changes nothing.
    """
    grids = [image.grid for image in evidence]
    further = []
    for v in range(max(len(grid.views) for grid in grids)):
        views = [grid.views[v if v < len(grid.views) else 0] for grid in grids]
        height, width = (max(view.image_01.shape[axis] for view in views) for axis in (-2, -1))
        sized = [resize_image(image, K, (height, width)) for image, K, _ in views]
        images, Ks = (stacked(each) for each in zip(*sized, strict=True))
        further.append(CameraView(images, Ks, stacked([view.T_right_from_left for view in views])))
    left_01, K_left = (stacked([getattr(g, name) for g in grids]) for name in ("left_01", "K_left"))
    return PosedViews(left_01, tuple(further), K_left)


class StepTime(NamedTuple):
    """Which denoising step it is."""

    number: int  # in the schedule, from 0
    timestep: float  # the scheduler's


class Trajectory:
    """State of one chunk of samples through the schedule.

    Args:
        config: the hyperparameters.
        evidence: of every image of the call.
        image_of_sample: the image of each sample of the chunk; those of one image lie side by side.
        maps: what is known of the prior's maps.
        step_latents: size of a gradient update of the latent.
    """

    affine: AffineState  # after the latest update; set by ``find_scale``
    reflection_weight: Tensor | None = None  # (B, 1, H, W), factor on the confidence of matches
    error: Tensor | None = None  # (B, 1, 1, 1), ``correction.prior_error`` of the first estimate
    hidden: Tensor | None = None  # (B, V, 1, H, W) bool, what the estimate hides from the right cameras
    rank_correlation: Tensor | None = None  # (B,), of the prior's first map with matches or points
    prior_depth_m: Tensor | None = None  # (B, 1, h, w) metres, a metric prior's first estimate
    on_edge: Tensor | None = None  # (B,) bool, whether the last search ended on the edge of its range

    def __init__(
        self,
        config: GuidanceConfig,
        evidence: Sequence[Evidence],
        image_of_sample: Sequence[int],
        maps: PriorMaps,
        step_latents: float = 0.0,
    ) -> None:
        self.config, self.maps = config, maps
        self.evidence = [evidence[image] for image in image_of_sample]  # of each sample
        self.metric = MetricMap(maps.space, config.positive)
        self.objective = Objective(chunk_views(self.evidence), self.metric, config)
        self.matches = Matches.stack([e.matches for e in self.evidence])
        self.points = Matches.stack([e.points for e in self.evidence])
        pixels = math.prod(self.objective.views.size) if config.rule == SUMMED else 1
        self.latent_rule = RULES[config.rule](step_latents * pixels)
        self.scale_rule, self.shift_rule = (RULES[config.rule](config.step_affine) for _ in range(2))
        self._images = _samples_of_images(image_of_sample)
        self._affine_start: AffineState | None = None  # the search's result, which the loss pulls towards
        self.history: list[StepReport] = []
        self.watch = FiniteWatch()
        self.step = StepTime(0, 0.0)

    def note(self, name: str, tensor: Tensor) -> None:
        """Remember whether a tensor of this step is finite."""
        self.watch.note(name, self.step.number, tensor)

    def prepare(self, x: Tensor, z0: Tensor) -> None:
        """Find the scale of an estimate ``x``, decoded from ``z0``; at the first one judge the matches."""
        self.note("the network's clean latent", z0)
        self.note("the decoded map", x)
        if self.maps.depth_range is not None and self.prior_depth_m is None:
            near_m, far_m, _ = self.maps.depth_range
            self.prior_depth_m = self.metric(x, self.metric.from_range(near_m, far_m))
        if self.rank_correlation is None:
            self.rank_correlation = self._rank_correlation(x)
        self.find_scale(x)
        self._judge_matches(x)

    def find_scale(self, x: Tensor) -> None:
        """Search g_s and the start of scale and shift for a relative map (S7.3), or improve those in use."""
        is_first = self._affine_start is None
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
        """``fit_depth_range`` of every image."""
        ranges = []
        for samples, judged in zip(self._images, self._judged, strict=True):
            before = None if current is None else current.of(samples)
            valid = None if self.maps.valid is None else self.maps.valid[samples][:1]
            ranges.append(fit_depth_range(x[samples], judged, self.metric, self.config, before, valid))
        near_m, far_m, on_edge = (joined(values) for values in zip(*ranges, strict=True))
        return DepthRange(near_m, far_m, on_edge)

    @cached_property
    def _judged(self) -> list[Evidence]:
        """What the prior is compared with: the evidence of every image where the prior gives a depth."""
        firsts, valid = [samples.start for samples in self._images], self.maps.valid
        if valid is None:
            return [self.evidence[first] for first in firsts]
        return [self.evidence[first].within(valid[first]) for first in firsts]

    def _rank_correlation(self, x: Tensor) -> Tensor:
        """Rank correlation ``(B,)`` of the prior alone with matches or points; NaN without enough of them."""
        correlations = []
        for samples, judged in zip(self._images, self._judged, strict=True):
            target, of_image = judged.matches or judged.points, x[samples]
            if target is None:
                correlations.append(x.new_full((len(of_image),), torch.nan))
            else:
                correlations.append(order_agreement(of_image, target, self.metric.space))
        return joined(correlations)

    def _judge_matches(self, x: Tensor) -> None:
        """At the first estimate: find matches that look like reflections, and measure the prior's error."""
        if self.error is not None or (self.matches is None and self.points is None):
            return
        depth_m = self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        if self.matches is not None and self.reflection_weight is None:
            self.reflection_weight = self._weight_by_reflections(self.matches, depth_m)
        if self.config.correct or self.config.crisp:
            target = self._target(depth_m)
            assert target is not None  # there are matches or points
            target = target if self.maps.valid is None else target.within(self.maps.valid)
            self.error = prior_error(depth_m, target, self.objective.views.left_01, self.config)

    def _weight_by_reflections(self, matches: Matches, depth_m: Tensor) -> Tensor:
        """The factor ``(B, 1, H, W)`` on the confidence of matches that removes reflections."""
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
        return correction_target(self.matches, self.points, self.reflection_weight, error, depth_m)

    def find_hidden(self, x: Tensor) -> None:
        """Find the pixels that a map hides from the right cameras, for all updates of a round."""
        compared = self.config.weights.get("photometric") and self.objective.views.views
        if self.config.z_test and compared:
            self.hidden = self.objective.hidden(x, self.affine)

    @torch.no_grad()
    def corrected(self, x: Tensor) -> Tensor:
        """A relative map ``x (B, 1, h, w)`` fitted to matches and points; ``x`` where there are neither."""
        depth_m = self.objective.metric_depth(x, self.affine)
        target, error = self._target(depth_m), local_error(self.error, self.maps.valid)
        if target is None or error is None:
            return x
        fit = fit_depth(depth_m, target, self.objective.views.left_01, error, self.config)
        # Resample the factor, not the difference of maps, which would be wrong on both sides of an edge.
        change = F.interpolate(fit.correction, x.shape[-2:], mode="bilinear", antialias=True)
        return self.metric.relative(self.metric(x, self.affine) * torch.exp(-change), self.affine)

    def loss(self, x: Tensor, affine: AffineState, z0: Tensor, anchor: Tensor) -> Loss:
        """Loss of an estimate ``x``, decoded from ``z0``, whose scale is known; as ``Objective``."""
        assert self._affine_start is not None  # of find_scale
        matches = None  # less those that look like reflections
        if self.matches is not None and self.reflection_weight is not None:
            matches = replace(self.matches, confidence=self.reflection_weight * self.matches.confidence)
        start, points, hidden = self._affine_start, self.points, self.hidden
        return self.objective(x, Given(affine, start, z0, anchor, matches, points, hidden))

    def report(self, loss: Loss | None) -> None:
        """Append a ``StepReport``; tensors stay on their device, so nothing waits for it."""
        report = StepReport(*self.step, self.affine.s_hat, self.affine.t_hat, self.affine.g_s)
        if loss is not None:
            terms = {name: value.detach() for name, value in loss.terms.items()}
            seen = loss.visible_fraction
            report = replace(report, loss=loss.total.detach(), terms=terms, visible_fraction=seen)
        self.history.append(report)

    def result(self, x: Tensor) -> Tensor:
        """Metric depth ``(B, 1, H, W)`` of the maps of the final latents, on the padded grid."""
        self.note("the map of the final latent", x)
        return self.metric(x, self.affine)

    def members(self, x: Tensor, depth_m: Tensor) -> list[Member]:
        """What act 3 gets of every sample: of the maps ``x`` without padding, and of their ``result``."""
        near_m, far_m = (end.view(-1, 1, 1, 1) for end in depth_m.flatten(1).aminmax(dim=1))
        measured = {
            "reflection_weight": self.reflection_weight,
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
