"""What Algorithm 1 carries along for a chunk of samples: scale, shift and g_s, optimisers, matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.correction import correction_target, local_error, prior_error, refine_depth
from geodiff_plugin.algorithm.evidence import Evidence, chunk_views, within
from geodiff_plugin.algorithm.gradients import RULES, FiniteWatch
from geodiff_plugin.algorithm.objective import Loss, Objective
from geodiff_plugin.algorithm.settling import settle_ends, span_of_points
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.matching import Matches, reject_reflections
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.scale.space import AffineState, MetricMap
from geodiff_plugin.scale.volume_search import argmin_over
from geodiff_plugin.types import StepReport


class Trajectory:
    """One chunk of samples along the schedule.

    Args:
        config: hyperparameters of ``GeometryGuidance``.
        evidence: one entry per image of the call.
        owners: for every sample of the chunk the image that it belongs to; those of an image side by side.
        space: what the prior's output is affine in.
        step_latents: step size of the latent's rule.
        own_range: metres ``(B,)`` of ``x = 0`` and of ``x = 1`` that a metric prior says itself, from which
            the search starts; ``None`` for a relative one.
        start_range: metres ``(B,)`` of the nearest and of the farthest end that another frame's call ended
            with; they take the place of the first search.
        known: ``(B, 1, h, w)`` bool, where the prior says something; ``None`` for everywhere. Elsewhere its
            map has no part in the scale, and matches alone decide.

    Attributes:
        history: one ``StepReport`` a round.
        watch: whether what the steps computed was finite.
        matches: of the views, on the grid of the losses, or ``None``.
        points: depths that the user knows, on the same grid, or ``None``.
        kept: ``(B, 1, H, W)`` in [0, 1], the share of each match's confidence that remains once reflections
        are
            rejected; ``None`` before the prior's first estimate.
        error: ``(B, 1, 1, 1)`` of that estimate in log depth, as ``correction.prior_error`` measures it.
        hidden: ``(B, V, 1, H, W)`` bool, what the estimate hides from the right cameras, or ``None``.
        order: ``(B,)`` in [-1, 1], rank correlation of the prior's first map and matches or points, or
        ``None``.
        on_edge: ``(B,)`` bool, whether the last search ended on the edge of its range.
        own_depth: ``(B, 1, h, w)`` metres, the prior's own of its first estimate, or ``None``.
    """

    def __init__(
        self,
        config: GuidanceConfig,
        evidence: Sequence[Evidence],
        owners: Sequence[int],
        space: str,
        step_latents: float = 0.0,
        own_range: tuple[Tensor, Tensor] | None = None,
        start_range: tuple[Tensor, Tensor] | None = None,
        known: Tensor | None = None,
    ) -> None:
        self.config, self.owners = config, list(owners)
        self.evidence = [evidence[i] for i in owners]  # of every sample
        self.known, self._of_prior = known, self.evidence  # what the prior is held against
        if known is not None:
            self._of_prior = [within(e, k) for e, k in zip(self.evidence, known, strict=True)]
        self.metric = MetricMap(space, config.positive)
        self.objective = Objective(chunk_views(self.evidence), self.metric, config)
        self.matches = Matches.stack([e.matches for e in self.evidence])
        self.points = Matches.stack([e.points for e in self.evidence])
        self.latent_rule = RULES[config.rule](step_latents)
        self.scale_rule = RULES[config.rule](config.step_affine)
        self.shift_rule = RULES[config.rule](config.step_affine)
        # Of a disparity, x = 1 is the nearest end.
        self._own_range = None if own_range is None else tuple(torch.stack(own_range).sort(0).values)
        self._start_range = self._own_range if start_range is None else start_range
        self._affine: AffineState | None = None
        self._start: AffineState | None = None  # what the search gave, which the loss pulls towards
        self.kept: Tensor | None = None
        self.error: Tensor | None = None
        self.hidden: Tensor | None = None
        self.order: Tensor | None = None
        self.own_depth: Tensor | None = None
        self.on_edge: Tensor | None = None
        if start_range is not None:  # the frame before has searched
            self.on_edge = torch.zeros_like(start_range[0], dtype=torch.bool)
        self.history: list[StepReport] = []
        self.watch = FiniteWatch()
        self._step, self._timestep = 0, 0.0

    def begin_step(self, step: int, timestep: float) -> None:
        """Reports and messages now name this step of the schedule, and its timestep."""
        self._step, self._timestep = step, timestep

    def note(self, name: str, tensor: Tensor) -> None:
        """Remember whether a tensor of this step is finite."""
        self.watch.note(name, self._step, tensor)

    @property
    def affine(self) -> AffineState:
        """Scale, shift and g_s of the latest update; ``settle_scale`` comes first."""
        assert self._affine is not None
        return self._affine

    @affine.setter
    def affine(self, moved: AffineState) -> None:
        self._affine = moved

    def prepare(self, x: Tensor, z0: Tensor) -> None:
        """What an estimate decides before it is corrected or compared: scale, which matches to believe.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map.
            z0: ``(B, C, h, w)`` the clean latent that it was decoded from.
        """
        self.note("the network's clean latent", z0)
        self.note("the decoded map", x)
        if self._own_range is not None and self.own_depth is None:
            self.own_depth = self.metric(x, self.metric.from_range(*self._own_range))
        if self.order is None:
            self.order = self._order(x)
        self.settle_scale(x)
        self._judge_matches(x)

    def settle_scale(self, x: Tensor) -> None:
        """Find g_s and the start of scale and shift for a relative map (S7.3), or better ones than before."""
        if self.config.search == "volume":
            ends = self._start_range if self._affine is None else self.metric.range_of(self._affine)
            near, far, self.on_edge = settle_ends(
                x, self.owners, self._of_prior, self.metric, self.config, ends, self.on_edge, self.known
            )
            self._affine = self._start = self.metric.from_range(near, far)
        elif self._affine is None:
            if self.config.search == "one-number":
                state, self.on_edge = self._search_one_number(x)
            else:
                state = self.metric.from_range(*span_of_points(self.evidence))
                self.on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
            self._affine = self._start = state

    def _search_one_number(self, x: Tensor) -> tuple[AffineState, Tensor]:
        """The paper's: s_hat = t_hat = 0, and the g_s of least photometric loss (S7.3)."""
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

        best, on_edge = argmin_over(candidates, cost)
        return AffineState(zero, zero, best), on_edge

    def _order(self, x: Tensor) -> Tensor:
        """How far the prior alone agrees with matches or points on near and far; NaN where neither tells."""
        order = x.new_full((x.shape[0],), torch.nan)
        for i, evidence in enumerate(self._of_prior):
            target = evidence.matches or evidence.points
            if target is not None:
                order[i] = order_agreement(x[i : i + 1], target, self.metric.space)
        return order

    def _judge_matches(self, x: Tensor) -> None:
        """Which matches look like reflections, and how wrong the prior is, by its first estimate alone."""
        if self.error is not None or (self.matches is None and self.points is None):
            return
        config, left_01 = self.config, self.objective.views.left_01
        depth_m = self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        if self.matches is not None and self.kept is None:
            rejects = config.reject_reflections
            self.kept = torch.ones_like(depth_m)
            if rejects and self.known is None:
                self.kept = reject_reflections(self.matches, depth_m)
            elif rejects and self.known is not None:  # nothing lies behind what the prior does not know
                kept = reject_reflections(self.matches.within(self.known), depth_m)
                inside = F.interpolate(self.known.float(), kept.shape[-2:], mode="nearest-exact")
                self.kept = torch.where(inside > 0, kept, self.kept)
        if config.correct or config.refine:
            target = self._target(depth_m)
            assert target is not None  # there are matches or points
            target = target if self.known is None else target.within(self.known)
            self.error = prior_error(depth_m, target, left_01, config)

    @property
    def usable_matches(self) -> Matches | None:
        """The matches less those that look like reflections; ``None`` before the prior's first estimate."""
        if self.matches is None or self.kept is None:
            return None
        return replace(self.matches, confidence=self.kept * self.matches.confidence)

    @property
    def _local_error(self) -> Tensor | None:
        return local_error(self.error, self.known)

    def _target(self, depth_m: Tensor) -> Matches | None:
        return correction_target(self.matches, self.points, self.kept, self._local_error, depth_m)

    def find_hidden(self, x: Tensor) -> None:
        """Find what an estimate hides from the right cameras; it holds for the updates of the round.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map that the updates start from, its scale settled.
        """
        compared = self.config.weights.get("photometric") and self.objective.views.further
        if self.config.z_test and compared:
            self.hidden = self.objective.hidden(x, self.affine)

    @torch.no_grad()
    def corrected(self, x: Tensor) -> Tensor:
        """A relative map fitted to matches and points.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map, ``prepare`` was called for.

        Returns:
            ``(B, 1, h, w)``; ``x`` where there are neither.
        """
        depth_m = self.objective.metric_depth(x, self.affine)
        target, error = self._target(depth_m), self._local_error
        if target is None or error is None:
            return x
        _, _, field = refine_depth(depth_m, target, self.objective.views.left_01, error, self.config)
        # A factor, not a difference of maps: interpolated over an edge the latter is an error on either side.
        field = F.interpolate(field, x.shape[-2:], mode="bilinear", antialias=True)
        return self.metric.relative(self.metric(x, self.affine) * torch.exp(-field), self.affine)

    def loss(self, x: Tensor, affine: AffineState, z0: Tensor, anchor: Tensor) -> Loss:
        """Loss of an estimate ``x``, decoded from ``z0``, whose scale is settled; as ``Objective``."""
        assert self._start is not None  # as in ``affine``
        return self.objective(
            x, affine, self._start, z0, anchor, self.usable_matches, self.points, self.hidden
        )

    def report(self, loss: Loss) -> None:
        """Append a ``StepReport``; tensors stay on their device, so nothing waits for it."""
        self.history.append(
            StepReport(
                self._step,
                self._timestep,
                loss.total.detach(),
                {name: value.detach() for name, value in loss.terms.items()},
                self.affine.s_hat,
                self.affine.t_hat,
                self.affine.g_s,
                loss.visible_fraction,
            )
        )
