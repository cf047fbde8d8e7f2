"""Ray casting: bundles of rays, primitives culled by a cone around each bundle, then exact intersections.

Data flow: ray bundles + primitives -> nearest hit, or how strongly something blocks the way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from tests.scenes.primitives import INTERSECT
from tests.scenes.world import World

__all__ = ["Bundles", "blocked", "candidates", "chunk_pairs", "nearest", "to_local"]

_PAIR_ELEMENTS = {"cpu": 1 << 16, "cuda": 1 << 25}


@dataclass(frozen=True)
class Bundles:
    """``B`` bundles of ``P`` rays each that point to about the same place.

    Attributes:
        scene: ``(B,)`` int64.
        origin: ``(3, B, P)`` or ``(3, B, 1)``.
        direction: ``(3, B, P)`` or ``(3, B, 1)``, not normalised; ``t`` counts in its length.
        t_max: ``(B, P)``, 0 for a ray that must not be followed.
        skip: ``(B, P)`` int64, the primitive that the ray starts on (its hits do not count), -1 for none.
    """

    scene: torch.Tensor
    origin: torch.Tensor
    direction: torch.Tensor
    t_max: torch.Tensor
    skip: torch.Tensor


def _cone(rays: Bundles) -> tuple[torch.Tensor, ...]:
    """Apex, apex radius, axis, cos, sin, length of a cone around all live rays of each bundle."""
    live = (rays.t_max > 0).to(rays.origin.dtype)
    count = live.sum(-1).clamp_min(1)
    norm = (rays.direction * rays.direction).sum(0).sqrt().clamp_min(1e-12)  # (B, P or 1)
    length = (rays.t_max * norm).amax(-1)
    if rays.origin.shape[-1] == 1:
        apex = rays.origin[..., 0]
        spread = torch.zeros_like(length)
    else:
        apex = (rays.origin * live).sum(-1) / count
        away = rays.origin - apex[..., None]
        spread = ((away * away).sum(0) * live).amax(-1).sqrt()
    if rays.direction.shape[-1] == 1:
        axis = rays.direction[..., 0] / norm[..., 0]
        cos = torch.ones_like(length)
    else:
        unit = rays.direction / norm
        axis = (unit * live).sum(-1)
        axis = axis / (axis * axis).sum(0).sqrt().clamp_min(1e-6)
        dot = (unit * axis[..., None]).sum(0)
        cos = (dot - 1).mul_(live).amin(-1).add_(1).clamp(-1, 1)
    sin = (1 - cos * cos).clamp_min(0).sqrt()
    return apex, spread, axis, cos, sin, length


def candidates(
    world: World, scene: torch.Tensor, apex: torch.Tensor, axis: torch.Tensor | None
) -> tuple[torch.Tensor, ...]:
    """Squared distance of every centre from each apex, its length along the axis, radius, opacity."""
    if world.scenes == 1:
        centre, radius, opaque = world.centre, world.radius, world.opaque  # broadcast over bundles
    else:
        centre, radius, opaque = world.centre[scene], world.radius[scene], world.opaque[scene]
    v = [centre[..., k] - apex[k][:, None] for k in range(3)]
    d2 = torch.addcmul(torch.addcmul(v[0] * v[0], v[1], v[1]), v[2], v[2])
    if axis is None:
        return d2, d2, radius, opaque
    along = torch.addcmul(
        torch.addcmul(v[0] * axis[0][:, None], v[1], axis[1][:, None]), v[2], axis[2][:, None]
    )
    return d2, along, radius, opaque


def _pairs(world: World, rays: Bundles, casters: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Bundles and primitives (global indices) that may meet."""
    apex, spread, axis, cos, sin, length = _cone(rays)
    d2, along, radius, opaque = candidates(world, rays.scene, apex, axis)
    radius = radius + spread[:, None]
    across = (d2 - along * along).clamp_min_(0).sqrt_()
    cos_, sin_ = cos[:, None], sin[:, None]
    keep = (across * cos_ - along * sin_ <= radius) & (along * cos_ + across * sin_ > -radius)
    keep &= along <= length[:, None] + radius
    keep |= d2 <= radius * radius
    keep &= (radius > 0) & (length > 0)[:, None]
    if casters:
        keep &= opaque
    b, n = keep.nonzero(as_tuple=True)
    # Second look: the cone's axis against the oriented box, inflated by the cone's width at the far side.
    prim = rays.scene[b] * world.centre.shape[1] + n
    half_size = torch.minimum(d2[b, n].sqrt() + radius[b, n], length[b])
    tangent = sin / cos.clamp_min(0.05)
    wide = (cos < 0.3)[b]
    inflate = spread[b] + half_size * tangent[b]
    m = world.matrix[prim]
    o = (m[:, :, :3] * apex.t()[b][:, None]).sum(-1) + m[:, :, 3]
    d = (m[:, :, :3] * axis.t()[b][:, None]).sum(-1)
    d = d + torch.copysign(torch.full_like(d, 1e-9), d)
    bound = world.extent[prim] + inflate[:, None] * m[:, :, :3].square().sum(-1).sqrt()
    inverse = d.reciprocal()
    middle, half = -o * inverse, bound * inverse.abs()
    near, far = (middle - half).amax(-1), (middle + half).amin(-1)
    ok = ((near <= far) & (far >= 0) & (near <= half_size)) | wide
    return b[ok], prim[ok]


def chunk_pairs(rays: torch.Tensor) -> int:
    """Pairs of a bundle and a primitive to work on at once, for ``(B, P)`` rays on their device."""
    return max(1, _PAIR_ELEMENTS.get(rays.device.type, 1 << 20) // rays.shape[1])


def to_local(matrix: torch.Tensor, v: torch.Tensor, with_offset: bool) -> tuple[torch.Tensor, ...]:
    """Apply the affine (or linear) map of each pair to ``(3, pairs, rays)``."""
    out = []
    for k in range(3):
        c = torch.addcmul(matrix[:, k, 0, None] * v[0], matrix[:, k, 1, None], v[1])
        c = torch.addcmul(c, matrix[:, k, 2, None], v[2])
        out.append(c + matrix[:, k, 3, None] if with_offset else c)
    return tuple(out)


def _hits(
    world: World, rays: Bundles, casters: bool
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Chunks of ``bundle (n,), primitive (n,), t (n, P)``; ``t`` is inf where it does not count."""
    bundle, prim = _pairs(world, rays, casters)
    kinds = world.shape[prim]
    step = chunk_pairs(rays.t_max)
    for shape, intersect in INTERSECT.items():
        (mine,) = (kinds == int(shape)).nonzero(as_tuple=True)
        for start in range(0, mine.shape[0], step):
            part = mine[start : start + step]
            b, n = bundle[part], prim[part]
            matrix = world.matrix[n]
            o = to_local(matrix, rays.origin.index_select(1, b), True)
            d = to_local(matrix, rays.direction.index_select(1, b), False)
            t = intersect(o, d, world.taper[n])
            bad = (t > rays.t_max.index_select(0, b)) | (rays.skip.index_select(0, b) == n[:, None])
            yield b, n, t.masked_fill_(bad, float("inf"))


def nearest(world: World, rays: Bundles) -> tuple[torch.Tensor, torch.Tensor]:
    """First hit of every ray.

    Returns:
        ``t`` ``(B, P)``, inf for none, and the primitive ``(B, P)`` int64, -1 for none.
    """
    best = torch.full_like(rays.t_max, float("inf"))
    found = list(_hits(world, rays, casters=False))
    for b, _, t in found:
        best.scatter_reduce_(0, b[:, None].expand_as(t), t, "amin")
    who = torch.full_like(best, -1.0)
    for b, n, t in found:
        # Equal depths go to the larger index, whatever the order of the pairs.
        mine = n[:, None].to(t.dtype).expand_as(t).masked_fill(t > best.index_select(0, b), -1.0)
        who.scatter_reduce_(0, b[:, None].expand_as(t), mine, "amax")
    who = who.masked_fill(best == float("inf"), -1.0)
    return best, who.long()


def blocked(world: World, rays: Bundles) -> torch.Tensor:
    """Whether something opaque stands in the way of each ray: ``(B, P)`` float, 0 or 1."""
    total = torch.zeros_like(rays.t_max)
    for b, _, t in _hits(world, rays, casters=True):
        total.index_add_(0, b, (t < float("inf")).to(t.dtype))
    return total.clamp_max_(1)
