"""Rendering of the demo pair: ``python -m tests.scenes.make_pair [--out DIR]``.

Data flow: a seed -> two images, Middlebury calibration, depth in millimetres.
Paper: none; it stands in for the images of S5, which may not be shipped.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.formats import write_depth_mm
from tests.scenes import SyntheticPair, render_pair

__all__ = ["make_pair"]

#: A scene that the bundled prior has not seen: its training starts at seed one million.
KIND, SEED = "room", 10
HEIGHT, WIDTH, FOCAL_PX, BASELINE_M = 336, 448, 420.0, 0.12
#: Odd, so that the middle ray of every pixel is the pixel's own and gives its exact depth.
RAYS_PER_SIDE = 3


def _intrinsics(rays_per_side: int) -> np.ndarray:
    """K of the image with so many rays a pixel's side; integer coordinate = pixel centre."""
    cx, cy = ((side - 1) / 2 for side in (rays_per_side * WIDTH, rays_per_side * HEIGHT))
    return np.array([[rays_per_side * FOCAL_PX, 0, cx], [0, rays_per_side * FOCAL_PX, cy], [0, 0, 1]])


def _render() -> SyntheticPair:
    size = (RAYS_PER_SIDE * HEIGHT, RAYS_PER_SIDE * WIDTH)
    return render_pair(SEED, KIND, size, BASELINE_M, exposure=False, K_left=_intrinsics(RAYS_PER_SIDE))


def _write_image(path: Path, rays: torch.Tensor) -> None:
    """``(3, k H, k W)`` in [0, 1] -> PNG of H x W, the mean of every k x k rays."""
    pixels = torch.nn.functional.avg_pool2d(rays, RAYS_PER_SIDE)
    values = (pixels.permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(values).save(path, optimize=True)


def make_pair(folder: Path) -> None:
    """Write ``left.png``, ``right.png``, ``calib.txt`` and ``depth_mm.png``.

    Args:
        folder: made if it is not there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pair = _render()
    _write_image(folder / "left.png", pair.left.image_01)
    _write_image(folder / "right.png", pair.right.image_01)
    middle = slice(RAYS_PER_SIDE // 2, None, RAYS_PER_SIDE)
    write_depth_mm(folder / "depth_mm.png", pair.left.depth_m[0, middle, middle].numpy())
    K = _intrinsics(1)
    camera = f"[{K[0, 0]:g} 0 {K[0, 2]:g}; 0 {K[1, 1]:g} {K[1, 2]:g}; 0 0 1]"
    lines = (
        f"cam0={camera}",
        f"cam1={camera}",
        "doffs=0",
        f"baseline={1000 * BASELINE_M:g}",
        f"width={WIDTH}",
        f"height={HEIGHT}",
        "ndisp=64",
    )
    (folder / "calib.txt").write_text("\n".join(lines) + "\n", encoding="ascii")


def main(argv: list[str] | None = None) -> None:
    """Parse the arguments and render."""
    parser = argparse.ArgumentParser(description="Render the stereo pair of `geodiff demo`.")
    parser.add_argument("--out", type=Path, default=DEMO_PAIR_FOLDER, help="folder (default: the package's)")
    make_pair(parser.parse_args(argv).out)


if __name__ == "__main__":
    main()
