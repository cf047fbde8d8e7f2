"""Algorithm 1's body on one screen: what happens to one estimate of the clean latent.

Hop: ``z_t, eps, z0_hat`` of one denoising step -> what to add to the guided latent.
Paper: Algorithm 1, with Eq. 16 and 17.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from geodiff_plugin.objective import Loss
from geodiff_plugin.trajectory import Trajectory

__all__ = ["guided_step"]

#: The loss is a mean over pixels, so a pixel's gradient is below float16's least number where the decoder
#: runs in it. A power of two, so that nothing else changes.
_GRADIENT_SCALE = 2.0**14


def guided_step(
    trajectory: Trajectory,
    leaf: Tensor,
    z0_of: Callable[[Tensor], Tensor],
    decode: Callable[[Tensor], Tensor],
    encode: Callable[[Tensor], Tensor] | None,
    eps: Tensor,
    step: int,
    timestep: float,
    spans: Sequence[tuple[float, float]],
) -> Tensor:
    """One pass of Algorithm 1's loop body: search, correction, gradient of L_geo, updates.

    Args:
        trajectory: state of the chunk; its scale, shift and history are advanced.
        leaf: ``(B, C, h, w)`` float32, the latent that is guided: z_t ("full") or z0_hat ("denoised").
        z0_of: the clean latent of a leaf; carries the U-Net's graph in "full", identity in "denoised".
        decode: latent to unclipped relative map ``(B, 1, h', w')`` float32.
        encode: relative map to clean latent; ``None`` where the leaf is no clean latent, which then is moved
            by gradients alone.
        eps: ``(B, C, h, w)`` predicted noise, the yardstick of the norm-matched rule.
        step: index in the schedule.
        timestep: the scheduler's timestep.
        spans: begin and end in the schedule, [0, 1], of each round of correction and ``inner_steps`` updates.
            One round a step, but for priors that cannot take as many steps as are wanted.

    Returns:
        ``(B, C, h, w)`` float32, what to add to the leaf; exactly 0 with ``optimize_latents=False``.

    Source: Algorithm 1, with Eq. 16 and 17 (which it omits) and the decode of z0_hat (it prints z_0). The
    correction before the updates is ours, after SteeredMarigold's (Gregorek and Nalpantidis 2024): a
    corrected map, encoded.
    """
    config, z, anchor = trajectory.config, leaf, None
    rounds = [span for span in spans if trajectory.is_active(span[0])]
    moves = config.optimize_latents and bool(rounds)
    for _, end in rounds or spans[:1]:
        if moves and config.correct and encode is not None:
            moved = _corrected(trajectory, z, decode, encode)
            anchor = moved if anchor is None else anchor + moved - z
            z = moved
        updates = config.inner_steps if rounds and end > config.updates_from else 0
        z, anchor, first = _update(trajectory, z, anchor, z0_of, decode, eps, updates)
        trajectory.report(step, timestep, first)
    return (z - leaf).detach()


def _corrected(
    trajectory: Trajectory,
    z0: Tensor,
    decode: Callable[[Tensor], Tensor],
    encode: Callable[[Tensor], Tensor],
) -> Tensor:
    """``z0`` moved by what the correction of its map changes in the code.

    A difference of two codes, so that what the autoencoder loses is not lost again at every step, and a map
    that needs no correction leaves the latent as it is.
    """
    with torch.no_grad():
        x0 = decode(z0)
        trajectory.settle_scale(x0)
        corrected = trajectory.corrected(x0)
        return z0 if corrected is x0 else z0 + encode(corrected) - encode(x0)


def _update(
    trajectory: Trajectory,
    z: Tensor,
    anchor: Tensor | None,
    z0_of: Callable[[Tensor], Tensor],
    decode: Callable[[Tensor], Tensor],
    eps: Tensor,
    updates: int,
) -> tuple[Tensor, Tensor, Loss]:
    """A round of gradient updates of latent, scale and shift.

    With 0 updates the scale is settled and the loss evaluated, nothing moves.

    Returns:
        The moved latent; the clean latent that the step's network stands for, corrections included, which
        further rounds are anchored to as well; the loss before the first update.
    """
    config = trajectory.config
    for k in range(max(updates, 1)):
        with torch.set_grad_enabled(updates > 0):
            if not z.requires_grad and config.optimize_latents and updates:
                z = z.detach().requires_grad_()
            z0_hat = z0_of(z)  # (B, C, h, w), Tweedie
            x0 = decode(z0_hat)  # (B, 1, h', w'), D(z0_hat)
            if k == 0:
                anchor = z0_hat.detach() if anchor is None else anchor
                trajectory.settle_scale(x0.detach())  # g_s*, S7.3
                trajectory.test_visibility(x0.detach())
            s_hat, t_hat = (
                v.detach().requires_grad_(updates > 0)
                for v in (trajectory.affine.s_hat, trajectory.affine.t_hat)
            )
            affine = replace(trajectory.affine, s_hat=s_hat, t_hat=t_hat)
            loss = trajectory.objective(
                x0, affine, trajectory.affine_start, z0_hat, anchor, trajectory.matches, trajectory.hidden
            )
            # Samples do not mix, so the gradient of the sum is each one's own.
            total = _GRADIENT_SCALE * loss.total.sum()
        if updates:
            inputs = (s_hat, t_hat, z) if config.optimize_latents else (s_hat, t_hat)
            grads = [g / _GRADIENT_SCALE for g in torch.autograd.grad(total, inputs)]
            s_hat = s_hat.detach() + trajectory.scale_rule.step(grads[0])
            t_hat = t_hat.detach() + trajectory.shift_rule.step(grads[1])
            trajectory.affine = replace(affine, s_hat=s_hat, t_hat=t_hat)
            if config.optimize_latents:
                z = z.detach() + trajectory.latent_rule.step(grads[2], eps)
        if k == 0:
            first = loss
    trajectory.last_x = x0.detach()
    return z, anchor, first
