"""Algorithm 1's body on one screen: what happens to one estimate of the clean latent.

Data flow: ``z_t, eps, z0_hat`` of one denoising step -> what to add to the guided latent.
Paper: Algorithm 1, with Eq. 16 and 17.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from geodiff_plugin.algorithm.gradient import pull_back
from geodiff_plugin.algorithm.objective import Loss
from geodiff_plugin.algorithm.state import Trajectory
from geodiff_plugin.config import GuidanceConfig

__all__ = ["StepContext", "corrected_rounds", "guided_step"]


def corrected_rounds(config: GuidanceConfig, count: int) -> set[int]:
    """Which rounds of a schedule correct the estimate; a round without updates either decodes nothing.

    Early estimates are vague, and later corrections replace what earlier ones did. So the last active round
    is corrected, and the others are spread over the second half of the active rounds, or over more of them if
    they do not fit there.

    Args:
        config: says which rounds are active, and how many of them correct.
        count: rounds of the whole schedule.
    """
    active = [i for i in range(count) if config.start <= i / count < config.stop]
    if not config.correct or not config.optimize_latents or not active:
        return set()
    wanted = min(config.corrections, len(active))
    first = min(len(active) // 2, len(active) - wanted)
    step = (len(active) - 1 - first) / max(wanted - 1, 1)
    return {active[len(active) - 1 - round(k * step)] for k in range(wanted)}


@dataclass(frozen=True)
class StepContext:
    """What one denoising step gives to its guidance.

    Attributes:
        step: index in the schedule.
        timestep: the scheduler's timestep.
        rounds: numbers, in the schedule, of this step's rounds of correction and ``inner_steps`` updates. One
            round a step, but for priors that cannot take as many steps as are wanted.
        count: rounds of the whole schedule.
        eps: ``(B, C, h, w)`` predicted noise, the yardstick of the norm-matched rule.
        z0_of: the clean latent of a guided one: Tweedie with the U-Net's graph in "full", identity in
            "denoised".
        decode: latent to unclipped relative map ``(B, 1, h', w')`` float32, D in the paper.
        encode: relative map to clean latent; ``None`` where the guided latent is no clean one, which then is
            moved by gradients alone.
        decode_result: as ``decode``, for the correction whose map is the result, and whose latent nobody
            reads: that of the last round, which then encodes nothing. ``None`` where another step follows, or
            the latent is asked for.
    """

    step: int
    timestep: float
    rounds: range
    count: int
    eps: Tensor
    z0_of: Callable[[Tensor], Tensor]
    decode: Callable[[Tensor], Tensor]
    encode: Callable[[Tensor], Tensor] | None
    decode_result: Callable[[Tensor], Tensor] | None = None


def guided_step(state: Trajectory, leaf: Tensor, at: StepContext) -> Tensor | None:
    """One pass of Algorithm 1's loop body: search, correction, gradient of L_geo, updates.

    Args:
        state: of the chunk; its scale, shift and history are advanced.
        leaf: ``(B, C, h, w)`` float32, the latent that is guided: z_t ("full") or z0_hat ("denoised").
        at: what the denoising step gives.

    Returns:
        ``(B, C, h, w)`` float32, what to add to the leaf; exactly 0 with ``optimize_latents=False``; ``None``
        for a step that is the prior's own.

    Source: Algorithm 1, with Eq. 16 and 17 (which it omits) and the decode of z0_hat (it prints z_0). The
    correction before the updates is ours, after SteeredMarigold's (Gregorek and Nalpantidis 2024): a
    corrected map, encoded.
    """
    z, anchor, rounds = leaf, None, _plan(state, at)
    for k, (updates, corrects) in enumerate(rounds):
        if corrects and at.encode is not None:
            ends = at.rounds[-1] == at.count - 1 and k == len(rounds) - 1 and not updates
            moved = _corrected(state, z, at, at.encode, ends)
            anchor = moved if anchor is None else anchor + moved - z
            z = moved
        z, anchor, loss = _update(state, z, anchor, at, updates)
        state.report(at.step, at.timestep, loss)
    return (z - leaf).detach() if rounds else None


def _plan(state: Trajectory, at: StepContext) -> list[tuple[int, bool]]:
    """Updates of every round of a step in which anything happens, and whether it is corrected before them.

    An estimate that was corrected in a round without updates is not corrected again in the next: it would be
    brought to the same matches, which only follows their noise.
    """
    config, state.result = state.config, None
    corrects = config.correct and config.optimize_latents and at.encode is not None
    chosen = corrected_rounds(config, at.count) if corrects else set()
    active = [i for i in at.rounds if state.is_active(i / at.count)]
    rounds: list[tuple[int, bool]] = []
    fresh = False  # corrected, and not moved since
    for i in active:
        updates = state.plan.inner_steps if (i + 1) / at.count > state.plan.updates_from else 0
        corrected = i in chosen and not fresh
        if corrected or updates:
            rounds.append((updates, corrected))
            fresh = (corrected or fresh) and updates == 0
    if not rounds and at.rounds[-1] == at.count - 1 and not state.has_scale:
        rounds.append((0, False))  # the output needs a scale, even if no step corrects or moves anything
    return rounds


def _corrected(
    state: Trajectory, z0: Tensor, at: StepContext, encode: Callable[[Tensor], Tensor], ends: bool
) -> Tensor:
    """``z0`` moved by what the correction of its map changes in the code.

    A difference of two codes, so that what the autoencoder loses is not lost again at every step, and a map
    that needs no correction leaves the latent as it is. The map that ends the schedule (``ends``) is given
    out as it is where a refinement follows: brought to the matches twice it would follow their noise. Its
    code is made only where the latent is asked for.
    """
    with torch.no_grad():
        unread = at.decode_result if ends else None
        x0 = at.decode(z0) if unread is None else unread(z0)
        state.watch.note("the network's clean latent", at.step, z0)
        state.watch.note("the decoded map", at.step, x0)
        state.settle_scale(x0)
        refined_later = ends and state.config.refine
        corrected = x0 if refined_later and unread is not None else state.corrected(x0)
        state.result = x0 if refined_later else corrected
        if corrected is x0 or unread is not None:
            return z0
        moved = z0 + encode(corrected) - encode(x0)
        state.watch.note("the encoded correction", at.step, moved)
        return moved


def _update(
    state: Trajectory, z: Tensor, anchor: Tensor | None, at: StepContext, updates: int
) -> tuple[Tensor, Tensor, Loss]:
    """A round of gradient updates of latent, scale and shift.

    With 0 updates the scale is settled and the loss evaluated, nothing moves; a correction has settled it and
    made the map already.

    Returns:
        The moved latent; the clean latent that the step's network stands for, corrections included, which
        further rounds are anchored to as well; the loss before the first update.
    """
    watch = state.watch
    moves = state.config.optimize_latents and updates > 0
    for k in range(max(updates, 1)):
        with torch.set_grad_enabled(updates > 0):
            if moves and not z.requires_grad:
                z = z.detach().requires_grad_()
            z0_hat = at.z0_of(z)  # (B, C, h, w), Tweedie
            z0 = z0_hat.detach().requires_grad_(moves)
            settled = state.result if updates == 0 else None
            x0 = at.decode(z0) if settled is None else settled  # (B, 1, h', w'), D(z0_hat)
            x = x0.detach().requires_grad_(moves)
            anchor = z0.detach() if anchor is None else anchor
            if k == 0:
                watch.note("the network's clean latent", at.step, z0)
                watch.note("the decoded map", at.step, x)
                if settled is None:
                    state.settle_scale(x.detach())  # g_s*, S7.3
                    state.test_visibility(x.detach())
            s_hat, t_hat = (
                v.detach().requires_grad_(updates > 0) for v in (state.affine.s_hat, state.affine.t_hat)
            )
            affine = replace(state.affine, s_hat=s_hat, t_hat=t_hat)
            loss = state.loss(x, affine, z0, anchor)  # L_geo, Eq. 14, with Eq. 17
            # Samples do not mix, so the gradient of the sum is each one's own.
            total = loss.total.sum()
        if updates:
            inputs = (s_hat, t_hat, x, z0) if moves else (s_hat, t_hat)
            grads = torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True)
            if moves:
                at_z0 = grads[3] + pull_back(x0, z0, grads[2])  # the anchor's, and through the decoder
                at_z = pull_back(z0_hat, z, at_z0)  # through the network, with the full gradient
                watch.note("the gradient in the latent", at.step, at_z)
                z, state.result = z.detach() + state.latent_rule.step(at_z, at.eps), None
            s_hat = s_hat.detach() + state.scale_rule.step(grads[0])
            t_hat = t_hat.detach() + state.shift_rule.step(grads[1])
            state.affine = replace(affine, s_hat=s_hat, t_hat=t_hat)
        if k == 0:
            first = loss
    state.last_x = x.detach()
    assert anchor is not None  # there is one pass at least
    return z, anchor, first
