"""Metric depth from a calibrated stereo pair: a diffusers script with two additional lines.

By default it runs offline on the bundled rendered pair with the bundled prior:

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
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    parser.add_argument(
        "--out", type=Path, default=Path("depth_from_stereo"), help="output path without suffix"
    )
    options = parser.parse_args(argv)

    # Apply the EXIF orientation, because K refers to the upright image.
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
    array, image = options.out.with_suffix(".npy"), options.out.with_suffix(".png")
    np.save(array, depth_m)
    depth_figure(depth_m).save(image)
    print(f"{depth_m.min():.2f} m to {depth_m.max():.2f} m, median {np.median(depth_m):.2f} m")
    print(f"{out.verdict.status}, mean confidence {out.confidence.mean():.2f} -> {array}, {image}")
    for finding in out.findings:
        print(f"{finding.severity.value}: {finding}")


if __name__ == "__main__":
    main()
