"""Intersections and culling against closed forms and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.scenes.builder import Builder, Look, rotation
from tests.scenes.cameras import camera_rays, intrinsics
from tests.scenes.layouts import sample_scene
from tests.scenes.occlusion import openness
from tests.scenes.primitives import INTERSECT, surface
from tests.scenes.scene import Camera, Shape
from tests.scenes.tracing import Bundles, blocked, nearest
from tests.scenes.world import World

INF = float("inf")


def random_rays(count: int, seed: int):
    """Rays from outside towards the unit shape, some of them missing it."""
    g = torch.Generator().manual_seed(seed)
    origin = torch.nn.functional.normalize(torch.randn(3, count, generator=g, dtype=torch.float64), dim=0) * 4
    target = torch.rand(3, count, generator=g, dtype=torch.float64) * 3 - 1.5
    return origin, target - origin


def inside(shape: Shape, p: torch.Tensor, taper: tuple[float, float]) -> torch.Tensor:
    """Membership in the canonical shape, written independently of the intersections."""
    x, y, z = p
    slab = y.abs() <= 1
    if shape == Shape.SPHERE:
        return x**2 + y**2 + z**2 <= 1
    if shape == Shape.FRUSTUM:
        radius = taper[0] + (1 - taper[0]) * (y + 1) / 2
        return slab & (x**2 + z**2 <= radius**2)
    wide = (1 - y) / 2 if shape == Shape.TAPER else torch.zeros_like(y)
    return slab & (x.abs() <= 1 - taper[0] * wide) & (z.abs() <= 1 - taper[1] * wide)


@pytest.mark.parametrize(
    ("shape", "taper"),
    [
        (Shape.BOX, (0.0, 0.0)),
        (Shape.SPHERE, (0.0, 0.0)),
        (Shape.FRUSTUM, (1.0, 0.0)),
        (Shape.FRUSTUM, (0.4, 0.0)),
        (Shape.FRUSTUM, (0.0, 0.0)),
        (Shape.FRUSTUM, (1.3, 0.0)),
        (Shape.TAPER, (0.3, 0.7)),
        (Shape.TAPER, (1.0, 0.0)),
    ],
)
def test_first_hit_agrees_with_marching_along_the_ray(shape, taper):
    origin, direction = random_rays(300, int(shape))
    o, d = (tuple(v[k][None] for k in range(3)) for v in (origin, direction))
    t = INTERSECT[shape](o, d, torch.tensor([taper], dtype=torch.float64))[0]
    steps = torch.linspace(0, 2, 4001, dtype=torch.float64)
    points = origin[:, :, None] + direction[:, :, None] * steps
    occupied = inside(shape, points, taper)
    first = torch.where(occupied.any(-1), steps[occupied.double().argmax(-1)], INF)
    hit = torch.isfinite(first)
    assert hit.float().mean() > 0.2
    # A ray may graze between two steps; nothing else may differ.
    assert (torch.isfinite(t) & ~hit).float().mean() < 0.02
    assert torch.isfinite(t[hit]).all()
    assert (first[hit] - t[hit]).min() > -1e-9
    assert (first[hit] - t[hit]).max() < 1.5 * (steps[1] - steps[0])


@pytest.mark.parametrize("shape", list(Shape))
def test_normals_are_perpendicular_to_the_surface(shape):
    taper = {Shape.FRUSTUM: (0.5, 0.0), Shape.TAPER: (0.3, 0.5)}.get(shape, (1.0, 0.0))
    origin, direction = random_rays(400, 7)
    o, d = (tuple(v[k][None] for k in range(3)) for v in (origin, direction))
    row = torch.tensor([taper], dtype=torch.float64)
    t = INTERSECT[shape](o, d, row)[0]
    keep = torch.isfinite(t)
    p = (origin + direction * t)[:, keep]
    count = p.shape[1]
    half, tapers = torch.ones(3, count, dtype=torch.float64), row.t().expand(2, count)
    normal, uv = surface(torch.full((count,), int(shape)), p, half, tapers)
    normal = torch.nn.functional.normalize(normal, dim=0)
    assert torch.isfinite(uv).all()
    if shape == Shape.QUAD:
        assert (normal == torch.tensor([[0.0], [-1.0], [0.0]], dtype=torch.float64)).all()
        return
    # Just outside along the normal is outside, just inside is inside; edges aside.
    out, in_ = inside(shape, p + 1e-3 * normal, taper), inside(shape, p - 1e-3 * normal, taper)
    assert out.float().mean() < 0.02
    assert in_.float().mean() > 0.97


def test_small_far_ball_is_round():
    """Float32 must hold for a ball of 5 cm at 100 m."""
    o = tuple(torch.tensor([[v]]) for v in (0.0, 0.0, -2000.0))
    x = torch.linspace(-1.2, 1.2, 400)
    d = (x[None], torch.zeros(1, 400), torch.full((1, 400), 2000.0))
    t = INTERSECT[Shape.SPHERE](o, d, torch.zeros(1, 2))[0]
    half_angle = 1 / math.sqrt(2000**2 - 1) * 2000
    assert (torch.isfinite(t) == (x.abs() < half_angle)).float().mean() > 0.99


def brute_force(world: World, rays: Bundles) -> torch.Tensor:
    """Every ray against every primitive of its scene."""
    slots = world.centre.shape[1]
    best = torch.full_like(rays.t_max, INF)
    for b in range(rays.scene.shape[0]):
        for n in range(int(rays.scene[b]) * slots, (int(rays.scene[b]) + 1) * slots):
            if world.radius.flatten()[n] < 0:
                continue
            m = world.matrix[n]
            o = tuple((m[k, :3, None] * rays.origin[:, b]).sum(0)[None] + m[k, 3] for k in range(3))
            d = tuple((m[k, :3, None] * rays.direction[:, b]).sum(0)[None] for k in range(3))
            t = INTERSECT[Shape(int(world.shape[n]))](o, d, world.taper[n : n + 1])[0]
            t = t.masked_fill((t > rays.t_max[b]) | (rays.skip[b] == n), INF)
            best[b] = torch.minimum(best[b], t)
    return best


def agreement(t: torch.Tensor, expected: torch.Tensor) -> float:
    """Share of rays with the same result."""
    same = (torch.isinf(t) & torch.isinf(expected)) | ((t - expected).abs() <= 1e-4 * expected)
    return float(same.float().mean())


@pytest.mark.parametrize("kind", ["terrain", pytest.param("room", marks=pytest.mark.slow)])
def test_culling_loses_no_hit(kind):
    scenes = [sample_scene(3, kind), sample_scene(4, "tabletop")]
    cameras = [Camera(intrinsics((24, 32), s.fov_deg), s.T_world_from_camera) for s in scenes]
    world = World.gather(scenes, "cpu")
    rays, _, _ = camera_rays(cameras, torch.tensor([0, 1]), (24, 32), "cpu", 1e4)
    t, prim = nearest(world, rays)
    assert agreement(t, brute_force(world, rays)) == 1
    assert torch.equal(prim >= 0, torch.isfinite(t))
    # Secondary rays: from the hits in random directions, not starting on their own primitive.
    g = torch.Generator().manual_seed(1)
    point = rays.origin + rays.direction * t.masked_fill(prim < 0, 0.0)
    way = torch.randn(point.shape, generator=g)
    second = Bundles(rays.scene, point, way, (prim >= 0) * 3.0, prim)
    t2, _ = nearest(world, second)
    # Rays that start where two things touch may round to either side.
    assert agreement(t2, brute_force(world, second)) > 0.99


def one_box() -> World:
    """A floor and a cube of 1 m on it at 4 m."""
    b = Builder(np.random.default_rng(0))
    grey = Look("plain", np.full((3, 3), 0.5))
    b.quad((0, 0, 5), 20, 20, grey, fixed=True)
    b.box((0, -0.5, 4), (1, 1, 1), grey)
    scene = b.finish(np.eye(4), 0.0, **_rest())
    return World.gather([scene], "cpu")


def _rest() -> dict:
    t = torch.zeros(3)
    return dict(
        ambient_up=t, ambient_down=t, ao_length_m=1.0, sky=torch.zeros(3, 3), sky_clouds=0.0, fog_density=0.0,
        fog_colour=t, fov_deg=60.0, baseline_m=0.1, kind="room", seed=0,
    )  # fmt: skip


def test_shadow_rays_are_blocked_by_the_box_only():
    world = one_box()
    x = torch.linspace(-2, 2, 64)
    origin = torch.stack([x, torch.zeros(64), torch.full((64,), 4.0)])[:, None]
    up = torch.tensor([0.0, -1.0, 0.0])[:, None, None].expand(3, 1, 64)
    rays = Bundles(
        torch.zeros(1, dtype=torch.long),
        origin,
        up,
        torch.full((1, 64), 9.0),
        torch.zeros(1, 64, dtype=torch.long),
    )
    outside = origin.clone()
    outside[1] = -3.0
    assert torch.equal(
        blocked(world, rays)[0] > 0, torch.zeros(64, dtype=torch.bool)
    )  # starts inside: not seen
    down = Bundles(rays.scene, outside, -up, torch.full((1, 64), 2.99), rays.skip - 1)
    assert torch.equal(blocked(world, down)[0] > 0, x.abs() < 0.5)


def test_openness_falls_towards_a_wall():
    world = one_box()
    x = torch.linspace(0.5, 2.5, 64)
    point = torch.stack([x, torch.zeros(64), torch.full((64,), 4.0)])[:, None]
    normal = torch.tensor([0.0, -1.0, 0.0])[:, None, None].expand(3, 1, 64)
    live = torch.ones(1, 64, dtype=torch.bool)
    free = openness(world, torch.zeros(1, dtype=torch.long), point, normal, live, torch.ones(1))[0]
    assert free[0] < 0.5
    assert (free.diff() >= -1e-6).all()
    assert free[-1] == pytest.approx(1.0)
    # At a distance d from a wall higher than both samples: the mean of d / 0.25 and d / 0.8, each at most 1.
    d = x - 0.5
    expected = ((d / 0.25).clamp(max=1) + (d / 0.8).clamp(max=1)) / 2
    torch.testing.assert_close(free, expected, atol=1e-4, rtol=0)


def test_rotation_convention():
    """Positive yaw looks right, positive pitch looks down, positive roll turns x towards y."""
    ahead, right = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    yaw, pitch, roll = (
        rotation(*(np.float64(v) for v in a)) for a in ((0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1))
    )
    assert (yaw @ ahead)[0] > 0
    assert (pitch @ ahead)[1] > 0
    assert (roll @ right)[1] > 0
    both = rotation(np.float64(0.3), np.float64(-0.2), np.float64(0.7))
    np.testing.assert_allclose(both @ both.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(both) == pytest.approx(1)
