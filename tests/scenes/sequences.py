"""Stereo sequences: a rig moves through a static scene, with exact depth and poses.

Data flow: a seed -> ``SyntheticSequence``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value, check_number
from tests.scenes.builder import rotation
from tests.scenes.cameras import intrinsics
from tests.scenes.layouts import sample_scene
from tests.scenes.render import as_views, expose, render_linear
from tests.scenes.scene import Camera, RenderedView
from tests.scenes.visibility import clear_of, in_sight

__all__ = ["SyntheticSequence", "render_sequence"]

_SIGHT_MARGIN_M = 3.0
#: Where the rig goes, in the first left camera's frame; and its turn to the side, degrees a frame.
_WAY, _YAW_DEG = np.array([0.45, 0.0, 0.9]), 0.3


@dataclass(frozen=True)
class SyntheticSequence:
    """Frames of a rectified rig.

    Attributes:
        lefts: the reference views, one a frame.
        rights: the second views.
        K: ``(3, 3)`` float64, pixels of both.
        E: ``(4, 4)`` float64, metres; pose of the right camera in the left camera's frame.
        T_world_from_left: ``(4, 4)`` float64 each, metres.
        kind: kind of scene.
        seed: what it was drawn from.
    """

    lefts: tuple[RenderedView, ...]
    rights: tuple[RenderedView, ...]
    K: torch.Tensor
    E: torch.Tensor
    T_world_from_left: tuple[torch.Tensor, ...]
    kind: str
    seed: int


def render_sequence(
    seed: int,
    frames: int,
    kind: str | None = None,
    size: tuple[int, int] = (192, 256),
    step_m: float | None = None,
    device: str | torch.device = "cpu",
) -> SyntheticSequence:
    """Render a seeded scene from a rig that goes ahead and aside, and turns a little, at an even pace.

    Args:
        seed: of the scene, non-negative; the same arguments give the same frames.
        frames: at least 1.
        kind: one of ``KINDS``, or None to draw it.
        size: ``(H, W)`` pixels.
        step_m: metres from frame to frame; None for half of the baseline that suits the scene.
        device: where to render.

    Returns:
        The sequence, all frames in the exposure of the first; what any camera would stand in is left out of
        the scene.

    Raises:
        ValueError: no frames, unknown kind, negative seed, ``step_m`` below 0.
    """
    check_number(frames, "frames", 1, 1 << 16, integer=True)
    if step_m is not None and not step_m >= 0:
        bad_value("step_m", "a distance in metres", step_m)
    scene = sample_scene(seed, kind)
    step = 0.5 * scene.baseline_m if step_m is None else step_m
    E, K = torch.eye(4, dtype=torch.float64), intrinsics(size, scene.fov_deg)
    E[0, 3] = scene.baseline_m
    poses = [scene.T_world_from_camera.double() @ _moved(i, step) for i in range(frames)]
    cameras = [[Camera(K, pose), Camera(K, pose @ E)] for pose in poses]
    flat = [camera for pair in cameras for camera in pair]
    for camera in flat[1:]:  # of the first one the layout itself has kept clear
        scene = clear_of(scene, camera.T_world_from_camera[:3, 3], scene.clearance_m * 0.6)
    scene = in_sight(scene, [(camera, size) for camera in flat], _SIGHT_MARGIN_M)
    views, gain = [], None
    for camera in flat:  # one by one: a long sequence needs no more memory than a short one
        linear = render_linear([scene], [camera], [0], size, device, antialias=True)
        image, gain = expose(linear.radiance, gain)
        views += as_views(image, linear)
    return SyntheticSequence(tuple(views[::2]), tuple(views[1::2]), K, E, tuple(poses), scene.kind, int(seed))


def _moved(frame: int, step_m: float) -> torch.Tensor:
    """Pose of the left camera in that of the first frame."""
    pose = np.eye(4)
    pose[:3, 3] = frame * step_m * _WAY / np.linalg.norm(_WAY)
    pose[:3, :3] = rotation(np.radians(frame * _YAW_DEG), 0.0, 0.0)
    return torch.from_numpy(pose)
