"""Convert a stereo video to a metric depth video, frame by frame.

LEFT and RIGHT are two videos of the same length. By default the script runs offline on a rendered rig that
moves through a scene:

    python -m examples.rig_video
    python -m examples.rig_video left.mp4 right.mp4 calib.txt --frames 50 --out depth.mp4

``geodiff depth left.mp4 right.mp4`` does the same, processes several frames concurrently and resumes
interrupted runs; ``--temporal-smoothing`` reduces flicker (docs/how-to/sequences.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, Rig, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.cameras import Camera
from geodiff_plugin.formats import VideoReader, video_facts
from geodiff_plugin.plotting import depth_frames, write_depth_video
from tests.scenes.sequences import render_sequence


def read_frames(left: Path, right: Path, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the first frames of both videos, ``(H, W, 3)`` in [0, 1] each, up to ``count``."""
    count = min(count, video_facts(left).frames, video_facts(right).frames)
    with VideoReader(left) as lefts, VideoReader(right) as rights:
        for i in range(count):
            yield lefts.read(i), rights.read(i)


def rendered_rig(count: int) -> tuple[list[tuple[Any, Any]], Rig]:
    """Render frames of a rig that moves through a room; return them and its calibration."""
    sequence = render_sequence(3, count, "room", (144, 192))
    frames = zip(sequence.lefts, sequence.rights, strict=True)
    camera = Camera(sequence.K.numpy())
    pairs = [(left.image_01, right.image_01) for left, right in frames]
    return pairs, Rig(camera, camera, sequence.E.numpy())


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "files",
        type=Path,
        nargs="*",
        metavar="LEFT RIGHT CALIB",
        help="two videos and a calibration (default: rendered)",
    )
    parser.add_argument("--frames", type=int, default=4, help="maximum number of frames, from the first")
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    parser.add_argument("--out", type=Path, default=Path("rig_video.webp"), help=".webp, .gif or .mp4")
    options = parser.parse_args(argv)
    if len(options.files) not in (0, 3):
        parser.error("expected two videos and a calibration, or no files")

    if options.files:
        *videos, calib = options.files
        frames = read_frames(*videos, options.frames)
        rig = read_calibration(calib)
    else:
        frames, rig = rendered_rig(options.frames)

    pipe = enable_geometry_guidance(load_prior(options.prior))
    depths_m = []
    for left, right in frames:
        # The same noise for every frame reduces flicker.
        out = pipe(
            left,
            guidance=GeometryGuidance(right, (rig.K_left, rig.K_right), rig.E, left_size=rig.size_left),
            num_inference_steps=options.steps,
            generator=torch.Generator("cpu").manual_seed(0),
        )
        depths_m.append(out.prediction[0, ..., 0])
        print(f"frame {len(depths_m)}: median {np.median(depths_m[-1]):.2f} m")
        for finding in out.findings:
            print(f"{finding.severity.value}: {finding}")
    write_depth_video(options.out, depth_frames(depths_m), fps=10)
    print(options.out)


if __name__ == "__main__":
    main()
