"""Batches of single views with depth, for training a monocular prior.

Data flow: seeds -> images ``(N, 3, H, W)`` and depths ``(N, 1, H, W)``.
Paper: S5.1 (the prior's training data).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from geodiff_plugin._checks import bad_value
from tests.scenes.cameras import intrinsics
from tests.scenes.effects import CameraEffects, apply_effects, sample_effects
from tests.scenes.layouts import sample_scene
from tests.scenes.photographs import cover_with_photographs
from tests.scenes.render import expose, render_linear, soften
from tests.scenes.scene import Camera, Scene
from tests.scenes.visibility import in_sight

__all__ = ["render_mono"]

_SIGHT_MARGIN_M = 1.5


def _chunk(size: tuple[int, int], device: torch.device) -> int:
    """Scenes to render at once: a GPU wants many, a CPU's cache wants few."""
    if device.type == "cpu":
        return 2 if size[0] * size[1] < 20_000 else 1
    return max(1, (1 << 21) // (size[0] * size[1]))


def _draw(
    seed: int, kind: str | None, size: tuple[int, int], photographs: float
) -> tuple[Scene, Camera, np.random.Generator]:
    """A scene without what is out of sight, a camera with a drawn lens, the rest of the randomness."""
    scene, rng = sample_scene(seed, kind), np.random.default_rng([seed, 22])
    fov = float(np.clip(scene.fov_deg * np.exp(rng.normal(0, 0.12)), 30, 95))
    camera = Camera(intrinsics(size, fov), scene.T_world_from_camera)
    scene = in_sight(scene, [(camera, size)], _SIGHT_MARGIN_M)
    if photographs > 0 and rng.random() < 0.5:
        scene = cover_with_photographs(scene, rng, photographs)
    return scene, camera, rng


def render_mono(
    seeds: Sequence[int],
    size: tuple[int, int] = (192, 256),
    device: str | torch.device = "cpu",
    augment: bool = True,
    kind: str | None = None,
    photographs: float = 0.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Render one view of each seed's scene: a training batch.

    Args:
        seeds: ``N`` non-negative integers; each decides kind, scene, lens and camera effects.
        size: ``(H, W)``; any aspect ratio.
        device: where to render and where the result lives.
        augment: apply drawn camera effects (exposure, noise, blur, JPEG, grey and so on).
        kind: one of ``KINDS`` for all; None draws one for each seed.
        photographs: share of the surfaces that show a photograph, in half of the scenes; needs scikit-image.

    Returns:
        images ``(N, 3, H, W)`` float32 in [0, 1] and depth ``(N, 1, H, W)`` metres, ``inf`` for the sky.

    Raises:
        ValueError: no seeds, a negative one, or an unknown kind.
        ImportError: photographs without scikit-image.
    """
    seeds = [int(s) for s in seeds]
    if not seeds:
        bad_value("seeds", "at least one integer", "none")
    chunk = _chunk(size, torch.device(device))
    images, depths = [], []
    for start in range(0, len(seeds), chunk):
        part = seeds[start : start + chunk]
        scenes, cameras, rngs = zip(*(_draw(s, kind, size, photographs) for s in part), strict=True)
        linear = render_linear(scenes, cameras, range(len(part)), size, device, photographs > 0)
        effects = [sample_effects(rng, size) if augment else CameraEffects() for rng in rngs]
        _, gain = expose(linear.radiance)
        image, _ = expose(linear.radiance, gain * torch.tensor([e.gain for e in effects], device=gain.device))
        image = soften(image, linear.edges)
        images += [apply_effects(x, e) for x, e in zip(image, effects, strict=True)]
        depths.append(linear.depth_m)
    return torch.stack(images), torch.cat(depths)
