"""Rendering of the page's examples: ``python -m tests.scenes.make_examples``."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image

from geodiff_plugin.app.job import PAIRS_FOLDER as FOLDER
from tests.scenes import render_pair

__all__ = ["render_examples"]

HEIGHT, WIDTH, RAYS_PER_SIDE = 336, 448, 3
#: Kind of scene, seed (training starts at one million) and baseline in metres, by name.
SCENES = {"street": ("street", 5, 0.5)}


def render_examples(folder: Path = FOLDER) -> None:
    """Write every pair of ``SCENES`` as ``left.jpg``, ``right.jpg``, ``calib.txt`` (Middlebury's format)."""
    for name, (kind, seed, baseline_m) in SCENES.items():
        size = (RAYS_PER_SIDE * HEIGHT, RAYS_PER_SIDE * WIDTH)
        pair = render_pair(seed, kind, size, baseline_m, exposure=False)
        target = folder / name
        target.mkdir(parents=True, exist_ok=True)
        for side, view in (("left", pair.left), ("right", pair.right)):
            pixels = torch.nn.functional.avg_pool2d(view.image_01, RAYS_PER_SIDE)
            values = (pixels.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
            Image.fromarray(values).save(target / f"{side}.jpg", quality=90, subsampling=0, optimize=True)
        K = pair.K_left.numpy()
        f, cx, cy = (K[0, 0] / RAYS_PER_SIDE, *((K[:2, 2] + 0.5) / RAYS_PER_SIDE - 0.5))
        camera = f"[{f:.6g} 0 {cx:.6g}; 0 {f:.6g} {cy:.6g}; 0 0 1]"
        lines = (f"cam0={camera}", f"cam1={camera}", "doffs=0", f"baseline={1000 * baseline_m:g}")
        text = "\n".join((*lines, f"width={WIDTH}", f"height={HEIGHT}", "ndisp=64")) + "\n"
        (target / "calib.txt").write_text(text, encoding="ascii")


if __name__ == "__main__":
    render_examples()
