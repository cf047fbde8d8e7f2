"""Bring a metric map to its matches by an edge-aware fit: at every step, and once more at full resolution.

Hop: metric depth, ``MatchTarget``, left image -> smooth log correction -> metric depth, support.
Paper: none; its output is the decoded latent, which the decoder's grid and its blur limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.terms import MatchTarget

__all__ = ["Refined", "refine_depth"]

#: Relative error of a perfect match: below it one match is as good as another.
MATCH_NOISE = 0.02
#: Residual, in standard deviations of a match, from which it counts for less (Cauchy).
CAUCHY = 2.0
#: Weight of the correction's slope against a sure match, and of the correction itself: what is far from every
#: match keeps its depth.
SMOOTHNESS, INERTIA = 0.7, 3e-3
#: Steps in brightness and in log depth across which a correction does not spread.
IMAGE_EDGE, DEPTH_EDGE, LEAST_LINK = 0.1, 0.1, 1e-3
#: Reweighted solves, and conjugate-gradient steps of each: fixed numbers, so that no device is waited for.
REWEIGHTINGS, STEPS = 3, 60


@dataclass(frozen=True)
class Refined:
    """Result of ``refine_depth``, on the grid of the depth that it was given.

    Attributes:
        depth_m: ``(B, 1, H, W)`` metres.
        support: ``(B, 1, H, W)`` in [0, 1]: how far matches, own or near on the same surface, decided the
            depth; 0 where it is the one given.
    """

    depth_m: Tensor
    support: Tensor


@torch.no_grad()
def refine_depth(depth_m: Tensor, target: MatchTarget, left_01: Tensor) -> Refined:
    """Least-squares correction of log depth that follows matches and stops at edges.

    Args:
        depth_m: ``(B, 1, H, W)`` metres, at any resolution.
        target: matches or known points of the same images, on any grid; the gate was applied by the caller.
        left_01: ``(B, 3, h, w)`` in [0, 1], the left images at any resolution.

    Returns:
        ``Refined``. With ``u`` the log of the factor on inverse depth and ``r`` what each match asks of it,
        the minimiser of ``sum w (u - r)^2 + 0.7 sum g |grad u|^2 + 0.003 sum u^2``, where ``w`` is the
        confidence over the match's relative variance, robustly reweighted, and ``g`` falls at edges of the
        image and of the given depth.
    """
    size = tuple(target.inverse_depth.shape[-2:])
    guide = F.interpolate(left_01.float(), size, mode="bilinear", antialias=True)
    coarse = F.interpolate(depth_m.float(), size, mode="bilinear", align_corners=False)
    known, step = target.inverse_depth.clamp_min(1e-9), target.plane_step.view(-1, 1, 1, 1)
    wanted = (known * coarse).log()
    noise = ((step / known) ** 2 + MATCH_NOISE**2).sqrt()
    trusted = target.confidence * (MATCH_NOISE / noise) ** 2
    wanted = torch.where(trusted > 0, wanted, torch.zeros_like(wanted))
    across, down = (_links(guide, coarse, axis) for axis in (-1, -2))
    # Two right-hand sides in one solve: the correction, and a field of ones that shows where it is decided.
    data = torch.cat([wanted, torch.ones_like(wanted)], 1)
    field, weight = torch.zeros_like(data), trusted
    for _ in range(REWEIGHTINGS):
        field = _solve(field, data, weight, across, down)
        residual = (field[:, :1] - wanted) / (CAUCHY * noise)
        weight = trusted / (1.0 + residual**2)
    field = F.interpolate(field, depth_m.shape[-2:], mode="bilinear", align_corners=False)
    refined_m = depth_m.float() * torch.exp(-field[:, :1])
    return Refined(refined_m.to(depth_m.dtype), field[:, 1:].clamp(0.0, 1.0))


def _links(guide: Tensor, depth_m: Tensor, axis: int) -> Tensor:
    """Strength with which neighbours along an axis share a correction, ``(B, 1, h, w)`` less one there."""
    step = guide.diff(dim=axis).abs().mean(1, keepdim=True) / IMAGE_EDGE
    jump = depth_m.log().diff(dim=axis).abs() / DEPTH_EDGE
    return SMOOTHNESS * torch.exp(-step - jump).clamp_min(LEAST_LINK)


def _solve(start: Tensor, data: Tensor, weight: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Conjugate gradients with a diagonal preconditioner, on every channel by itself."""

    def spread(x: Tensor) -> Tensor:
        flow_x, flow_y = across * x.diff(dim=-1), down * x.diff(dim=-2)
        out = (weight + INERTIA) * x
        out[..., 1:] += flow_x
        out[..., :-1] -= flow_x
        out[..., 1:, :] += flow_y
        out[..., :-1, :] -= flow_y
        return out

    diagonal = weight + INERTIA + F.pad(across, (1, 0)) + F.pad(across, (0, 1))
    diagonal = diagonal + F.pad(down, (0, 0, 1, 0)) + F.pad(down, (0, 0, 0, 1))
    return _conjugate_gradients(spread, start, weight * data, diagonal)


def _conjugate_gradients(
    apply: Callable[[Tensor], Tensor], x: Tensor, target: Tensor, diagonal: Tensor
) -> Tensor:
    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum((-2, -1), keepdim=True)

    tiny = 1e-20  # a channel that has converged stays where it is
    residual = target - apply(x)
    z = residual / diagonal
    direction, along = z, dot(residual, z)
    for _ in range(STEPS):
        image = apply(direction)
        length = along / dot(direction, image).clamp_min(tiny)
        x = x + length * direction
        residual = residual - length * image
        z = residual / diagonal
        before, along = along, dot(residual, z)
        direction = z + along / before.clamp_min(tiny) * direction
    return x
