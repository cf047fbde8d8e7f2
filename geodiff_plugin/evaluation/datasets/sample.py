"""The sample that every data set yields, its reference, what readers share, samples changed on purpose."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

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

    A result is kept by what is in these files: name them, not their folder.
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
    """How to list a data set below a folder, in a fixed order, how to read it, how it is scored.

    ``cap_m`` is the farthest truth that counts in its protocol, metres, if any; ``obtain`` says how to get
    it, with its address and licence; ``options`` are keywords of ``find`` beside the folder, if any.
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
    levels = [[root] if os.path.isdir(root) else []]
    for _ in range(depth):
        below = chain.from_iterable(sorted(parent.iterdir()) for parent in levels[-1])
        levels.append([path for path in below if path.is_dir()])
    return list(chain(*levels))


def make_sample(
    ref: SampleRef, images: Images, rig: Rig, depth_m: np.ndarray, notes: dict[str, Any], **masks: Any
) -> StereoSample:
    """The sample of a reference, once its files are read.

    ``images`` are ``(H, W, 3)`` uint8 each, left and right; ``rig`` is that of the images as handed over;
    ``depth_m`` is ``(H, W)`` metres, unknown where not a positive number; ``masks`` are ``occluded``,
    ``material`` and ``extra_views`` of ``StereoSample``.
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


#: Errors are drawn between this share of the asked ones and all of them.
LEAST = 0.3

Numbers = tuple[float, float]


def changed_ref(ref: SampleRef, kind: str, change: Numbers) -> SampleRef:
    """The reference to a sample with a change, a key of ``CHANGES``, by whose two numbers it is named."""
    name = f"{ref.name}-{CHANGES[kind][0].format(*change)}"
    return replace(ref, name=name, files={**ref.files, kind: change})


#: Option -> what is typed, with its two largest numbers, and an example.
_ASKED: dict[str, tuple[str, Numbers, str]] = {
    "--perturb": (
        *("DEGREES,SHARE", (30, 0.9)),
        "1.5,0.1 turns by up to 1.5 degrees and shifts by up to a tenth of the baseline.",
    ),
    "--drift": (
        *("DEGREES,PIXELS", (5, 20)),
        "0.3,1.5 turns the right camera by 0.3 degrees and moves its image by 1.5 pixels.",
    ),
}


def two_numbers(text: str, option: str) -> Numbers:
    """The two numbers of ``--perturb`` or ``--drift`` as typed, each from 0 on; else ``ValueError``."""
    names, most, cure = _ASKED[option]
    parts = re.fullmatch(r"\s*(\d*\.?\d+)\s*,\s*(\d*\.?\d+)\s*", text)
    first, second = map(float, parts.groups()) if parts else (-1.0, -1.0)
    if not (0 <= first <= most[0] and 0 <= second <= most[1]):
        bad_value(option, f"{names} with numbers in [0, {most[0]:g}] and [0, {most[1]:g}]", repr(text), cure)
    return first, second


def with_exposure(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Change the right view only: v in [0, 1] becomes ``gain * v ** gamma``, clipped, in 8 bits again."""
    gain, gamma = change
    right_01 = np.clip(gain * (sample.right / 255.0) ** gamma, 0.0, 1.0)
    return replace(sample, name=name, right=np.rint(255 * right_01).astype(np.uint8))


def with_drifted_rig(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """What a rig gives whose right camera has turned and whose right image has moved since it was calibrated.

    Both are a homography, whatever the depth. ``change`` is degrees and pixels; the name draws axis and sign.
    """
    degrees, px = change
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    axis = rng.normal(size=3)
    R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    moved = np.eye(3)
    moved[1, 2] = px * rng.choice((-1.0, 1.0))
    H = moved @ sample.K_right @ R @ np.linalg.inv(sample.K_right)
    size = sample.right.shape[1::-1]
    right = cv2.warpPerspective(sample.right, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(sample, name=name, right=right)


def perturbed_pose(
    E: np.ndarray, degrees: float, share: float, depth_m: float, rng: np.random.Generator
) -> np.ndarray:
    """A pose with an error of at most ``degrees`` and that ``share`` of the baseline, which stays as long.

    Every second error is of a tracker's kind: its shift makes up for its turn at the scene's depth.
    """
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = axis * np.radians(degrees) * rng.uniform(LEAST, 1.0)
    baseline = float(np.linalg.norm(E[:3, 3]))
    shift = way * share * baseline * rng.uniform(LEAST, 1.0)
    if rng.random() < 0.5:
        shift = -np.cross(turn, (0.0, 0.0, depth_m))
        shift *= min(1.0, share * baseline / max(float(np.linalg.norm(shift)), 1e-12))
    wrong = E.copy()
    wrong[:3, :3] = E[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    moved = E[:3, 3] + E[:3, :3] @ shift
    wrong[:3, 3] = moved * baseline / np.linalg.norm(moved)
    return wrong


def with_perturbed_poses(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Give the poses of a sample's right views wrongly, by at most so many degrees and share of the baseline.

    The truth says how far away the scene is; the error is drawn from the name.
    """
    sample.check_truth()
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    depth_m, (degrees, share) = float(np.median(sample.depth_m[sample.valid])), change
    wrong = partial(perturbed_pose, degrees=degrees, share=share, depth_m=depth_m, rng=rng)
    E, extra = wrong(sample.E), tuple((image, K, wrong(other)) for image, K, other in sample.extra_views)
    return replace(sample, name=name, E=E, E_true=sample.E_scored, extra_views=extra)


#: Entry of ``SampleRef.files`` -> what it adds to the name, and how a sample becomes so.
CHANGES: dict[str, tuple[str, Callable[[StereoSample, Any, str], StereoSample]]] = {
    "right_exposure": ("gain{:g}-gamma{:g}", with_exposure),
    "perturbed": ("turn{:g}-shift{:g}", with_perturbed_poses),
    "drifted": ("drift{:g}-{:g}px", with_drifted_rig),
}
