"""Captures of rendered scenes with the poses of a drifting tracker, where ground truth is exact.

python -m tests.benchmarks.capture --scenes 4 --frames 24 --out captures --rows given,capture
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin.evaluation.options import COMMANDS, CaptureEvalOptions
from tests.scenes.sequences import render_sequence
from tests.unit.capture_room import FLIP, perturbed

#: What a hand-held tracker is off by, as facts on two of them say: metres and degrees.
SHIFT_M, TURN_DEG = 0.03, 2.0


def write_capture(folder: Path, seed: int, frames: int, size: tuple[int, int]) -> Path:
    """A transforms.json with images and depth maps of a rendered walk, and inexact poses.

    Args:
        folder: to appear.
        seed: of the scene and of the tracker's errors.
        frames: how many.
        size: ``(H, W)`` pixels.
    """
    sequence = render_sequence(seed, frames, size=size)
    E = np.stack([pose.numpy() for pose in sequence.T_world_from_left])
    scale = np.linalg.norm(E[-1, :3, 3] - E[0, :3, 3])
    given = perturbed(E, shift=min(SHIFT_M, 0.02 * scale), turn_deg=TURN_DEG, seed=seed)
    said = []
    for kind in ("images", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for i, (view, pose) in enumerate(zip(sequence.lefts, given, strict=True)):
        name = f"f{i:03d}.png"
        image = (view.image_01.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        Image.fromarray(image).save(folder / "images" / name)
        depth = np.where(view.valid[0].numpy(), view.depth_m[0].numpy() * 1000, 0)
        Image.fromarray(np.rint(depth.clip(0, 65534)).astype(np.uint16)).save(folder / "depth" / name)
        files = {"file_path": f"images/{name}", "depth_file_path": f"depth/{name}"}
        said.append(files | {"transform_matrix": (pose @ FLIP).tolist()})
    K = sequence.K.numpy()
    camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    text = json.dumps(camera | {"w": size[1], "h": size[0], "frames": said})
    (folder / "transforms.json").write_text(text)
    return folder


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--frames", type=int, default=24, help="number of frames per scene")
    parser.add_argument("--count", type=int, default=4, help="number of measured frames per scene")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(288, 384), metavar=("H", "W"), help="size in pixels"
    )
    parser.add_argument("--neighbours", default="5")
    parser.add_argument("--rows", default="given,pairs,capture")
    parser.add_argument("--out", type=Path, default=Path("geodiff-captures"))
    given = parser.parse_args(argv)
    data = []
    for seed in range(given.scenes):
        folder = given.out / f"scene-{seed}"
        ready = (folder / "transforms.json").is_file()
        data.append(folder if ready else write_capture(folder, seed, given.frames, tuple(given.size)))
    options = CaptureEvalOptions(
        data=tuple(data),
        count=given.count,
        neighbours=tuple(int(n) for n in given.neighbours.split(",")),
        rows=tuple(given.rows.split(",")),
        out=given.out,
    )
    print(COMMANDS["capture"].run(options).markdown())


if __name__ == "__main__":
    main()
