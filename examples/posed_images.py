"""Metric depth from two images in general pose, without rectification.

Renders a scene from two camera-to-world poses in metres, and prints the error against ground truth. (COLMAP
writes world-to-camera poses without a unit; docs/reference/calibration.md shows how to convert them.) Runs
offline:

    python -m examples.posed_images --seed 8 --angle 8
"""

from __future__ import annotations

import argparse

import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from tests.scenes import render_pair


def world_poses(E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return camera-to-world poses of both cameras in a world frame that differs from both cameras."""
    angle = np.radians(30.0)
    T_world_from_left = np.eye(4)
    T_world_from_left[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    T_world_from_left[:3, 3] = 1.0, -2.0, 0.5
    return T_world_from_left, T_world_from_left @ E


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=8, help="seed of the scene")
    parser.add_argument("--angle", type=float, default=8.0, help="rotation of the right camera in degrees")
    parser.add_argument("--size", type=int, nargs=2, default=(192, 256), metavar=("H", "W"), help="pixels")
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    options = parser.parse_args(argv)

    pair = render_pair(options.seed, "room", tuple(options.size), rotation_deg=options.angle)
    E_left, E_right = world_poses(pair.E.numpy())
    K_left, K_right = pair.K_left.numpy(), pair.K_right.numpy()

    pipe = enable_geometry_guidance(load_prior(options.prior))
    guidance = GeometryGuidance(pair.right.image_01, (K_left, K_right), (E_left, E_right))
    out = pipe(
        pair.left.image_01,
        guidance=guidance,
        num_inference_steps=options.steps,
        generator=torch.Generator("cpu").manual_seed(0),
    )

    depth_m = out.prediction[0, ..., 0]
    ground_truth_m = pair.left.depth_m[0].numpy()
    known = pair.left.valid[0].numpy()
    error = np.abs(depth_m - ground_truth_m)[known] / ground_truth_m[known]
    print(
        f"ground truth {np.median(ground_truth_m[known]):.2f} m, guided {np.median(depth_m):.2f} m (medians)"
    )
    print(f"mean relative error {error.mean():.3f}; {out.visible.mean():.0%} visible in both views")
    print(f"{out.verdict.status}, mean confidence {out.confidence.mean():.2f}")


if __name__ == "__main__":
    main()
