"""Depth completion from one image and sparse depth (lidar, structure from motion).

POINTS is a ``.npy`` file: ``(N, 3)`` points in the camera's frame, or a sparse map ``(H, W)`` with 0 where
the depth is unknown, in metres. K is a text file of 3 x 3 numbers, in pixels. By default the script
runs offline and completes 500 depths of the bundled rendered pair:

    python -m examples.sparse_points
    python -m examples.sparse_points image.png points.npy K.txt
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled.demo_pair import read_demo_pair


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "files",
        type=Path,
        nargs="*",
        metavar="IMAGE POINTS K",
        help="image, points and K (default: rendered)",
    )
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    parser.add_argument("--out", type=Path, default=Path("sparse_points.npy"), help="depth, metres")
    options = parser.parse_args(argv)
    if len(options.files) not in (0, 3):
        parser.error("expected an image, its points and K, or no files")

    ground_truth_m = None
    if options.files:
        image = ImageOps.exif_transpose(Image.open(options.files[0]))
        points, K = np.load(options.files[1]), np.loadtxt(options.files[2])
    else:
        pair = read_demo_pair()
        image = pair.left
        K = pair.rig.K_left
        ground_truth_m = pair.depth_m
        chosen = np.random.default_rng(0).choice(np.flatnonzero(pair.valid), 500, replace=False)
        points = np.zeros_like(ground_truth_m)
        points.flat[chosen] = ground_truth_m.flat[chosen]

    pipe = enable_geometry_guidance(load_prior(options.prior))
    out = pipe(
        image,
        guidance=GeometryGuidance.from_points(points, K),
        num_inference_steps=options.steps,
        generator=torch.Generator("cpu").manual_seed(0),
    )

    depth_m = out.prediction[0, ..., 0]
    np.save(options.out, depth_m)
    print(f"{depth_m.min():.2f} m to {depth_m.max():.2f} m, median {np.median(depth_m):.2f} m")
    print(f"{out.verdict.status}, mean confidence {out.confidence.mean():.2f} -> {options.out}")
    if ground_truth_m is not None:
        withheld = pair.valid & (points == 0)
        error = np.abs(depth_m - ground_truth_m)[withheld] / ground_truth_m[withheld]
        print(f"mean relative error at pixels without a given depth: {error.mean():.3f}")
    for finding in out.findings:
        print(f"{finding.severity.value}: {finding}")


if __name__ == "__main__":
    main()
