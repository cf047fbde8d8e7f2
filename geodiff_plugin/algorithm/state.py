"""``Trajectory``: scale, shift and g_s, optimisers and matches of a chunk of samples, step by step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.correction import correction_target, fit_depth, local_error, prior_error
from geodiff_plugin.algorithm.gradients import RULES, SUMMED, FiniteWatch
from geodiff_plugin.algorithm.settling import search_one_number, settle_ends, span_of_points
from geodiff_plugin.algorithm.terms import Loss, Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence, chunk_views, within
from geodiff_plugin.matching import Matches, reject_reflections
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.scale.space import AffineState, MetricMap
from geodiff_plugin.types import StepReport


class Trajectory:
    """State of one chunk of samples through the schedule.

    ``owners`` is the image of each sample; samples of one image lie side by side. The scale search starts
    from ``prior_range``, a metric prior's metres ``(B,)`` at ``x = 0`` and ``x = 1``. Where
    ``valid (B, 1, h, w)`` bool is false the prior gives no depth, and matches alone decide.
    """

    affine: AffineState  # after the latest update; set by ``settle_scale``
    kept: Tensor | None = None  # (B, 1, H, W), factor on the confidence of matches, 0 for reflections
    error: Tensor | None = None  # (B, 1, 1, 1), ``correction.prior_error`` of the first estimate
    hidden: Tensor | None = None  # (B, V, 1, H, W) bool, what the estimate hides from the right cameras
    order: Tensor | None = None  # (B,), rank correlation of the prior's first map and matches or points
    prior_depth: Tensor | None = None  # (B, 1, h, w) metres, a metric prior's first estimate
    on_edge: Tensor | None = None  # (B,) bool, whether the last search ended on the edge of its range

    def __init__(
        self,
        config: GuidanceConfig,
        evidence: Sequence[Evidence],
        owners: Sequence[int],
        space: str,
        step_latents: float = 0.0,
        prior_range: tuple[Tensor, Tensor] | None = None,
        valid: Tensor | None = None,
    ) -> None:
        self.config, self.owners, self.valid = config, list(owners), valid
        samples = self._samples = [evidence[i] for i in owners]
        self._evidence = samples  # what the prior is compared with, where it is valid
        if valid is not None:
            self._evidence = [within(e, v) for e, v in zip(samples, valid, strict=True)]
        self.metric = MetricMap(space, config.positive)
        self.objective = Objective(chunk_views(samples), self.metric, config)
        self.matches = Matches.stack([e.matches for e in samples])
        self.points = Matches.stack([e.points for e in samples])
        pixels = math.prod(self.objective.views.size) if config.rule == SUMMED else 1
        self.latent_rule = RULES[config.rule](step_latents * pixels)
        self.scale_rule, self.shift_rule = (RULES[config.rule](config.step_affine) for _ in range(2))
        # Sorted into nearest and farthest: for disparity x = 1 is the nearest.
        self._prior_range = None if prior_range is None else tuple(torch.stack(prior_range).sort(0).values)
        self._affine_start: AffineState | None = None  # the search's result, which the loss pulls towards
        self.history: list[StepReport] = []
        self.watch = FiniteWatch()
        self.step: tuple[int, float] = (0, 0.0)

    def note(self, name: str, tensor: Tensor) -> None:
        """Remember whether a tensor of this step is finite."""
        self.watch.note(name, self.step[0], tensor)

    def prepare(self, x: Tensor, z0: Tensor) -> None:
        """Find the scale of an estimate ``x``, decoded from ``z0``; at the first one judge the matches."""
        self.note("the network's clean latent", z0)
        self.note("the decoded map", x)
        if self._prior_range is not None and self.prior_depth is None:
            self.prior_depth = self.metric(x, self.metric.from_range(*self._prior_range))
        if self.order is None:
            self.order = self._order(x)
        self.settle_scale(x)
        self._judge_matches(x)

    def settle_scale(self, x: Tensor) -> None:
        """Search g_s and the start of scale and shift for a relative map (S7.3), or improve those in use."""
        is_first = self._affine_start is None
        if self.config.search == "volume":
            ends = self._prior_range if is_first else self.metric.range_of(self.affine)
            near, far, self.on_edge = settle_ends(
                x, self.owners, self._evidence, self.metric, self.config, ends, self.on_edge, self.valid
            )
            self.affine = self._affine_start = self.metric.from_range(near, far)
        elif is_first:
            if self.config.search == "one-number":
                start, self.on_edge = search_one_number(x, self.objective)
            else:
                start = self.metric.from_range(*span_of_points(self._samples))
                self.on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
            self.affine = self._affine_start = start

    def _order(self, x: Tensor) -> Tensor:
        """Rank correlation ``(B,)`` of the prior alone with matches or points; NaN without enough of them."""
        order = x.new_full((x.shape[0],), torch.nan)
        for i, evidence in enumerate(self._evidence):
            target = evidence.matches or evidence.points
            if target is not None:
                order[i] = order_agreement(x[i : i + 1], target, self.metric.space)
        return order

    def _judge_matches(self, x: Tensor) -> None:
        """At the first estimate: find matches that look like reflections, and measure the prior's error."""
        if self.error is not None or (self.matches is None and self.points is None):
            return
        config, depth_m = self.config, self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        if self.matches is not None and self.kept is None:
            self.kept = torch.ones_like(depth_m)
            if config.reject_reflections:
                judged = self.matches if self.valid is None else self.matches.within(self.valid)
                self.kept = reject_reflections(judged, depth_m)
                if self.valid is not None:  # without a prior depth no match is a reflection
                    inside = F.interpolate(self.valid.float(), depth_m.shape[-2:], mode="nearest-exact")
                    self.kept = torch.where(inside > 0, self.kept, 1.0)
        if config.correct or config.crisp:
            target = self._target(depth_m)
            assert target is not None  # there are matches or points
            target = target if self.valid is None else target.within(self.valid)
            self.error = prior_error(depth_m, target, self.objective.views.left_01, config)

    def _target(self, depth_m: Tensor) -> Matches | None:
        error = local_error(self.error, self.valid)
        return correction_target(self.matches, self.points, self.kept, error, depth_m)

    def find_hidden(self, x: Tensor) -> None:
        """Find the pixels that a map hides from the right cameras, for all updates of a round."""
        compared = self.config.weights.get("photometric") and self.objective.views.further
        if self.config.z_test and compared:
            self.hidden = self.objective.hidden(x, self.affine)

    @torch.no_grad()
    def corrected(self, x: Tensor) -> Tensor:
        """A relative map ``x (B, 1, h, w)`` fitted to matches and points; ``x`` where there are neither."""
        depth_m = self.objective.metric_depth(x, self.affine)
        target, error = self._target(depth_m), local_error(self.error, self.valid)
        if target is None or error is None:
            return x
        _, _, field = fit_depth(depth_m, target, self.objective.views.left_01, error, self.config)
        # Resample the factor, not the difference of maps, which would be wrong on both sides of an edge.
        field = F.interpolate(field, x.shape[-2:], mode="bilinear", antialias=True)
        return self.metric.relative(self.metric(x, self.affine) * torch.exp(-field), self.affine)

    def loss(self, x: Tensor, affine: AffineState, z0: Tensor, anchor: Tensor) -> Loss:
        """Loss of an estimate ``x``, decoded from ``z0``, whose scale is settled; as ``Objective``."""
        assert self._affine_start is not None  # the scale is settled
        matches = None  # less those that look like reflections
        if self.matches is not None and self.kept is not None:
            matches = replace(self.matches, confidence=self.kept * self.matches.confidence)
        return self.objective(x, affine, self._affine_start, z0, anchor, matches, self.points, self.hidden)

    def report(self, loss: Loss | None) -> None:
        """Append a ``StepReport``; tensors stay on their device, so nothing waits for it."""
        report = StepReport(*self.step, self.affine.s_hat, self.affine.t_hat, self.affine.g_s)
        if loss is not None:
            terms = {name: value.detach() for name, value in loss.terms.items()}
            seen = loss.visible_fraction
            report = replace(report, loss=loss.total.detach(), terms=terms, visible_fraction=seen)
        self.history.append(report)
