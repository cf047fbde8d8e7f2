"""Ambient occlusion from distances to the nearest surfaces.

Data flow: surface points and normals + primitives -> openness in [0, 1].
"""

from __future__ import annotations

import torch

from tests.scenes.scene import Shape
from tests.scenes.tracing import candidates, chunk_pairs, to_local
from tests.scenes.world import World

__all__ = ["openness"]

_HEIGHTS = (0.25, 0.8)


def openness(
    world: World,
    scene: torch.Tensor,
    point: torch.Tensor,
    normal: torch.Tensor,
    live: torch.Tensor,
    length: torch.Tensor,
) -> torch.Tensor:
    """How free the space above a surface is, from the distances to what stands near.

    Looks at two points above the surface, at 0.25 and 0.8 of ``length``: in the open, each is as far from
    everything as from its own surface; near a wall or under a table it is closer to something else.

    Args:
        world: primitives.
        scene: ``(B,)`` int64.
        point: ``(3, B, P)`` on the surface.
        normal: ``(3, B, P)`` unit.
        live: ``(B, P)`` bool.
        length: ``(B,)`` metres, reach of the effect.

    Returns:
        ``(B, P)`` in [0, 1], 1 in the open.
    """
    weight = live.to(point.dtype)
    heights = [k * length[:, None] for k in _HEIGHTS]
    # Only what is in the ball of the upper point's height around it can matter, to the lower point as well.
    upper = torch.addcmul(point, normal, heights[1])
    middle = (upper * weight).sum(-1) / weight.sum(-1).clamp_min(1)
    away = upper - middle[..., None]
    spread = ((away * away).sum(0) * weight).amax(-1).sqrt() + heights[1][:, 0]
    d2, _, radius, opaque = candidates(world, scene, middle, None)
    extent = radius + spread[:, None]
    keep = (d2 <= extent * extent) & (radius > 0) & opaque & live.any(-1)[:, None]
    b, n = keep.nonzero(as_tuple=True)
    prim = scene[b] * world.centre.shape[1] + n
    turn = world.turn[prim]  # (pairs, 3, 4) world to local, in metres
    gap = (
        (turn[:, :, :3] * middle.t()[b][:, None])
        .sum(-1)
        .add_(turn[:, :, 3])
        .abs_()
        .sub_(world.core[prim])
        .clamp_min_(0)
    )
    near = gap.square().sum(-1) <= spread[b].square()
    b, prim = b[near], prim[near]
    ball = world.shape[prim] == int(Shape.SPHERE)
    distance = [h.expand_as(weight).clone() for h in heights]
    step = chunk_pairs(weight)
    for mask, measure in ((~ball, _box_distance), (ball, _ellipsoid_distance)):
        bundle, which = b[mask], prim[mask]
        for start in range(0, bundle.shape[0], step):
            bc, pc = bundle[start : start + step], which[start : start + step]
            turn, core = world.turn[pc], world.core[pc]
            base = to_local(turn, point.index_select(1, bc), True)
            rise = to_local(turn, normal.index_select(1, bc), False)
            for k, h in enumerate(heights):
                d = measure([torch.addcmul(o, r, h[bc]) for o, r in zip(base, rise, strict=True)], core)
                distance[k].scatter_reduce_(0, bc[:, None].expand_as(d), d, "amin")
    free = [(d / h).clamp(0, 1) for d, h in zip(distance, heights, strict=True)]
    return 0.5 * (free[0] + free[1])


def _box_distance(p: list[torch.Tensor], half: torch.Tensor) -> torch.Tensor:
    q = [x.abs_().sub_(half[:, k, None]).clamp_min_(0) for k, x in enumerate(p)]
    return torch.addcmul(torch.addcmul(q[0] * q[0], q[1], q[1]), q[2], q[2]).sqrt_()


def _ellipsoid_distance(p: list[torch.Tensor], half: torch.Tensor) -> torch.Tensor:
    """First-order distance to an ellipsoid: exact at the surface and for balls."""
    q = [x / half[:, k, None] for k, x in enumerate(p)]
    r = [x / half[:, k, None] for k, x in enumerate(q)]
    k0 = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]).sqrt_()
    k1 = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]).sqrt_().clamp_min_(1e-9)
    return k0 * (k0 - 1) / k1
