"""Batches of single views with depth, for training a monocular prior.

Hop: seeds -> images ``(N, 3, H, W)`` and depths ``(N, 1, H, W)``.
Paper: S5.1 (the prior's training data).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.synthetic.cameras import intrinsics
from geodiff_plugin.synthetic.effects import CameraEffects, apply_effects, sample_effects
from geodiff_plugin.synthetic.layouts import sample_scene
from geodiff_plugin.synthetic.render import expose, render_linear, soften
from geodiff_plugin.synthetic.scene import Camera
from geodiff_plugin.synthetic.visibility import in_sight

__all__ = ["render_mono"]

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
        scenes = [in_sight(s, size, c.K, _SIGHT_MARGIN_M) for s, c in zip(scenes, cameras, strict=True)]
        linear = render_linear(scenes, cameras, list(range(len(part))), size, device)
        effects = [sample_effects(rng, size) if augment else CameraEffects() for rng in rngs]
        _, gain = expose(linear.radiance)
        gain = gain * torch.tensor([e.gain for e in effects], device=gain.device)
        image, _ = expose(linear.radiance, gain)
        image = soften(image, linear.edges)
        images += [apply_effects(x, e) for x, e in zip(image, effects, strict=True)]
        depths.append(linear.depth_m)
    return torch.stack(images), torch.cat(depths)
