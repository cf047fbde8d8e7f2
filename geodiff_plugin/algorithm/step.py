"""Runs one guided denoising step: ``gradient_step`` is Algorithm 1, ``match_fit_step`` the default.

Source: Algorithm 1 with Eq. 16 and 17, which it omits; z0_hat is decoded where it prints z_0.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from geodiff_plugin.algorithm.optimizers import backpropagate
from geodiff_plugin.algorithm.schedule import Round
from geodiff_plugin.algorithm.state import Trajectory
from geodiff_plugin.algorithm.terms import Loss


class Estimate(Protocol):
    """The prior's estimate at one denoising step, with conversions between latents and maps.

    Attributes:
        latent: ``(B, C, h, w)`` float32, the tensor that guidance updates: z_t ("full") or z0_hat
            ("denoised").
        eps: ``(B, C, h, w)`` the predicted noise, reference of the optimizer ``adam-norm``.
        latent_is_read: whether the latent is used after this step; if not, the last map is the result.
    """

    latent: Tensor
    eps: Tensor
    latent_is_read: bool

    def z0(self, latent: Tensor) -> Tensor:
        """Compute the clean latent of ``latent``: Tweedie through the network ("full"), or the identity."""

    def decode(self, z0: Tensor, final: bool = False) -> Tensor:
        """Decode (D) to an unclipped map ``(B, 1, h', w')`` float32; ``final`` if it may be the result."""

    def encode(self, x: Tensor) -> Tensor:
        """Encode a relative map to a clean latent."""


class Update(NamedTuple):
    """One gradient update: the updated latent, and the map and loss before it."""

    latent: Tensor
    relative: Tensor
    loss: Loss


class MatchFit(NamedTuple):
    """One match fit: the clean latent, and the map that the next round or the result starts from."""

    latent: Tensor
    relative: Tensor


class GuidedStep(NamedTuple):
    """Result of guidance at one denoising step."""

    offset: Tensor  # (B, C, h, w) change of the latent
    relative: Tensor  # (B, 1, h', w') latest map
    is_current: bool  # whether the result starts from this map without decoding again


def gradient_step(state: Trajectory, estimate: Estimate, z: Tensor, anchor: Tensor, is_first: bool) -> Update:
    """Run one pass of Algorithm 1's loop body, without the score before and the DDIM line after it.

    Updates ``z (B, C, h, w)``, z_t or z0_hat, as well as scale s_hat, shift t_hat and the optimizers in
    ``state``. The first update of a round (``is_first``) also searches g_s (S7.3). ``anchor`` is the clean
    latent that the anchor term regularizes towards.
    """
    updates_latents = state.config.optimize_latents
    with torch.enable_grad():
        if updates_latents and not z.requires_grad:
            z = z.detach().requires_grad_()
        z0_hat = estimate.z0(z)  # Compute relative depth using Tweedie's formula
        z0 = z0_hat.detach().requires_grad_(updates_latents)
        D_z0 = estimate.decode(z0)
        x0 = D_z0.detach().requires_grad_(updates_latents)
        if is_first:
            state.prepare(x0.detach(), z0)
            state.find_occluded(x0.detach())
        s_hat, t_hat = (v.detach().requires_grad_() for v in (state.affine.s_hat, state.affine.t_hat))
        affine = replace(state.affine, s_hat=s_hat, t_hat=t_hat)
        L_geo = state.loss(x0, affine, z0, anchor)  # Eq. 14 of Eq. 16, with Eq. 17 and any further terms
        inputs = (s_hat, t_hat, x0, z0) if updates_latents else (s_hat, t_hat)
        total = L_geo.total.sum()  # samples are independent, so the sum has each sample's gradient
        grad_s, grad_t, *grads = torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True)
    s_hat = s_hat.detach() + state.scale_optimizer.step(grad_s)  # s_hat - lambda_s grad L_geo
    t_hat = t_hat.detach() + state.shift_optimizer.step(grad_t)  # t_hat - lambda_t grad L_geo
    if (
        updates_latents
    ):  # z - lambda grad L_geo, through the decoder, and with the full gradient through the network
        grad_z0 = grads[1] + backpropagate(D_z0, z0, grads[0])
        grad_z = backpropagate(z0_hat, z, grad_z0)
        state.record("the gradient in the latent", grad_z)
        z = z.detach() + state.latent_optimizer.step(grad_z, estimate.eps)
    state.affine = replace(affine, s_hat=s_hat, t_hat=t_hat)
    return Update(z, x0.detach(), L_geo)


@torch.no_grad()
def match_fit_step(state: Trajectory, estimate: Estimate, z0: Tensor, is_result: bool) -> MatchFit:
    """Fit the decoded map to matches and points, and encode the change.

    With ``x = D(z0)`` of depth ``d(x)``, the fitted map ``x*`` has ``log d(x*) = log d(x) - u``. A few solver
    steps move ``u`` towards the minimizer of ``sum w (u - r)^2 + a sum g |grad u|^2 + b sum u^2``: ``r`` is
    the log ratio of a match's inverse depth to the map's, ``w`` its weight, and ``g`` falls at edges
    (``match_fitting.fit_depth``). The latent ``(B, C, h, w)`` becomes ``z0 + E(x*) - E(x)``: with the
    difference of two encodings the autoencoder's loss does not accumulate, and a map that needs no change
    leaves the latent unchanged.

    If no round follows (``is_result``) and the output will be refined (``refine_edges``), the original map is
    returned: fitted to the matches twice, it would follow their noise. The map is encoded only if the latent
    is read.

    Source: Gregorek and Nalpantidis 2024, "SteeredMarigold".
    """
    x = estimate.decode(z0, final=is_result)
    state.prepare(x, z0)
    unused = is_result and not estimate.latent_is_read
    refined_later = is_result and state.config.refine_edges
    if unused and refined_later:
        return MatchFit(z0, x)
    fitted = state.fitted(x)
    state.record("the fitted map", fitted)
    if fitted is not x and not unused:
        # A GPU encodes one batch of two in three quarters of the time of two batches.
        encoded, original = estimate.encode(torch.cat([fitted, x])).chunk(2)
        z0 = z0 + encoded - original
        state.record("the encoded match fit", z0)
    return MatchFit(z0, x if refined_later else fitted)


def guided_step(
    state: Trajectory, estimate: Estimate, rounds: tuple[Round, ...], is_last: bool
) -> GuidedStep:
    """Run the rounds of one denoising step; the fitted map is the result if the step ``is_last``."""
    z = estimate.latent
    anchor = None
    x = None
    is_current = False
    for k, (fits_matches, updates) in enumerate(rounds):
        is_current = fits_matches and not updates
        first_loss: Loss | None = None  # of the round, before its updates
        if fits_matches:
            is_result = is_last and k == len(rounds) - 1 and not updates
            fitted, x = match_fit_step(state, estimate, z, is_result)
            anchor = fitted if anchor is None else anchor + fitted - z
            z = fitted
        elif not updates:
            z0 = estimate.z0(z).detach()
            x = estimate.decode(z0).detach()
            state.prepare(x, z0)
        for i in range(updates):
            anchor = estimate.z0(z).detach() if anchor is None else anchor
            z, x, loss = gradient_step(state, estimate, z, anchor, is_first=i == 0)
            first_loss = loss if first_loss is None else first_loss
        state.report(first_loss)
    assert x is not None  # there is at least one round
    return GuidedStep((z - estimate.latent).detach(), x, is_current)
