"""The state that Algorithm 1 carries from step to step: scale, shift, g_s, matches, optimisers, history.

Hop: relative map of a step -> metric state, and the map that the views would have.
Paper: Algorithm 1, S7.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.evidence import Evidence, chunk_views
from geodiff_plugin.matching import believe_before_prior, gate_matches, with_points
from geodiff_plugin.metric import GROWS_WITH_DEPTH, AffineState, MetricMap, smooth_floor
from geodiff_plugin.objective import Loss, Objective
from geodiff_plugin.point_scale import depth_span, fit_to_points, ordered, refine_to_matches
from geodiff_plugin.refinement import refine_depth
from geodiff_plugin.scale_search import argmin_over, search_scale
from geodiff_plugin.terms import MatchTarget
from geodiff_plugin.types import StepReport
from geodiff_plugin.updates import RULES

__all__ = ["Trajectory"]

#: Candidates of the paper's one-number search; its figures step through 1..80.
G_S_CANDIDATES = 80
#: Searches that run at the first step only.
ONCE = ("one-number", "points-range")


class Trajectory:
    """Scale, shift, optimiser state and history of one chunk of samples along the schedule.

    Args:
        config: hyperparameters of ``GeometryGuidance``.
        evidence: one entry per image of the call.
        owners: for every sample of the chunk the image that it belongs to.
        space: what the prior's output is affine in.

    Attributes:
        affine: current scale, shift and g_s, ``(B,)`` each; ``None`` before the first search.
        history: one ``StepReport`` a step.
        last_x: ``(B, 1, h, w)`` the relative map of the latest evaluation, no graph.
        belief: ``(B, 1, H, W)`` in [0, 1], what the prior's first estimate leaves of each match, or ``None``.
        hidden: ``(B, V, 1, H, W)`` bool, what the estimate hides from the right cameras, or ``None``.
        on_edge: ``(B,)`` bool, whether the last search ended on the edge of its range.
    """

    def __init__(self, config: Any, evidence: Sequence[Evidence], owners: Sequence[int], space: str) -> None:
        self.config, self.evidence, self.owners = config, evidence, list(owners)
        self.metric = MetricMap(space, config.positive)
        self.objective = Objective(
            chunk_views(evidence, owners), self.metric, config.weights, config, config.min_visible
        )
        self.latent_rule = RULES[config.rule](config.step_latents)
        self.scale_rule = RULES[config.affine_rule](config.step_affine)
        self.shift_rule = RULES[config.affine_rule](config.step_affine)
        self.affine: AffineState | None = None
        self.affine_start: AffineState | None = None
        self.matches: MatchTarget | None = None
        self.belief: Tensor | None = None
        self.hidden: Tensor | None = None
        self.on_edge: Tensor | None = None
        self.last_x: Tensor | None = None
        self.history: list[StepReport] = []

    def is_active(self, fraction: float) -> bool:
        """Whether steps at this fraction of the schedule, [0, 1), are updated."""
        return self.config.start <= fraction < self.config.stop

    def settle_scale(self, x: Tensor) -> None:
        """Find g_s and the start of scale and shift for a relative map (S7.3), or better ones than before.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map of this step.
        """
        if self.config.search not in ONCE:
            self._search_volume(x)
        elif self.affine is None:
            (self._search_one_number if self.config.search == "one-number" else self._span_points)(x)
        self._gate_matches(x)

    def _search_one_number(self, x: Tensor) -> None:
        zero = x.new_zeros(x.shape[0])
        low, high = self.config.g_s_range
        candidates = torch.linspace(low, high, G_S_CANDIDATES, device=x.device)

        def cost(g_s: Tensor) -> Tensor:
            affine = AffineState(zero, zero, g_s.expand_as(zero))
            loss = self.objective(x, affine, affine, zero.view(-1, 1), zero.view(-1, 1), None)
            # What no right camera sees costs nothing, and must not win for that.
            shown = (loss.visible_fraction > 0) & (loss.visible_fraction >= self.config.min_visible)
            return loss.terms["photometric"].where(shown, torch.inf)

        best, self.on_edge = argmin_over(candidates, cost)
        self.affine = self.affine_start = AffineState(zero, zero, best)

    def _span_points(self, x: Tensor) -> None:
        """From the nearest known point to the farthest."""
        nearest, farthest = zip(
            *(depth_span(self.evidence[owner].points) for owner in self.owners), strict=True
        )
        self.affine = self.affine_start = self._state(torch.stack(nearest), torch.stack(farthest))
        self.on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)

    def _state(self, near_m: Tensor, far_m: Tensor) -> AffineState:
        """The affine state whose nearest and farthest depths, ``(B,)`` metres, are these."""
        increasing = self.metric.space in GROWS_WITH_DEPTH
        return self.metric.from_range(*((near_m, far_m) if increasing else (far_m, near_m)))

    def _search_volume(self, x: Tensor) -> None:
        """Joint (near, far) by lookup, or by a fit to points where there is no right view.

        The current state stays unless a better basin shows up.
        """
        near, far = x.new_empty(x.shape[0]), x.new_empty(x.shape[0])
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
        for image in sorted(set(self.owners)):
            members = [i for i, owner in enumerate(self.owners) if owner == image]
            current = None
            if self.affine is not None:
                current = tuple(v[members] for v in self.metric.range_of(self.affine))
            near[members], far[members], on_edge[members] = self._range_of_image(
                x[members], self.evidence[image], current
            )
        self.on_edge = on_edge
        self.affine = self.affine_start = self._state(near, far)

    def _range_of_image(
        self, x: Tensor, evidence: Evidence, current: tuple[Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Nearest and farthest metres of one image's samples, and whether they lie on the search's edge.

        Points have the last word: they are measured, matches are inferred.
        """
        space, floored = self.metric.space, smooth_floor(x)
        if evidence.volume is None:
            ends = current if current is None or space in GROWS_WITH_DEPTH else current[::-1]
            near_far = fit_to_points(x, evidence.points, self.metric, ends)
            on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
        else:
            limits = self.config.depth_range
            found = search_scale(evidence.volume, floored, space, depth_range=limits, current=current)
            near_far, on_edge = (found.near_m, found.far_m), found.on_edge
        sure = evidence.sure_matches
        if sure is not None:
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

    def _gate_matches(self, x: Tensor) -> None:
        """Believe matches within a factor of the estimate only, less those that look like reflections."""
        known = self.objective.views.matches
        if known is None:
            return
        depth_m = self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        if self.belief is None:
            all_of_it = torch.ones_like(depth_m)
            self.belief = believe_before_prior(known, depth_m) if self.config.doubt else all_of_it
        gated = gate_matches(known, depth_m, self.config.gate)
        self.matches = replace(known, confidence=self.belief * gated)

    def test_visibility(self, x: Tensor) -> None:
        """Find what an estimate hides from the right cameras; it holds for the updates of the round.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map that the updates start from, its scale settled.
        """
        if self.config.z_test and self.config.weights.get("photometric") and self.objective.views.rights:
            self.hidden = self.objective.hidden(x, self.affine)

    @torch.no_grad()
    def corrected(self, x: Tensor) -> Tensor:
        """A relative map brought to what is known, as far as the gate believes it.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map, for which ``settle_scale`` was called.

        Returns:
            ``(B, 1, h, w)``; ``x`` where no match or point is near.
        """
        views, target = self.objective.views, self.matches
        if views.points is not None:
            target = with_points(target, views.points)
        if target is None:
            return x
        depth_m = self.objective.metric_depth(x, self.affine)
        refined_m = refine_depth(depth_m, target, views.left_01).depth_m
        change = self.metric.relative(refined_m, self.affine) - self.metric.relative(depth_m, self.affine)
        return x + F.interpolate(change, x.shape[-2:], mode="bilinear", antialias=True)

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
