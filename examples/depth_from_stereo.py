"""Metric depth from a calibrated stereo pair: a plain diffusers script with two additional lines.

Without arguments it runs offline, on the rendered pair and the small prior of the package:

    python -m examples.depth_from_stereo
    python -m examples.depth_from_stereo left.png right.png calib.txt --prior prs-eth/marigold-depth-v1-1
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.plotting import depth_figure


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("left", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "left.png")
    parser.add_argument("right", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "right.png")
    parser.add_argument("calib", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "calib.txt")
    parser.add_argument("--prior", default="bundled", help="'bundled', a hub id or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps; the prior's own by default")
    parser.add_argument("--out", type=Path, default=Path("depth_from_stereo"), help="path without suffix")
    options = parser.parse_args(argv)

    # A photograph may carry its turn as a note; K belongs to the turned image.
    left, right = (ImageOps.exif_transpose(Image.open(path)) for path in (options.left, options.right))

    pipe = load_prior(options.prior)
    enable_geometry_guidance(pipe)  # first additional line
    guidance = GeometryGuidance.from_calibration(right, options.calib)  # second

    out = pipe(
        left,
        guidance=guidance,
        num_inference_steps=options.steps,
        generator=torch.Generator("cpu").manual_seed(0),
    )

    depth_m = out.prediction[0, ..., 0]
    array, picture = options.out.with_suffix(".npy"), options.out.with_suffix(".png")
    np.save(array, depth_m)
    depth_figure(depth_m).save(picture)
    print(f"{depth_m.min():.2f} m to {depth_m.max():.2f} m, median {np.median(depth_m):.2f} m")
    print(f"{out.verdict.status}, mean confidence {out.confidence.mean():.2f} -> {array}, {picture}")
    for sentence in out.warnings:
        print(f"warning: {sentence}")


if __name__ == "__main__":
    main()
