"""The sample that every data set yields, its reference, and what readers of data sets share."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._camera_checks import check_metres
from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import read_depth_png, read_image
from geodiff_plugin.formats.depth import read_map
from geodiff_plugin.geometry import is_rectified
from geodiff_plugin.types import Rig

ExtraView = tuple[np.ndarray, np.ndarray, np.ndarray]
Images = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class StereoSample:
    """Two posed views with the truth of the left one.

    Attributes:
        dataset, name: its name in ``DATASETS``, and of the sample within it.
        left, right: ``(H, W, 3)`` and ``(H', W', 3)`` uint8; the left one is the reference view.
        K_left, K_right: ``(3, 3)`` float64, pixels.
        E: ``(4, 4)`` float64, metres; pose of the right camera in the left camera's frame.
        depth_m: ``(H, W)`` float32, metres; 0 where the truth is unknown.
        valid: ``(H, W)`` bool, where the truth is known.
        occluded: ``(H, W)`` bool, hidden in the right view or outside it; ``None`` if the set is silent.
        material: ``(H, W)`` uint8 material class; ``None`` where the set has none.
        rectified: whether rows are epipolar lines with equal focal lengths (``geometry.is_rectified``).
        notes: what a reader of the numbers should know, e.g. ``truth``, ``disparity_step_px``.
        extra_views: ``(image, K, E)`` of further views, ``E`` the pose in the left camera's frame.
        E_true: ``(4, 4)`` the pose that the right image was taken from, where ``E`` is given wrongly on
            purpose, but for the length of the baseline; ``None`` where ``E`` is it.
    """

    dataset: str
    name: str
    left: np.ndarray
    right: np.ndarray
    K_left: np.ndarray
    K_right: np.ndarray
    E: np.ndarray
    depth_m: np.ndarray
    valid: np.ndarray
    occluded: np.ndarray | None = None
    material: np.ndarray | None = None
    rectified: bool = False
    notes: Mapping[str, Any] = field(default_factory=dict)
    extra_views: tuple[ExtraView, ...] = ()
    E_true: np.ndarray | None = None

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"

    @property
    def E_scored(self) -> np.ndarray:
        """``(4, 4)`` the pose that truth and scores go by, whatever the methods are given."""
        return self.E if self.E_true is None else self.E_true

    def check_truth(self) -> StereoSample:
        """Itself; ``ValueError`` where no pixel has truth."""
        if not self.valid.any():
            got = f"none ({self.notes['truth']})" if "truth" in self.notes else "none"
            bad_value(f"the truth of {self.label}", "known for at least one pixel", got)
        return self


@dataclass(frozen=True, eq=False)
class SampleRef:
    """A sample that was listed but not read yet; ``files`` has the paths and numbers that its loader needs.

    A result is kept by what is in these files, so name files and not their folder.
    """

    dataset: str
    name: str
    files: Mapping[str, Any]

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"


@dataclass(frozen=True)
class Dataset:
    """How to list a data set, how to read it, how it is scored.

    Attributes:
        name: key in ``DATASETS``.
        find: folder -> references in a fixed order; an empty list where the folder holds none.
        load: reference -> sample.
        cap_m: farthest truth that counts in the set's own protocol, metres; ``None`` for no limit.
        obtain: how to get the set, one sentence with its address and licence.
        options: keywords that ``find`` takes beside the folder.
        needs_folder: whether there is a folder to look into; not for what is rendered.
    """

    name: str
    find: Callable[..., list[SampleRef]]
    load: Callable[[SampleRef], StereoSample]
    cap_m: float | None
    obtain: str
    options: tuple[str, ...] = ()
    needs_folder: bool = True


def disparity_to_depth(
    disparity_px: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """``(H, W)`` float32 metres of a rectified pair's disparity: ``f b / (d + cx_right - cx_left)``.

    The disparity is ``x_left - x_right`` in pixels, the difference of the centres Middlebury's ``doffs``; the
    result is 0 where their sum is not positive or not finite.
    """
    if E[0, 3] <= 0:
        bad_value("E[0, 3]", "positive, the right camera to the right", E[0, 3], "Swap the two views.")
    shifted = np.asarray(disparity_px, np.float64) + (K_right[0, 2] - K_left[0, 2])
    known = np.isfinite(shifted) & (shifted > 0)
    return np.where(known, K_left[0, 0] * E[0, 3] / np.where(known, shifted, 1.0), 0).astype(np.float32)


def depth_to_disparity(
    depth_m: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """``(H, W)`` float64, pixels: the inverse of ``disparity_to_depth`` for positive depth."""
    return K_left[0, 0] * E[0, 3] / np.asarray(depth_m, np.float64) - (K_right[0, 2] - K_left[0, 2])


def read_rgb(path: Path, name: str) -> np.ndarray:
    """``(H, W, 3)`` uint8 of an image file, grey repeated; errors as ``formats.read_image``."""
    image_01, _ = read_image(path, name)
    return np.rint(image_01 * 255.0).astype(np.uint8)


def read_depth_m(path: Path, name: str) -> np.ndarray:
    """``(H, W)`` metres of an npy or PFM file, or of a 16-bit PNG of millimetres; 0 or not finite is unknown.

    Errors are those of ``formats.depth.read_map``; ``ValueError`` for an npy file of integers, too.
    """
    if path.suffix == ".png":
        return read_depth_png(path, name=name)[0]
    values = read_map(path, name)
    if path.suffix == ".npy":
        stored = np.load(path, mmap_mode="r")
        check_metres(stored, name, f"{path}, {stored.dtype}")
    return values


def check_size(path: Path, got: tuple[int, ...], expected: tuple[int, ...], side: str = "left") -> None:
    """Raise ``ValueError`` naming ``path`` where its ``(H, W)`` is not that of the image of a ``side``."""
    if tuple(got[:2]) != tuple(expected[:2]):
        size = f"for {expected[1]} x {expected[0]} pixels as the {side} image"
        cure = "Image, calibration and truth must be of one resolution."
        bad_value(str(path), size, f"{got[1]} x {got[0]}", cure)


def folders(root: Path, depth: int) -> list[Path]:
    """``root`` and the folders below it down to ``depth`` levels, sorted."""
    level = [root] if os.path.isdir(root) else []
    listed = level
    for _ in range(depth):
        level = [child for parent in level for child in sorted(parent.iterdir()) if child.is_dir()]
        listed = listed + level
    return listed


def make_sample(
    ref: SampleRef, images: Images, rig: Rig, depth_m: np.ndarray, notes: dict[str, Any], **masks: Any
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
        *(ref.dataset, ref.name, *images, rig.K_left, rig.K_right, rig.E),
        depth_m=np.where(valid, depth_m, 0).astype(np.float32),
        valid=valid,
        rectified=bool(is_rectified(*cameras)),
        notes=notes,
        **masks,
    )
