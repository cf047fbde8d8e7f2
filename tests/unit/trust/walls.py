"""Guided calls on walls one above the other, each at its own distance."""

import cv2
import numpy as np

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.result.output import MetricDepthOutput
from tests.tiny import make_oracle

K = np.array([[120.0, 0, 63.5], [0, 120.0, 47.5], [0, 0, 1]])
BASELINE_M = 0.1


def pair_of_shifts(*shifts_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The left and the right image, and the pixels by which each row shifts, for walls of these shifts."""
    height = 96 // len(shifts_px)
    walls = np.random.default_rng(0).random((len(shifts_px), height, 168, 3), np.float32)
    scene = np.concatenate([cv2.GaussianBlur(wall, (0, 0), 1.0) for wall in walls])  # each of its own texture
    scene = (scene - scene.min()) / np.ptp(scene)
    shifts = np.repeat(shifts_px, height)
    right = np.stack([row[16 + px : 144 + px] for row, px in zip(scene, shifts, strict=True)])
    return scene[:, 16:144], right, shifts


def guided(
    left: np.ndarray, right: np.ndarray, order: np.ndarray, cameras=(K, K), **parameters
) -> MetricDepthOutput:
    """One guided call on a pair, by a prior that knows the ``order (H,)`` of the rows."""
    relative = (order - order.min()) / np.ptp(order)
    relative = np.repeat(relative[:, None], 128, 1).astype(np.float32)
    E = np.eye(4)
    E[0, 3] = BASELINE_M
    pipe = enable_geometry_guidance(make_oracle(relative, "disparity"))
    return pipe(left, guidance=GeometryGuidance(right, cameras, E, guidance_steps=0, **parameters))
