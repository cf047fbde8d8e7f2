"""Two photographs of one scene, without a pose: it is estimated from their matches.

Needs the extra ``pose``: ``pip install -c constraints.txt -e ".[pose]"``. Photographs alone do not show the
scale, so give the distance between the two cameras. K comes from the field of view, or else from the EXIF
data of the photographs. Without arguments the script runs offline, on a rendered pair:

    python -m examples.photographs_without_pose
    python -m examples.photographs_without_pose left.jpg right.jpg --baseline 0.12 --fov 69
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
        "photographs", type=Path, nargs="*", metavar="LEFT RIGHT", help="a rendered pair by default"
    )
    parser.add_argument("--baseline", type=float, help="distance between the cameras, metres")
    parser.add_argument("--fov", type=float, help="horizontal field of view, degrees; EXIF by default")
    parser.add_argument("--prior", default="bundled", help="'bundled', a hub id or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps; the prior's own by default")
    parser.add_argument(
        "--out", type=Path, default=Path("photographs_without_pose.npy"), help="depth, metres"
    )
    options = parser.parse_args(argv)
    if len(options.photographs) not in (0, 2):
        parser.error("give two photographs, or none")

    camera = {"baseline_m": options.baseline, "fov": options.fov}
    if options.photographs:
        left, right = (ImageOps.exif_transpose(Image.open(path)) for path in options.photographs)
    else:
        pair = render_pair(3, posed=True)
        left, right = pair.left.image_01, pair.right.image_01
        camera = {"baseline_m": float(pair.E[:3, 3].norm()), "K": pair.K_left.numpy()}

    pipe = enable_geometry_guidance(load_prior(options.prior))
    guidance = GeometryGuidance.from_photographs(left, right, **camera)
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
    for sentence in out.warnings:
        print(f"warning: {sentence}")


if __name__ == "__main__":
    main()
