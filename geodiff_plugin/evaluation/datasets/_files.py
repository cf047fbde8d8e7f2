"""What several data sets need around the readers of ``formats``.

Data flow: path -> array of the left image's size; arrays and ``Rig`` -> ``StereoSample``.
Paper: none.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_metres
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.formats import check_file, files, read_depth_mm_png, read_image, read_pfm
from geodiff_plugin.geometry import is_rectified
from geodiff_plugin.types import Rig

__all__ = [
    "check_calibrated_sizes",
    "check_size",
    "folders",
    "make_sample",
    "read_depth_m",
    "read_npy",
    "read_rgb",
]


def read_rgb(path: Path, name: str) -> np.ndarray:
    """``(H, W, 3)`` uint8 of an image file, grey repeated; errors as ``formats.read_image``."""
    image_01, _ = read_image(path, name)
    return np.rint(image_01 * 255.0).astype(np.uint8)


def read_npy(path: Path, name: str) -> np.ndarray:
    """``(H, W)`` array of an npy file; ``ValueError`` naming it where it is damaged or of another rank."""
    values = files.read_npy(check_file(path, name, "an npy file"), name, "a map of shape (H, W)")
    if values.ndim != 2:
        bad_value(name, "a map of shape (H, W)", f"{path} of shape {values.shape}")
    return values


def read_depth_m(path: Path, name: str) -> np.ndarray:
    """``(H, W)`` metres of an npy or PFM file, or of a 16-bit PNG of millimetres; 0 or not finite is unknown.

    Raises:
        OSError: no readable file.
        ValueError: it is damaged, or an npy file of integers.
    """
    if path.suffix == ".png":
        return read_depth_mm_png(path, name)[0]
    if path.suffix == ".pfm":
        return read_pfm(path, name)
    values = read_npy(path, name)
    check_metres(values, name, f"{path}, {values.dtype}")
    return values


def check_size(path: Path, got: tuple[int, ...], expected: tuple[int, ...], side: str = "left") -> None:
    """Raise ``ValueError`` naming ``path`` where its ``(H, W)`` is not that of the image of a ``side``."""
    if tuple(got[:2]) != tuple(expected[:2]):
        bad_value(
            str(path),
            f"for {expected[1]} x {expected[0]} pixels as the {side} image",
            f"{got[1]} x {got[0]}",
            "Image, calibration and truth must be of one resolution.",
        )


def check_calibrated_sizes(
    calibration: tuple[Path, Path], rig: Rig, left: np.ndarray, right: np.ndarray
) -> None:
    """Refuse images that are not of the size that their calibration is for, where it says one.

    Args:
        calibration: the files of the left and the right camera, often the same.
        rig: what they hold.
        left: ``(H, W, 3)``.
        right: ``(H, W, 3)``.

    Raises:
        ValueError: another size, naming the file.
    """
    sizes, sides = (rig.size_left, rig.size_right), ("left", "right")
    for path, size, image, side in zip(calibration, sizes, (left, right), sides, strict=True):
        if size is not None:
            check_size(path, size[::-1], image.shape, side)


def folders(root: Path, depth: int) -> list[Path]:
    """``root`` and the folders below it down to ``depth`` levels, sorted."""
    found = [root] if os.path.isdir(root) else []
    level = found
    for _ in range(depth):
        level = [child for parent in level for child in sorted(parent.iterdir()) if child.is_dir()]
        found = found + level
    return found


def make_sample(
    ref: SampleRef,
    images: tuple[np.ndarray, np.ndarray],
    rig: Rig,
    depth_m: np.ndarray,
    notes: dict[str, Any],
    **masks: Any,
) -> StereoSample:
    """The sample of a reference, once its files are read.

    Args:
        ref: names the sample.
        images: left and right, ``(H, W, 3)`` uint8 each.
        rig: of the images as they are handed over.
        depth_m: ``(H, W)`` float, metres; what is not a positive number is unknown.
        notes: as in ``StereoSample``.
        **masks: ``occluded``, ``material`` and ``extra_views`` of ``StereoSample``.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0)
    cameras = (torch.as_tensor(matrix) for matrix in (rig.K_left, rig.K_right, rig.T_right_from_left))
    return StereoSample(
        dataset=ref.dataset,
        name=ref.name,
        left=images[0],
        right=images[1],
        K_left=rig.K_left,
        K_right=rig.K_right,
        E=rig.E,
        depth_m=np.where(valid, depth_m, 0).astype(np.float32),
        valid=valid,
        rectified=bool(is_rectified(*cameras)),
        notes=notes,
        **masks,
    )
