"""Valid pixels of the frames of a capture: masks, alpha channels, lenses and static overlays."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.evidence.valid import (
    both,
    neutral_views,
    outside_borders,
    read_mask,
    undistorted_mask,
    without_overlays,
)
from geodiff_plugin.formats import CaptureFrame, read_alpha, undistorted


class MaskedImage(NamedTuple):
    """An image ``(H, W, 3)`` in [0, 1] without distortion, and its valid pixels ``(H, W)`` bool."""

    image: np.ndarray
    valid: np.ndarray | None  # None for all


def valid_in_files(frame: CaptureFrame) -> Tensor | None:
    """Return the pixels ``(H, W)`` bool of a distorted frame that are opaque and white in its mask."""
    mask, alpha = None, None
    if frame.mask is not None:
        mask = read_mask(frame.mask, f"the mask of {frame.name}", frame.size[::-1], scaled=True)
    if frame.index is None:
        alpha = read_alpha(frame.image, f"frame {frame.name}", as_stored=frame.as_stored)
    return both(mask, None if alpha is None else torch.from_numpy(alpha))


def masked_image(frame: CaptureFrame, stored: np.ndarray, overlays: np.ndarray | None) -> MaskedImage:
    """Undistort a frame's image ``(H, W, 3)``; ``overlays (h, w)`` bool are static pixels of any size.

    A frame with a mask may show overlays; its mask states what is valid.
    """
    valid = valid_in_files(frame)
    overlays = overlays if frame.mask is None else None
    if frame.camera.lens is not None or overlays is not None:
        (valid,) = outside_borders([torch.from_numpy(stored).permute(2, 0, 1)], [valid])
    size = stored.shape[0], stored.shape[1]
    valid = undistorted_mask(valid, frame.camera, size)
    image = undistorted(stored, frame.camera)
    if overlays is not None:
        valid = without_overlays(valid, overlays, size)
    return MaskedImage(image, None if valid is None else valid.numpy())


def masked_grey(masked: MaskedImage) -> np.ndarray:
    """Convert an image for ``solve_capture`` to grey uint8, a masked array if some pixels are not valid."""
    given = None if masked.valid is None else torch.from_numpy(masked.valid)
    ((planes, valid),) = neutral_views([torch.from_numpy(masked.image).permute(2, 0, 1)], [given])
    pixels = np.ascontiguousarray(planes.permute(1, 2, 0).numpy())
    grey = np.rint(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) * 255).astype(np.uint8)
    return grey if valid is None else np.ma.MaskedArray(grey, ~valid.numpy())
