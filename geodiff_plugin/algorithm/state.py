"""The state that Algorithm 1 carries along: scale, shift, g_s, what is known, optimisers, history.

Data flow: relative map of a step -> metric state, and the map that the views would have.
Paper: Algorithm 1, S7.3.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Evidence, chunk_views
from geodiff_plugin.algorithm.gradient import FiniteWatch
from geodiff_plugin.algorithm.known import Known
from geodiff_plugin.algorithm.objective import Loss, Objective
from geodiff_plugin.algorithm.rules import RULES
from geodiff_plugin.algorithm.terms import MatchTarget
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.scale.order import order_agreement
from geodiff_plugin.scale.points import depth_span, fit_to_points, ordered, refine_to_matches
from geodiff_plugin.scale.space import AffineState, MetricMap, smooth_floor
from geodiff_plugin.scale.volume_search import argmin_over, search_scale
from geodiff_plugin.types import StepReport

__all__ = ["Trajectory"]

#: Searches that run at the first step only.
ONCE = ("one-number", "points-range")


class Trajectory:
    """Scale, shift, optimiser state and history of one chunk of samples along the schedule.

    Args:
        config: hyperparameters of ``GeometryGuidance``.
        evidence: one entry per image of the call.
        owners: for every sample of the chunk the image that it belongs to; those of an image side by side.
        space: what the prior's output is affine in.
        own_range: metres ``(B,)`` of ``x = 0`` and of ``x = 1`` that a metric prior says itself, from which
            the search starts; ``None`` for a relative one.
        start_range: metres ``(B,)`` of the nearest and of the farthest end that another frame's call ended
            with; where matches are sure, they take the place of the first search.

    Attributes:
        history: one ``StepReport`` a step.
        watch: whether what the steps computed was finite.
        last_x: ``(B, 1, h, w)`` the relative map of the latest evaluation, no graph.
        result: ``(B, 1, h, w)`` the relative map of the latest step that the output starts from: the
            corrected one, or, of the last step, the one that the output's own refinement corrects; ``None``
            where something else than the correction moved the latent, or nothing did.
        known: matches and points on the grid of the corrections.
        matches: those that the latest estimate believes, on the grid of the losses, or ``None``.
        hidden: ``(B, V, 1, H, W)`` bool, what the estimate hides from the right cameras, or ``None``.
        order: ``(B,)`` in [-1, 1], rank correlation of the prior's first map and what is known, or ``None``.
        on_edge: ``(B,)`` bool, whether the last search ended on the edge of its range.
        own_depth: ``(B, 1, h, w)`` metres, the prior's own of its first estimate, or ``None``.
    """

    def __init__(
        self,
        config: GuidanceConfig,
        evidence: Sequence[Evidence],
        owners: Sequence[int],
        space: str,
        own_range: tuple[Tensor, Tensor] | None = None,
        start_range: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.config, self.evidence, self.owners = config, evidence, list(owners)
        self.metric = MetricMap(space, config.positive)
        self.objective = Objective(chunk_views(evidence, owners), self.metric, config)
        self.known = Known.of([evidence[i] for i in owners], config, "loss")
        self.plan = config.plan_updates(points_given=self.known.points is not None)
        self.latent_rule = RULES[config.rule](self.plan.step_latents)
        self.scale_rule = RULES[config.rule](config.step_affine)
        self.shift_rule = RULES[config.rule](config.step_affine)
        # Of a disparity, x = 1 is the nearest end.
        self.own_range: tuple[Tensor, Tensor] | None = None
        if own_range is not None:
            least, most = torch.stack(own_range).sort(0).values.unbind(0)
            self.own_range = (least, most)
        self._start_range = self.own_range if start_range is None else start_range
        self.own_depth: Tensor | None = None
        self._affine: AffineState | None = None
        self._start: AffineState | None = None  # what the search found, which the loss pulls towards
        self.matches: MatchTarget | None = None
        self.hidden: Tensor | None = None
        self.order: Tensor | None = None
        self.on_edge: Tensor | None = None
        if start_range is not None:  # the frame before has searched
            self.on_edge = torch.zeros_like(start_range[0], dtype=torch.bool)
        self.last_x: Tensor | None = None
        self.result: Tensor | None = None
        self.history: list[StepReport] = []
        self.watch = FiniteWatch()

    @property
    def affine(self) -> AffineState:
        """Scale, shift and g_s of the latest update; ``settle_scale`` comes first."""
        assert self._affine is not None
        return self._affine

    @affine.setter
    def affine(self, moved: AffineState) -> None:
        self._affine = moved

    @property
    def has_scale(self) -> bool:
        """Whether a search, or the frame before, has found scale and shift."""
        return self._affine is not None

    def is_active(self, fraction: float) -> bool:
        """Whether steps at this fraction of the schedule, [0, 1), are updated."""
        return self.config.start <= fraction < self.config.stop

    def settle_scale(self, x: Tensor) -> None:
        """Find g_s and the start of scale and shift for a relative map (S7.3), or better ones than before.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map of this step.
        """
        if self.own_range is not None and self.own_depth is None:
            self.own_depth = self.metric(x, self.metric.from_range(*self.own_range))
        if self.order is None:
            self.order = self._order(x)
        search = self.config.search
        if search not in ONCE:
            self._search_volume(x)
        elif self._affine is None:
            (self._search_one_number if search == "one-number" else self._span_points)(x)
        depth_m = self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        self.known = self.known.judged(self._on_known(depth_m), self.objective.views.left_01)
        self.matches = self.known.usable_matches

    def _on_known(self, depth_m: Tensor) -> Tensor:
        """A metric map on the grid of the corrections."""
        size = self.known.size
        if size is None or size == tuple(depth_m.shape[-2:]):
            return depth_m
        return F.interpolate(depth_m, size, mode="bilinear", align_corners=False, antialias=True)

    def _order(self, x: Tensor) -> Tensor:
        """How far the prior alone agrees with matches or points on near and far; NaN where neither tells."""
        found = x.new_full((x.shape[0],), torch.nan)
        for i, owner in enumerate(self.owners):
            known = self.evidence[owner].matches or self.evidence[owner].points
            if known is not None:
                found[i] = order_agreement(x[i : i + 1], known, self.metric.space)
        return found

    def _search_one_number(self, x: Tensor) -> None:
        zero = x.new_zeros(x.shape[0])
        low, high = self.config.g_s_range
        count = self.config.g_s_candidates
        candidates = torch.linspace(low, high, count, dtype=torch.float32, device=x.device)

        def cost(g_s: Tensor) -> Tensor:
            affine = AffineState(zero, zero, g_s.expand_as(zero))
            loss = self.objective(x, affine, affine, zero.view(-1, 1), zero.view(-1, 1), None)
            # What no right camera sees costs nothing, and must not win for that.
            shown = (loss.visible_fraction > 0) & (loss.visible_fraction >= self.config.min_visible)
            return loss.terms["photometric"].where(shown, torch.inf)

        best, self.on_edge = argmin_over(candidates, cost)
        self._affine = self._start = AffineState(zero, zero, best)

    def _span_points(self, x: Tensor) -> None:
        """From the nearest known point to the farthest."""
        known = [points for owner in self.owners if (points := self.evidence[owner].points) is not None]
        nearest, farthest = zip(*map(depth_span, known), strict=True)
        self._affine = self._start = self.metric.from_range(torch.stack(nearest), torch.stack(farthest))
        self.on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)

    def _search_volume(self, x: Tensor) -> None:
        """Joint (near, far) by lookup, or by a fit to points where there is no right view.

        The current state, at first a metric prior's own, stays unless a better basin shows up.
        """
        ends = self._start_range if self._affine is None else self.metric.range_of(self._affine)
        near, far = x.new_empty(x.shape[0]), x.new_empty(x.shape[0])
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
        for image in sorted(set(self.owners)):
            first = self.owners.index(image)
            members = slice(first, first + self.owners.count(image))
            current = None if ends is None else (ends[0][members], ends[1][members])
            near[members], far[members], on_edge[members] = self._range_of_image(
                x[members], self.evidence[image], current, members
            )
        self.on_edge = on_edge
        self._affine = self._start = self.metric.from_range(near, far)

    def _range_of_image(
        self,
        x: Tensor,
        evidence: Evidence,
        current: tuple[Tensor, Tensor] | None,
        members: slice,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Nearest and farthest metres of one image's samples, and whether they lie on the search's edge.

        Points have the last word: they are measured, matches are inferred.
        """
        space, floored = self.metric.space, smooth_floor(x)
        if evidence.volume is None:
            assert evidence.points is not None  # without views there are points
            near_far = fit_to_points(x, evidence.points, self.metric, current)
            on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
        elif current is not None and evidence.sure is not None and self.on_edge is not None:
            # Later steps start from what the first found; sure matches tell whether its basin still holds.
            near_far, on_edge = current, self.on_edge[members]
        else:
            found = search_scale(
                evidence.volume,
                floored,
                space,
                depth_range=self.config.depth_range,
                current=current,
            )
            near_far, on_edge = (found.near_m, found.far_m), found.on_edge
        sure = evidence.sure
        if sure is not None and evidence.matches is not None:
            # A poor prior's true basin is shallow in raw costs; matches tell basins apart at a prior's error.
            near_far = refine_to_matches(floored, evidence.matches, *near_far, space)
            near_far = fit_to_points(x, sure, self.metric, near_far)
        for known in (evidence.matches, evidence.points):
            if known is not None:
                near_far = refine_to_matches(floored, known, *near_far, space)
        if self.config.depth_range is not None:
            low, high = self.config.depth_range
            near_far = ordered(*(v.clamp(low, high) for v in near_far))
        return *near_far, on_edge

    def test_visibility(self, x: Tensor) -> None:
        """Find what an estimate hides from the right cameras; it holds for the updates of the round.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map that the updates start from, its scale settled.
        """
        compared = self.config.weights.get("photometric") and self.objective.views.further
        if self.config.z_test and compared:
            self.hidden = self.objective.hidden(x, self.affine)

    @torch.no_grad()
    def corrected(self, x: Tensor) -> Tensor:
        """A relative map fitted to what is known.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map, for which ``settle_scale`` was called.

        Returns:
            ``(B, 1, h, w)``; ``x`` where no match or point is near.
        """
        depth_m = self._on_known(self.objective.metric_depth(x, self.affine))
        refined = self.known.refine(depth_m, self.objective.views.left_01)
        if refined is None:
            return x
        # A factor, not a difference of maps: interpolated over an edge the latter is an error on either side.
        field = F.interpolate(refined.field, x.shape[-2:], mode="bilinear", antialias=True)
        return self.metric.relative(self.metric(x, self.affine) * torch.exp(-field), self.affine)

    def loss(self, x: Tensor, affine: AffineState, z0: Tensor, anchor: Tensor) -> Loss:
        """Loss of an estimate ``x``, decoded from ``z0``, whose scale is settled; as ``Objective``."""
        assert self._start is not None  # as in ``affine``
        return self.objective(
            x, affine, self._start, z0, anchor, self.matches, self.known.points, self.hidden
        )

    def report(self, step: int, timestep: float, loss: Loss) -> None:
        """Append a ``StepReport``; tensors stay on their device, so nothing waits for it."""
        self.history.append(
            StepReport(
                step,
                timestep,
                loss.total.detach(),
                {name: value.detach() for name, value in loss.terms.items()},
                self.affine.s_hat,
                self.affine.t_hat,
                self.affine.g_s,
                loss.visible_fraction,
            )
        )
