"""Ray casting: rays in bundles, primitives culled per bundle by a cone, exact intersections for the pairs that remain.

Hop: ray bundles + primitives -> nearest hit, or how strongly something blocks the way.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from geodiff_plugin.synthetic.primitives import INTERSECT
from geodiff_plugin.synthetic.scene import Material, Scene, Shape

__all__ = ["Bundles", "World", "blocked", "nearest", "openness"]

_PAIR_ELEMENTS = {"cpu": 1 << 17, "cuda": 1 << 25}


@dataclass(frozen=True)
class World:
    """Primitives of several scenes in one table; ``N`` slots a scene, unused ones can never be hit.

    Attributes:
        scenes: number of scenes ``S``.
        shape: ``(S * N,)`` int64.
        matrix: ``(S * N, 3, 4)`` world to local.
        extent: ``(S * N, 3)`` local half extents (0 for a flat axis).
        taper: ``(S * N, 2)``.
        centre: ``(S, N, 3)``; ``radius`` ``(S, N)``.
        radius: bounding spheres.
        opaque: ``(S, N)`` bool, casts shadows.
        turn: ``(S * N, 3, 4)`` world to local in metres (rotation and offset only).
        core: ``(S * N, 3)`` half extents in metres of the box (or ellipsoid) that stands for it near other things.
        table: ``(F, S * N)`` float parameters for shading, rows as in ``shading.ROWS``.
    """

    scenes: int
    shape: torch.Tensor
    matrix: torch.Tensor
    extent: torch.Tensor
    taper: torch.Tensor
    centre: torch.Tensor
    radius: torch.Tensor
    opaque: torch.Tensor
    turn: torch.Tensor
    core: torch.Tensor
    table: torch.Tensor

    @classmethod
    def gather(cls, scenes: Sequence[Scene], device: str | torch.device) -> World:
        """Pad the scenes to the same number of primitives and move them to the device."""
        slots = max(s.shape.shape[0] for s in scenes)

        def stack(pick, fill=0.0):
            rows = []
            for s in scenes:
                x = pick(s)
                pad = torch.full((slots - x.shape[0], *x.shape[1:]), fill, dtype=x.dtype)
                rows.append(torch.cat([x, pad]))
            return torch.stack(rows)

        shape = stack(lambda s: s.shape, 0)
        extent = stack(lambda s: torch.stack(
            [torch.ones(len(s.shape)), (s.shape != Shape.QUAD).float(), torch.ones(len(s.shape))], 1))
        matrix = stack(lambda s: s.world_to_local)
        table = torch.cat([
            shape[..., None].float(), matrix.flatten(2), stack(lambda s: s.half), stack(lambda s: s.taper),
            stack(lambda s: s.material)[..., None].float(), stack(lambda s: s.layer)[..., None].float(),
            stack(lambda s: s.tile_m, 1.0), stack(lambda s: s.tile_offset), stack(lambda s: s.palette).flatten(2),
            stack(lambda s: s.gloss)[..., None], stack(lambda s: s.macro)[..., None],
            stack(lambda s: s.emission)[..., None],
        ], -1).flatten(0, 1).t().contiguous()
        opaque = stack(lambda s: (s.material != Material.GLASS) & (s.emission <= 0), False)
        half, taper = stack(lambda s: s.half, 1.0), stack(lambda s: s.taper)
        turn = matrix * half[..., None]
        slim = torch.stack([1 - taper[..., 0], torch.ones_like(taper[..., 0]), 1 - taper[..., 1]], -1)
        round_ = torch.tensor([0.7, 1.0, 0.7]) * torch.stack([(1 + taper[..., 0]) / 2, torch.ones_like(taper[..., 0]), (1 + taper[..., 0]) / 2], -1)
        core = half * extent
        core = torch.where((shape == Shape.TAPER)[..., None], core * slim.clamp_min(0), core)
        core = torch.where((shape == Shape.FRUSTUM)[..., None], core * round_, core)
        flat = [x.flatten(0, 1).to(device) for x in (shape, matrix, extent, stack(lambda s: s.taper))]
        return cls(len(scenes), *flat, stack(lambda s: s.centre).to(device),
                   stack(lambda s: s.radius, -1e6).to(device), opaque.to(device),
                   turn.flatten(0, 1).to(device), core.flatten(0, 1).to(device), table.to(device))


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


def _offsets(world: World, scene: torch.Tensor, apex: torch.Tensor, axis: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
    """Squared distance of every primitive's centre from each apex and its length along the axis, radius, opacity."""
    if world.scenes == 1:
        centre, radius, opaque = world.centre, world.radius, world.opaque  # broadcast over bundles
    else:
        centre, radius, opaque = world.centre[scene], world.radius[scene], world.opaque[scene]
    v = [centre[..., k] - apex[k][:, None] for k in range(3)]
    d2 = torch.addcmul(torch.addcmul(v[0] * v[0], v[1], v[1]), v[2], v[2])
    if axis is None:
        return d2, d2, radius, opaque
    along = torch.addcmul(torch.addcmul(v[0] * axis[0][:, None], v[1], axis[1][:, None]), v[2], axis[2][:, None])
    return d2, along, radius, opaque


def _pairs(world: World, rays: Bundles, casters: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Bundles and primitives (global indices) that may meet."""
    apex, spread, axis, cos, sin, length = _cone(rays)
    d2, along, radius, opaque = _offsets(world, rays.scene, apex, axis)
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
    reach = torch.minimum(d2[b, n].sqrt() + radius[b, n], length[b])
    tangent = sin / cos.clamp_min(0.05)
    wide = (cos < 0.3)[b]
    inflate = spread[b] + reach * tangent[b]
    m = world.matrix[prim]
    o = (m[:, :, :3] * apex.t()[b][:, None]).sum(-1) + m[:, :, 3]
    d = (m[:, :, :3] * axis.t()[b][:, None]).sum(-1)
    d = d + torch.copysign(torch.full_like(d, 1e-9), d)
    bound = world.extent[prim] + inflate[:, None] * m[:, :, :3].square().sum(-1).sqrt()
    inverse = d.reciprocal()
    middle, half = -o * inverse, bound * inverse.abs()
    near, far = (middle - half).amax(-1), (middle + half).amin(-1)
    ok = ((near <= far) & (far >= 0) & (near <= reach)) | wide
    return b[ok], prim[ok]


def _local(matrix: torch.Tensor, v: torch.Tensor, with_offset: bool) -> tuple[torch.Tensor, ...]:
    """Apply the affine (or linear) map of each pair to ``(3, pairs, rays)``."""
    out = []
    for k in range(3):
        c = torch.addcmul(matrix[:, k, 0, None] * v[0], matrix[:, k, 1, None], v[1])
        c = torch.addcmul(c, matrix[:, k, 2, None], v[2])
        out.append(c + matrix[:, k, 3, None] if with_offset else c)
    return tuple(out)


def openness(
    world: World,
    scene: torch.Tensor,
    point: torch.Tensor,
    normal: torch.Tensor,
    live: torch.Tensor,
    length: torch.Tensor,
) -> torch.Tensor:
    """How free the space above a surface is, from the distances to what stands near.

    Looks at two points above the surface, at 0.25 and 0.8 of ``length``: in the open, each is as far from everything
    as from its own surface; near a wall or under a table it is closer to something else. Smooth and free of noise.

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
    middle = (point * weight).sum(-1) / weight.sum(-1).clamp_min(1)
    away = point - middle[..., None]
    spread = ((away * away).sum(0) * weight).amax(-1).sqrt() + 1.6 * length
    d2, _, radius, opaque = _offsets(world, scene, middle, None)
    reach = radius + spread[:, None]
    keep = (d2 <= reach * reach) & (radius > 0) & opaque & live.any(-1)[:, None]
    b, n = keep.nonzero(as_tuple=True)
    prim = scene[b] * world.centre.shape[1] + n
    turn = world.turn[prim]  # (pairs, 3, 4) world to local, in metres
    gap = (turn[:, :, :3] * middle.t()[b][:, None]).sum(-1).add_(turn[:, :, 3]).abs_().sub_(world.core[prim]).clamp_min_(0)
    near = gap.square().sum(-1) <= spread[b].square()
    b, prim = b[near], prim[near]
    ball = world.shape[prim] == int(Shape.SPHERE)
    heights = [k * length[:, None] for k in (0.25, 0.8)]
    distance = [h.expand_as(weight).clone() for h in heights]
    step = max(1, _PAIR_ELEMENTS.get(point.device.type, 1 << 20) // point.shape[2])
    for mask, measure in ((~ball, _box_distance), (ball, _ellipsoid_distance)):
        bundle, which = b[mask], prim[mask]
        for start in range(0, bundle.shape[0], step):
            bc, pc = bundle[start : start + step], which[start : start + step]
            turn, core = world.turn[pc], world.core[pc]
            base = _local(turn, point.index_select(1, bc), True)
            rise = _local(turn, normal.index_select(1, bc), False)
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


def _hits(world: World, rays: Bundles, casters: bool) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Chunks of ``bundle (n,), primitive (n,), t (n, P)``; ``t`` is inf where it does not count."""
    bundle, prim = _pairs(world, rays, casters)
    kinds = world.shape[prim]
    rays_each = rays.t_max.shape[1]
    step = max(1, _PAIR_ELEMENTS.get(rays.t_max.device.type, 1 << 20) // rays_each)
    for shape, intersect in INTERSECT.items():
        (mine,) = (kinds == int(shape)).nonzero(as_tuple=True)
        for start in range(0, mine.shape[0], step):
            part = mine[start : start + step]
            b, n = bundle[part], prim[part]
            matrix = world.matrix[n]
            o = _local(matrix, rays.origin.index_select(1, b), True)
            d = _local(matrix, rays.direction.index_select(1, b), False)
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
