"""Write two views per sample of any robustmvd test set in a layout that ``geodiff eval pairs`` reads.

    python -m examples.robustmvd.write_pairs kitti OUT
    geodiff eval pairs OUT --datasets mvsnet --methods guided,sweep-sgm

The first argument is a dataset of the benchmark (kitti, dtu, scannet, tanks_and_temples, eth3d), whose
path is set in its ``paths.toml``. Each sample becomes a folder with its key view, the nearest source view
in the list, their cameras and the ground truth. Poses and intrinsics are given, so depth is scored in
metres, without alignment. For tanks_and_temples and eth3d, whose cameras are COLMAP's, add ``--pixel-centre
0.5``.

Needs robustmvd, whose sample lists are pickles.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.formats import write_pfm

__all__ = ["write_pairs"]


def _camera_text(K: np.ndarray, world_to_camera: np.ndarray) -> str:
    blocks = ("\n".join(" ".join(f"{value:.9g}" for value in row) for row in m) for m in (world_to_camera, K))
    return "extrinsic\n{}\n\nintrinsic\n{}\n".format(*blocks)


def write_pairs(out: Path, samples: Iterable[Mapping[str, Any]], name: str) -> int:
    """Write samples in the benchmark's format; return their number.

    Args:
        out: folder of the pairs.
        samples: of every view ``images`` ``(3, H, W)`` in [0, 255], ``intrinsics`` and ``poses`` (world to
            camera); ``keyview_idx``; the key view's ``depth`` ``(1, H, W)`` in metres, 0 where unknown.
        name: prefix of the folders.
    """
    count = 0
    for count, sample in enumerate(samples, 1):
        folder = out / f"{name}-{count - 1:04d}"
        key = int(np.asarray(sample["keyview_idx"]))
        for part in ("images", "cams", "depths"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        sources = [i for i in range(len(sample["images"])) if i != key]
        for view, i in enumerate((key, min(sources, key=lambda i: abs(i - key)))):
            pixels = (
                np.clip(np.asarray(sample["images"][i]).transpose(1, 2, 0), 0, 255).round().astype(np.uint8)
            )
            Image.fromarray(pixels).save(folder / "images" / f"{view:08d}.png")
            text = _camera_text(np.asarray(sample["intrinsics"][i]), np.asarray(sample["poses"][i]))
            (folder / "cams" / f"{view:08d}_cam.txt").write_text(text)
        write_pfm(folder / "depths" / "00000000.pfm", np.asarray(sample["depth"], np.float32)[0])
        (folder / "pair.txt").write_text("2\n0\n1 1 1.0\n1\n1 0 1.0\n")
    return count


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", help="kitti, dtu, scannet, tanks_and_temples or eth3d")
    parser.add_argument("out", type=Path)
    options = parser.parse_args(argv)
    import rmvd  # the benchmark, a separate installation

    samples = rmvd.create_dataset(options.dataset, "mvd")
    print(write_pairs(options.out, (samples[i] for i in range(len(samples))), options.dataset), "pairs")


if __name__ == "__main__":
    main()
