"""Batches of single views with depth, for training a monocular prior.

Data flow: seeds -> images ``(N, 3, H, W)`` and depths ``(N, 1, H, W)``.
Paper: S5.1 (the prior's training data).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value
from tests.scenes.cameras import intrinsics
from tests.scenes.effects import CameraEffects, apply_effects, sample_effects
from tests.scenes.layouts import sample_scene
from tests.scenes.photos import cover_with_photos
from tests.scenes.render import expose, render_linear, soften
from tests.scenes.scene import Camera, Scene
from tests.scenes.visibility import in_sight

__all__ = ["render_mono"]

_SIGHT_MARGIN_M = 1.5


def _chunk(size: tuple[int, int], device: torch.device) -> int:
    """Return the number of scenes to render at once: many on a GPU, few for the cache of a CPU."""
    if device.type == "cpu":
        return 2 if size[0] * size[1] < 20_000 else 1
    return max(1, (1 << 21) // (size[0] * size[1]))


def _draw(
    seed: int, kind: str | None, size: tuple[int, int], photos: float
) -> tuple[Scene, Camera, np.random.Generator]:
    """Sample a scene without invisible parts, a camera with a random lens, and a random generator."""
    scene, rng = sample_scene(seed, kind), np.random.default_rng([seed, 22])
    fov = float(np.clip(scene.fov_deg * np.exp(rng.normal(0, 0.12)), 30, 95))
    camera = Camera(intrinsics(size, fov), scene.T_world_from_camera)
    scene = in_sight(scene, [(camera, size)], _SIGHT_MARGIN_M)
    if photos > 0 and rng.random() < 0.5:
        scene = cover_with_photos(scene, rng, photos)
    return scene, camera, rng


def render_mono(
    seeds: Sequence[int],
    size: tuple[int, int] = (192, 256),
    device: str | torch.device = "cpu",
    augment: bool = True,
    kind: str | None = None,
    photos: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render a training batch: one view of each seed's scene.

    Args:
        seeds: ``N`` non-negative integers; each determines kind, scene, lens and camera effects.
        size: ``(H, W)``; any aspect ratio.
        device: device of the rendering and of the result.
        augment: apply random camera effects (exposure, noise, blur, JPEG, grey and so on).
        kind: one of ``KINDS`` for all seeds; ``None`` samples one per seed.
        photos: fraction of the surfaces that show a photo, in half of the scenes; needs scikit-image.

    Returns:
        images ``(N, 3, H, W)`` float32 in [0, 1] and depth ``(N, 1, H, W)`` metres, ``inf`` for the sky.

    Raises:
        ValueError: no seeds, a negative seed, or an unknown kind.
        ImportError: ``photos`` above 0 without scikit-image.
    """
    seeds = [int(s) for s in seeds]
    if not seeds:
        bad_value("seeds", "at least one integer", "none")
    chunk = _chunk(size, torch.device(device))
    images, depths = [], []
    for start in range(0, len(seeds), chunk):
        part = seeds[start : start + chunk]
        scenes, cameras, rngs = zip(*(_draw(s, kind, size, photos) for s in part), strict=True)
        linear = render_linear(scenes, cameras, range(len(part)), size, device, photos > 0)
        effects = [sample_effects(rng, size) if augment else CameraEffects() for rng in rngs]
        _, gain = expose(linear.radiance)
        image, _ = expose(linear.radiance, gain * torch.tensor([e.gain for e in effects], device=gain.device))
        image = soften(image, linear.edges)
        images += [apply_effects(x, e) for x, e in zip(image, effects, strict=True)]
        depths.append(linear.depth_m)
    return torch.stack(images), torch.cat(depths)
