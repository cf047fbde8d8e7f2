"""Views of tests, from arrays or tensors of any kind."""

from typing import Any

import numpy as np
import torch

from geodiff_plugin.cameras import Camera, Distortion, PosedCamera, PosedViews, Size, View
from geodiff_plugin.pose.tracks import GreyImage
from geodiff_plugin.types import DepthFrame, Rig


def view_of(image_01: torch.Tensor, K: Any, T_right_from_left: Any = None) -> View:
    """The view of an image ``(C, H, W)``, in float32; without a pose a left one."""
    T = np.eye(4) if T_right_from_left is None else np.asarray(T_right_from_left)
    return View.single(image_01, Camera(np.asarray(K, np.float64)), T)


def posed_of(left_01: torch.Tensor, K_left: Any, *rights: tuple[torch.Tensor, Any, Any]) -> PosedViews:
    """A left image and right ones, each with its K and its ``T_right_from_left``."""
    return PosedViews(view_of(left_01, K_left), tuple(view_of(*right) for right in rights))


def grey_of(grey: np.ndarray, K: np.ndarray) -> GreyImage:
    """A grey image ``(H, W)`` uint8 with its camera."""
    return GreyImage(grey, Camera(K, (grey.shape[1], grey.shape[0])))


def posed_frame(
    name: str, depth: np.ndarray, confidence: np.ndarray, K: np.ndarray, E: np.ndarray, *counts: np.ndarray
) -> DepthFrame:
    """A frame of a capture, from a depth map ``(H, W)`` and its K and E."""
    return DepthFrame(name, depth, confidence, PosedCamera(K, depth.shape[::-1], E=E), *counts)


def made_rig(
    K_left: np.ndarray,
    K_right: np.ndarray,
    E: np.ndarray,
    sizes: tuple[Size | None, Size | None] = (None, None),
    lenses: tuple[Distortion | None, Distortion | None] = (None, None),
    **more: Any,
) -> Rig:
    """The rig of two matrices K, and of sizes and lenses of the left and the right camera."""
    left, right = (Camera(*each) for each in zip((K_left, K_right), sizes, lenses, strict=True))
    return Rig(left, right, E, **more)


def lenses_of(rig: Rig) -> tuple[Distortion | None, Distortion | None]:
    """Those of its left and right camera."""
    return rig.left.lens, rig.right.lens
