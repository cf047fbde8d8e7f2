"""Metric depth from two images without a known pose, which is estimated from matches.

Needs the extra ``pose``: ``pip install -c constraints.txt -e ".[pose]"``. Images alone have no metric
scale, so pass the distance between the cameras. K comes from the field of view or the EXIF data of the
images. By default the script runs offline on a rendered pair:

    python -m examples.unposed_images
    python -m examples.unposed_images left.jpg right.jpg --baseline 0.12 --fov 69
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from tests.scenes import render_pair


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "images",
        type=Path,
        nargs="*",
        metavar="LEFT RIGHT",
        help="two images (default: a rendered pair)",
    )
    parser.add_argument("--baseline", type=float, help="distance between the cameras in metres")
    parser.add_argument("--fov", type=float, help="horizontal field of view in degrees (default: from EXIF)")
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    parser.add_argument("--out", type=Path, default=Path("unposed_images.npy"), help="depth, metres")
    options = parser.parse_args(argv)
    if len(options.images) not in (0, 2):
        parser.error("expected two images, or none")

    camera = {"baseline_m": options.baseline, "fov": options.fov}
    if options.images:
        left, right = (ImageOps.exif_transpose(Image.open(path)) for path in options.images)
    else:
        pair = render_pair(3, posed=True)
        left, right = pair.left.image_01, pair.right.image_01
        camera = {"baseline_m": float(pair.E[:3, 3].norm()), "K": pair.K_left.numpy()}

    pipe = enable_geometry_guidance(load_prior(options.prior))
    guidance = GeometryGuidance.from_unposed_images(left, right, **camera)
    out = pipe(
        left,
        guidance=guidance,
        num_inference_steps=options.steps,
        generator=torch.Generator("cpu").manual_seed(0),
    )

    found = guidance.estimated
    print(f"{found.inliers[0]} inliers, parallax {found.parallax_deg[0]:.1f} degrees")
    depth_m = out.prediction[0, ..., 0]
    np.save(options.out, depth_m)
    print(f"{depth_m.min():.2f} to {depth_m.max():.2f} {out.unit or 'baselines'} -> {options.out}")
    print(f"{out.verdict.status}, mean confidence {out.confidence.mean():.2f}")
    for finding in out.findings:
        print(f"{finding.severity.value}: {finding}")


if __name__ == "__main__":
    main()
