"""Stereo pairs with exact depth, rectified or in any relative pose.

Data flow: a seed -> ``SyntheticPair``.
Paper: S3.3 (two posed views); S5.2 (mirrors and glass).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from geodiff_plugin import cameras
from geodiff_plugin._internal.checks import bad_value
from tests.scenes.builder import rotation
from tests.scenes.cameras import intrinsics
from tests.scenes.effects import CameraEffects, apply_effects, sample_effects
from tests.scenes.layouts import sample_scene
from tests.scenes.render import as_views, expose, render_linear
from tests.scenes.scene import Camera, RenderedView
from tests.scenes.visibility import clear_of, hidden_from_right, in_sight

__all__ = ["SyntheticPair", "render_pair"]

_SIGHT_MARGIN_M = 3.0


@dataclass(frozen=True)
class SyntheticPair:
    """Two views of a scene.

    Attributes:
        left: the reference view.
        right: the second view.
        K_left: ``(3, 3)`` float64, pixels of the left image.
        K_right: ``(3, 3)`` float64, pixels of the right image.
        E: ``(4, 4)`` float64, metres; pose of the right camera in the left camera's frame.
        occluded: ``(1, H, W)`` bool, left pixels whose point something hides from the right camera.
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
        pose[:3, :3] = pose[:3, :3] @ (
            np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
        )
    return pose


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
        K_right: ``(3, 3)`` pixels; None for ``K_left`` at the right image's size, or without one for the
            scene's own field of view.
        size_right: ``(H, W)`` of the right image; None for ``size``.
        effects: True draws noise, blur and the like for both cameras; or give them.

    Returns:
        The pair; objects that contain the right camera are removed from the scene.

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
    if K_right is not None:
        right_K = torch.as_tensor(K_right).double()
    elif K_left is not None:
        left = cameras.Camera(left_K.numpy(), size[::-1])
        right_K = torch.from_numpy(left.resized(size_right[::-1]).K)
    else:
        right_K = intrinsics(size_right, scene.fov_deg)
    world_from_right = scene.T_world_from_camera.double() @ E_
    scene = clear_of(scene, world_from_right[:3, 3], scene.clearance_m * 0.6)
    views = (Camera(left_K, scene.T_world_from_camera), size), (Camera(right_K, world_from_right), size_right)
    scene = in_sight(scene, views, _SIGHT_MARGIN_M)
    first, second = (render_linear([scene], [c], [0], s, device, antialias=True) for c, s in views)
    pair_effects = _pair_effects(rng, effects, exposure, size)
    _, gain = expose(first.radiance)
    left_image, _ = expose(first.radiance, gain * pair_effects[0].gain)
    right_image, _ = expose(second.radiance, gain * pair_effects[1].gain)
    left = as_views(apply_effects(left_image[0], pair_effects[0])[None], first)[0]
    right = as_views(apply_effects(right_image[0], pair_effects[1])[None], second)[0]
    occluded, in_view = hidden_from_right(scene, left, left_K, right_K, E_, size_right, device)
    return SyntheticPair(left, right, left_K, right_K, E_, occluded, in_view, scene.kind, int(seed))


def _pair_effects(rng, effects, exposure: bool, size) -> tuple[CameraEffects, CameraEffects]:
    drift = float(np.exp(rng.uniform(-0.18, 0.18)))
    if isinstance(effects, tuple):
        left, right = effects
    elif effects:
        left = sample_effects(rng, size)
        # The same camera model twice: its own noise, otherwise alike.
        right = replace(left, seed=left.seed + 1, blur_px=left.blur_px * float(rng.uniform(0.8, 1.2)))
    else:
        left = right = CameraEffects()
    return left, replace(right, gain=right.gain * drift) if exposure else right
