"""Stereo pairs with exact depth, and batches of single views for training.

Hop: a seed -> ``SyntheticPair``, or seeds -> images and depths.
Paper: S3.3 (two posed views); S5.2 (mirrors and glass).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.synthetic.builder import rotation
from geodiff_plugin.synthetic.effects import CameraEffects, apply_effects, sample_effects
from geodiff_plugin.synthetic.layouts import sample_scene
from geodiff_plugin.synthetic.render import as_views, expose, render_linear
from geodiff_plugin.synthetic.scene import Camera, RenderedView, Scene
from geodiff_plugin.synthetic.tracing import Bundles, World, nearest

__all__ = ["SyntheticPair", "intrinsics", "render_mono", "render_pair"]


@dataclass(frozen=True)
class SyntheticPair:
    """Two views of a scene.

    Attributes:
        left: the reference view.
        right: the second view.
        K_left: ``(3, 3)`` float64, pixels of the left image.
        K_right: ``(3, 3)`` float64, pixels of the right image.
        E: ``(4, 4)`` float64, metres; pose of the right camera in the left camera's frame.
        occluded: ``(1, H, W)`` bool, left pixels whose surface point is hidden from the right camera by something else.
        in_view: ``(1, H, W)`` bool, left pixels whose point projects into the right image, hidden or not.
        kind: kind of scene.
        seed: what it was drawn from.
    """

    left: RenderedView
    right: RenderedView
    K_left: torch.Tensor
    K_right: torch.Tensor
    E: torch.Tensor
    occluded: torch.Tensor
    in_view: torch.Tensor
    kind: str
    seed: int


def intrinsics(size: tuple[int, int], fov_deg: float) -> torch.Tensor:
    """``(3, 3)`` float64 with the field of view along the longer side and a centred principal point."""
    height, width = size
    f = max(height, width) / 2 / np.tan(np.radians(fov_deg) / 2)
    return torch.tensor([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64)


def _clear_of(scene: Scene, point: torch.Tensor, gap: float) -> Scene:
    """Leave out movable primitives that a camera at ``point`` would touch."""
    linear, offset = scene.world_to_local[:, :, :3], scene.world_to_local[:, :, 3]
    local = ((linear @ point.float()) + offset) * scene.half
    outside = (local.abs() - scene.half).clamp_min(0).square().sum(-1).sqrt()
    keep = scene.fixed | (outside > gap)
    return _select(scene, keep)


_PER_PRIMITIVE = frozenset({"shape", "world_to_local", "half", "taper", "centre", "radius", "material", "layer", "tile_m",
                            "tile_offset", "palette", "gloss", "macro", "emission", "fixed"})


def _relative_pose(rng: np.random.Generator, baseline: float, rotation_deg: float, posed: bool) -> np.ndarray:
    """``(4, 4)`` pose of the right camera in the left camera's frame."""
    pose = np.eye(4)
    pose[0, 3] = baseline
    if posed:
        way = np.array([rng.choice([-1, 1]), rng.uniform(-0.5, 0.5), rng.uniform(-0.6, 0.6)])
        pose[:3, 3] = baseline * rng.uniform(0.8, 1.3) * way / np.linalg.norm(way)
        yaw, pitch, roll = np.radians(rng.uniform(-1, 1, 3) * (12.0, 7.0, 6.0))
        pose[:3, :3] = rotation(yaw, pitch, roll)
    if rotation_deg:
        axis = rng.normal(size=3) * (0.6, 1.0, 0.6)
        axis = axis / np.linalg.norm(axis) * np.radians(rotation_deg)
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        angle = np.linalg.norm(axis)
        pose[:3, :3] = pose[:3, :3] @ (np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross)
    return pose


def _select(scene: Scene, keep: torch.Tensor) -> Scene:
    """The scene with only some of its primitives."""
    return replace(scene, **{name: getattr(scene, name)[keep] for name in _PER_PRIMITIVE})


def _in_sight(scene: Scene, size: tuple[int, int], K: torch.Tensor, margin_m: float) -> Scene:
    """Leave out movable primitives outside of the view by more than a margin: they only cast shadows or mirror."""
    pose = scene.T_world_from_camera
    p = (scene.centre - pose[:3, 3]) @ pose[:3, :3]
    reach = scene.radius + margin_m
    keep = p[:, 2] > -reach
    for axis in (0, 1):
        tangent = float((size[1 - axis] / 2 + 1) / K[axis, axis])
        # Distance to the side planes of the frustum.
        keep &= (p[:, axis].abs() - tangent * p[:, 2]) / (1 + tangent**2) ** 0.5 < reach
    return _select(scene, keep | scene.fixed)


@torch.no_grad()
def _hidden(scene: Scene, left: RenderedView, K_left, K_right, E, right_size, device) -> tuple[torch.Tensor, torch.Tensor]:
    """Cast a ray from the right camera to every left pixel's point: occluded, and inside the right image."""
    height, width = left.depth_m.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ray = torch.linalg.inv(K_left) @ torch.stack([x, y, torch.ones_like(x)]).double().reshape(3, -1)
    depth = left.depth_m.reshape(1, -1).double().cpu()
    finite = torch.isfinite(depth)
    p_left = ray * torch.where(finite, depth, torch.full_like(depth, 1e7))
    inverse = torch.linalg.inv(E)
    p_right = inverse[:3, :3] @ p_left + inverse[:3, 3:]
    pixel = K_right @ p_right
    uv = pixel[:2] / pixel[2:].clamp_min(1e-9)
    limit = torch.tensor([[right_size[1] - 0.5], [right_size[0] - 0.5]], dtype=torch.float64)
    in_view = ((uv > -0.5) & (uv < limit)).all(0) & (pixel[2] > 1e-6)
    pose = scene.T_world_from_camera.double() @ E
    towards = (pose[:3, :3] @ p_right).float()
    count = height * width
    tiles = -(-count // 64)
    pad = tiles * 64 - count
    direction = torch.cat([towards, towards[:, :1].expand(3, pad)], 1).reshape(3, tiles, 64).to(device)
    origin = pose[:3, 3].float().view(3, 1, 1).expand(3, tiles, 1).to(device)
    shape = (tiles, 64)
    # A hit clearly before the point hides it; for the sky (a point at 1e7) any hit does.
    tolerance = 2e-3
    rays = Bundles(torch.zeros(tiles, dtype=torch.int64, device=device), origin, direction,
                   torch.full(shape, 1 - tolerance, device=device), torch.full(shape, -1, device=device))
    t, _ = nearest(World.gather([scene], device), rays)
    hidden = torch.isfinite(t).reshape(-1)[:count].reshape(1, height, width)
    return hidden, in_view.reshape(1, height, width).to(device)


def render_pair(
    seed: int,
    kind: str | None = None,
    size: tuple[int, int] = (192, 256),
    baseline_m: float | None = None,
    rotation_deg: float = 0.0,
    exposure: bool = True,
    device: str | torch.device = "cpu",
    *,
    E: torch.Tensor | np.ndarray | None = None,
    posed: bool = False,
    K_left: torch.Tensor | np.ndarray | None = None,
    K_right: torch.Tensor | np.ndarray | None = None,
    size_right: tuple[int, int] | None = None,
    effects: bool | tuple[CameraEffects, CameraEffects] = False,
) -> SyntheticPair:
    """Render two views of a seeded scene with exact depth; rectified unless asked otherwise.

    Args:
        seed: non-negative; the same seed and arguments give the same pair.
        kind: one of ``KINDS``, or None to draw it.
        size: ``(H, W)`` of the left image.
        baseline_m: metres along +x; None for one that suits the kind (0.54 m on streets).
        rotation_deg: turns the right camera by this angle around a drawn axis.
        exposure: the right camera exposes a little differently.
        device: where to render.
        E: ``(4, 4)`` pose of the right camera in the left camera's frame, instead of a drawn one.
        posed: draw a general pose: rotation up to about 15 degrees, translation with y and z.
        K_left: ``(3, 3)`` pixels; None for the scene's own field of view.
        K_right: ``(3, 3)`` pixels; None for ``K_left`` at the right image's size.
        size_right: ``(H, W)`` of the right image; None for ``size``.
        effects: True draws noise, blur and the like for both cameras; or give them.

    Returns:
        The pair; things that the right camera would stand in are left out of the scene.

    Raises:
        ValueError: unknown kind, negative seed, ``baseline_m <= 0``, or an ``E`` that is not ``(4, 4)``.
    """
    if baseline_m is not None and not baseline_m > 0:
        bad_value("baseline_m", "a positive distance in metres", baseline_m)
    scene = sample_scene(seed, kind)
    rng = np.random.default_rng([int(seed), 21])
    if E is None:
        pose = _relative_pose(rng, baseline_m or scene.baseline_m, rotation_deg, posed)
    else:
        pose = np.asarray(E, dtype=np.float64)
        if pose.shape != (4, 4):
            bad_value("E", "a (4, 4) pose of the right camera in the left camera's frame", pose.shape)
    E_ = torch.from_numpy(pose)
    size_right = size_right or size
    left_K = intrinsics(size, scene.fov_deg) if K_left is None else torch.as_tensor(K_left).double()
    right_K = torch.as_tensor(K_right).double() if K_right is not None else (
        left_K.clone() if size_right == size else intrinsics(size_right, scene.fov_deg))
    world_from_right = scene.T_world_from_camera.double() @ E_
    scene = _clear_of(scene, world_from_right[:3, 3], scene.clearance_m * 0.6)
    first = render_linear([scene], [Camera(left_K, scene.T_world_from_camera)], [0], size, device)
    second = render_linear([scene], [Camera(right_K, world_from_right)], [0], size_right, device)
    pair_effects = _pair_effects(rng, effects, exposure)
    _, gain = expose(first.radiance)
    left_image, _ = expose(first.radiance, gain * pair_effects[0].gain)
    right_image, _ = expose(second.radiance, gain * pair_effects[1].gain)
    left = as_views(apply_effects(left_image[0], pair_effects[0])[None], first)[0]
    right = as_views(apply_effects(right_image[0], pair_effects[1])[None], second)[0]
    occluded, in_view = _hidden(scene, left, left_K, right_K, E_, size_right, device)
    return SyntheticPair(left, right, left_K, right_K, E_, occluded, in_view, scene.kind, int(seed))


def _pair_effects(rng, effects, exposure: bool) -> tuple[CameraEffects, CameraEffects]:
    drift = float(np.exp(rng.uniform(-0.18, 0.18)))
    if isinstance(effects, tuple):
        left, right = effects
    elif effects:
        left = sample_effects(rng)
        # The same camera model twice: its own noise, otherwise alike.
        right = replace(left, seed=left.seed + 1, blur_px=left.blur_px * float(rng.uniform(0.8, 1.2)))
    else:
        left = right = CameraEffects()
    return left, replace(right, gain=right.gain * drift) if exposure else right


_SIGHT_MARGIN_M = 1.5
_CHUNK = {"cpu": 2, "cuda": 32}


def render_mono(
    seeds: Sequence[int],
    size: tuple[int, int] = (192, 256),
    device: str | torch.device = "cpu",
    augment: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render one view of each seed's scene: a training batch.

    Args:
        seeds: ``N`` non-negative integers; each decides kind, scene, lens and camera effects.
        size: ``(H, W)``; any aspect ratio.
        device: where to render and where the result lives.
        augment: apply drawn camera effects (exposure, noise, blur, JPEG, grey and so on).

    Returns:
        images ``(N, 3, H, W)`` float32 in [0, 1] and depth ``(N, 1, H, W)`` metres, ``inf`` for the sky.

    Raises:
        ValueError: no seeds, or a negative one.
    """
    seeds = [int(s) for s in seeds]
    if not seeds:
        bad_value("seeds", "at least one integer", "none")
    chunk = _CHUNK.get(torch.device(device).type, 8)
    images, depths = [], []
    for start in range(0, len(seeds), chunk):
        part = seeds[start : start + chunk]
        scenes = [sample_scene(s) for s in part]
        rngs = [np.random.default_rng([s, 22]) for s in part]
        cameras = []
        for scene, rng in zip(scenes, rngs, strict=True):
            fov = float(np.clip(scene.fov_deg * np.exp(rng.normal(0, 0.12)), 30, 95))
            cameras.append(Camera(intrinsics(size, fov), scene.T_world_from_camera))
        scenes = [_in_sight(s, size, c.K, _SIGHT_MARGIN_M) for s, c in zip(scenes, cameras, strict=True)]
        linear = render_linear(scenes, cameras, list(range(len(part))), size, device)
        effects = [sample_effects(rng) if augment else CameraEffects() for rng in rngs]
        _, gain = expose(linear.radiance)
        gain = gain * torch.tensor([e.gain for e in effects], device=gain.device)
        image, _ = expose(linear.radiance, gain)
        images += [apply_effects(x, e) for x, e in zip(image, effects, strict=True)]
        depths.append(linear.depth_m)
    return torch.stack(images), torch.cat(depths)
