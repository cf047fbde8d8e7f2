"""Refine the poses of a capture with a moving camera, and estimate depth of some frames.

Takes a phone scan (transforms.json), a COLMAP model or any other layout supported by `geodiff capture`.
By default it renders a scene from a moving camera, with pose errors typical of a tracker, and prints the
error of the depth. Needs the extra `capture`. Runs offline:

    python -m examples.capture_folder [scan/ --frames 0::10]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin import Capture, enable_geometry_guidance, load_prior
from tests.scenes.sequences import render_sequence

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def rendered_scan(folder: Path, size: tuple[int, int], frames: int) -> dict[str, np.ndarray]:
    """Write a transforms.json with images; return ground-truth depth by frame."""
    sequence = render_sequence(3, frames, "room", size)
    rng = np.random.default_rng(0)
    said = []
    ground_truth = {}
    for i, (view, pose) in enumerate(zip(sequence.lefts, sequence.T_world_from_left, strict=True)):
        image = (view.image_01.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        Image.fromarray(image).save(folder / f"frame{i}.png")
        given = pose.numpy() @ OPENGL
        given[:3, 3] += rng.normal(0, 0.01, 3)  # tracker error in metres
        said.append({"file_path": f"frame{i}.png", "transform_matrix": given.tolist()})
        ground_truth[f"frame{i}"] = view.depth_m[0].numpy()
    K = sequence.K.numpy()
    camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    camera |= {"w": size[1], "h": size[0], "frames": said}
    (folder / "transforms.json").write_text(json.dumps(camera))
    return ground_truth


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scan", nargs="?", type=Path, help="a capture (default: a rendered scene)")
    parser.add_argument("--frames", default="2:2", help="NAME,NAME or FIRST:LAST:STEP")
    parser.add_argument("--size", type=int, nargs=2, default=(192, 256), metavar=("H", "W"), help="pixels")
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    options = parser.parse_args(argv)

    with tempfile.TemporaryDirectory() as temporary:
        ground_truth = {} if options.scan else rendered_scan(Path(temporary), tuple(options.size), 6)
        capture = Capture.open(options.scan or temporary)
        solved = capture.solve()
        print(
            f"poses {solved.status}: residual {solved.residual_px_given:.2f} -> {solved.residual_px:.2f} px"
        )
        pipe = enable_geometry_guidance(load_prior(options.prior))
        call = {} if options.steps is None else {"num_inference_steps": options.steps}
        for name in capture.choose(options.frames):
            out = capture.depth(pipe, name, **call)
            depth = out.prediction[0, ..., 0]
            line = (
                f"{name}: median {np.median(depth):.2f} m, neighbours {', '.join(capture.neighbours(name))}"
            )
            if name in ground_truth:
                known = np.isfinite(ground_truth[name]) & (ground_truth[name] > 0)
                line += f", AbsRel {np.mean(np.abs(depth / ground_truth[name] - 1)[known]):.3f}"
            print(line)


if __name__ == "__main__":
    main()
