"""Algorithm 1's body, and the state that it carries from step to step.

Hop: ``z_t, eps, z0_hat`` of one denoising step -> the step to be added to the guided latent.
Paper: Algorithm 1, S7.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.evidence import Evidence, chunk_views
from geodiff_plugin.matching import gate_matches
from geodiff_plugin.metric import AffineState, MetricMap, smooth_floor
from geodiff_plugin.objective import Loss, Objective
from geodiff_plugin.scale_search import argmin_over, refine_to_matches, search_scale
from geodiff_plugin.terms import MatchTarget
from geodiff_plugin.types import StepReport
from geodiff_plugin.updates import RULES

__all__ = ["Trajectory", "guided_step"]

#: Candidates of the paper's one-number search; its figures step through 1..80.
G_S_CANDIDATES = 80


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
        on_edge: ``(B,)`` bool, whether the last search ended on the edge of its range.
    """

    def __init__(self, config: Any, evidence: Sequence[Evidence], owners: Sequence[int], space: str) -> None:
        self.config, self.evidence, self.owners = config, evidence, list(owners)
        self.metric = MetricMap(space)
        self.objective = Objective(
            chunk_views(evidence, owners), self.metric, config.weights, config, config.min_visible
        )
        self.latent_rule = RULES[config.rule](config.step_latents)
        self.scale_rule = RULES[config.affine_rule](config.step_affine)
        self.shift_rule = RULES[config.affine_rule](config.step_affine)
        self.affine: AffineState | None = None
        self.affine_start: AffineState | None = None
        self.matches: MatchTarget | None = None
        self.on_edge: Tensor | None = None
        self.last_x: Tensor | None = None
        self.history: list[StepReport] = []

    def is_active(self, fraction: float) -> bool:
        """Whether steps at this fraction of the schedule, [0, 1), are updated."""
        return self.config.start <= fraction < self.config.stop

    def settle_scale(self, x: Tensor, fraction: float) -> None:
        """Find g_s and the start of scale and shift for a relative map (S7.3), or better ones than before.

        Args:
            x: ``(B, 1, h, w)`` float32 relative map of this step.
            fraction: of the schedule, [0, 1); the gate on matches narrows with it.
        """
        if self.config.search == "one-number":
            if self.affine is None:
                self._search_one_number(x)
            return
        self._search_volume(x)
        wide, narrow = self.config.gate
        self._gate_matches(x, wide + (narrow - wide) * fraction)

    def _search_one_number(self, x: Tensor) -> None:
        zero = x.new_zeros(x.shape[0])
        low, high = self.config.g_s_range
        candidates = torch.linspace(low, high, G_S_CANDIDATES, device=x.device)

        def cost(g_s: Tensor) -> Tensor:
            affine = AffineState(zero, zero, g_s.expand_as(zero))
            return self.objective(x, affine, affine, zero.view(-1, 1), zero.view(-1, 1), None).terms[
                "photometric"
            ]

        best, self.on_edge = argmin_over(candidates, cost)
        self.affine = self.affine_start = AffineState(zero, zero, best)

    def _search_volume(self, x: Tensor) -> None:
        """Joint (near, far) by lookup; the current state stays unless a better basin shows up."""
        floored = smooth_floor(x)
        at_zero, at_one = x.new_empty(x.shape[0]), x.new_empty(x.shape[0])
        on_edge = torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
        for image in sorted(set(self.owners)):
            members = [i for i, owner in enumerate(self.owners) if owner == image]
            evidence = self.evidence[image]
            current = None
            if self.affine is not None:
                current = tuple(v[members] for v in self.metric.range_of(self.affine))
            found = search_scale(
                evidence.volume,
                floored[members],
                self.metric.space,
                depth_range=self.config.depth_range,
                current=current,
            )
            near_to_far = (found.near_m, found.far_m)
            if evidence.matches is not None:
                near_to_far = refine_to_matches(
                    floored[members], evidence.matches, *near_to_far, self.metric.space
                )
            increasing = self.metric.space in ("depth", "log")
            at_zero[members], at_one[members] = near_to_far if increasing else near_to_far[::-1]
            on_edge[members] = found.on_edge
        self.on_edge = on_edge
        self.affine = self.affine_start = self.metric.from_range(at_zero, at_one)

    def _gate_matches(self, x: Tensor, factor: float) -> None:
        """Believe matches within a factor of the estimate only: others are outliers."""
        own = [self.evidence[i].matches for i in self.owners]
        if own[0] is None:
            return
        depth_m = self.objective.metric_depth(x, self.affine)  # (B, 1, H, W)
        gated = [gate_matches(m, d[None], factor) for m, d in zip(own, depth_m, strict=True)]
        self.matches = MatchTarget(
            torch.stack([m.inverse_depth for m in own]),
            torch.cat(gated),
            torch.stack([m.plane_step for m in own]),
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


def guided_step(
    trajectory: Trajectory,
    leaf: Tensor,
    z0_of: Callable[[Tensor], Tensor],
    decode: Callable[[Tensor], Tensor],
    eps: Tensor,
    step: int,
    timestep: float,
    fraction: float,
) -> Tensor:
    """One pass of Algorithm 1's loop body: search, gradient of L_geo, updates of latent, scale and shift.

    Args:
        trajectory: state of the chunk; its scale, shift and history are advanced.
        leaf: ``(B, C, h, w)`` float32, the latent that is guided: z_t ("full") or z0_hat ("denoised").
        z0_of: the clean latent of a leaf; carries the U-Net's graph in "full", identity in "denoised".
        decode: latent to unclipped relative map ``(B, 1, h', w')`` float32.
        eps: ``(B, C, h, w)`` predicted noise, the yardstick of the norm-matched rule.
        step: index in the schedule.
        timestep: the scheduler's timestep.
        fraction: ``step / number of steps``.

    Returns:
        ``(B, C, h, w)`` float32, what to add to the leaf; exactly 0 with ``optimize_latents=False``.

    Source: Algorithm 1, with Eq. 16 and 17 (which it omits) and the decode of z0_hat (it prints z_0).
    """
    config, z, z0_prior = trajectory.config, leaf, None
    updates = config.inner_steps if trajectory.is_active(fraction) else 0
    for k in range(max(updates, 1)):
        with torch.set_grad_enabled(updates > 0):
            if not z.requires_grad and config.optimize_latents and updates:
                z = z.detach().requires_grad_()
            z0_hat = z0_of(z)  # (B, C, h, w), Tweedie
            x0 = decode(z0_hat)  # (B, 1, h', w'), D(z0_hat)
            if k == 0:
                z0_prior = z0_hat.detach()
                trajectory.settle_scale(x0.detach(), fraction)  # g_s*, S7.3
            s_hat, t_hat = (v.detach().requires_grad_(updates > 0) for v in _raw(trajectory.affine))
            affine = AffineState(s_hat, t_hat, trajectory.affine.g_s)
            loss = trajectory.objective(
                x0, affine, trajectory.affine_start, z0_hat, z0_prior, trajectory.matches
            )
            total = loss.total.sum()  # samples do not mix, so the gradient of the sum is each one's own
        if updates:
            inputs = (s_hat, t_hat, z) if config.optimize_latents else (s_hat, t_hat)
            grads = torch.autograd.grad(total, inputs)
            s_hat = s_hat.detach() + trajectory.scale_rule.step(grads[0])
            t_hat = t_hat.detach() + trajectory.shift_rule.step(grads[1])
            trajectory.affine = AffineState(s_hat, t_hat, affine.g_s)
            if config.optimize_latents:
                z = z.detach() + trajectory.latent_rule.step(grads[2], eps)
        if k == 0:
            first = loss
    trajectory.last_x = x0.detach()
    trajectory.report(step, timestep, first)
    return (z - leaf).detach()


def _raw(affine: AffineState) -> tuple[Tensor, Tensor]:
    return affine.s_hat, affine.t_hat
