"""Samples of data sets, references to them, common reading functions, and perturbed samples."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.camera_checks import check_metres
from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Camera, is_rectified
from geodiff_plugin.formats import in_8_bits, read_depth_png, read_image, read_map
from geodiff_plugin.types import Rig

Array = np.ndarray
Images = tuple[Array, Array]
Numbers = tuple[float, float]


class ExtraView(NamedTuple):
    """A further right view: image ``(H, W, 3)`` uint8, K, and pose in the left camera's frame, metres."""

    image: Array
    K: Array
    E: Array


@dataclass(frozen=True, eq=False)
class StereoSample:
    """Two posed views with ground truth of the left one, the reference view."""

    dataset: str
    name: str
    left: Array  # (H, W, 3) uint8; the right image may have another size
    right: Array
    K_left: Array  # (3, 3) float64, pixels
    K_right: Array
    E: Array  # (4, 4) float64, metres: pose of the right camera in the left camera's frame
    depth_m: Array  # (H, W) float32; 0 where unknown
    valid: Array  # (H, W) bool, true where known
    occluded: Array | None = None  # (H, W) bool, occluded in the right view or outside it, if provided
    material: Array | None = None  # (H, W) uint8 class, if provided
    rectified: bool = False  # as geometry.is_rectified
    notes: Mapping[str, Any] = field(
        default_factory=dict
    )  # information for the user, such as disparity_step_px
    extra_views: tuple[ExtraView, ...] = ()
    E_true: Array | None = None  # correct pose if E is perturbed, up to the length of the baseline

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"

    @property
    def E_scored(self) -> Array:
        """``(4, 4)`` pose used for ground truth and scores, independent of the methods' input."""
        return self.E if self.E_true is None else self.E_true

    def check_ground_truth(self) -> StereoSample:
        """Return the sample; raise ``ValueError`` if no pixel has ground truth."""
        if not self.valid.any():
            got = f"none ({self.notes['truth']})" if "truth" in self.notes else "none"
            bad_value(f"the ground truth of {self.label}", "known for at least one pixel", got)
        return self


@dataclass(frozen=True, eq=False)
class SampleRef:
    """Reference to an unread sample; results are stored by the content of ``files``."""

    dataset: str
    name: str
    files: Mapping[str, Any]

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"


@dataclass(frozen=True)
class Dataset:
    """Describes how to list a data set in a folder in a fixed order, read it, and score it.

    ``cap_m`` is the maximum ground-truth depth of its protocol in metres, if any; ``obtain`` states how to
    get it, with URL and licence; ``options`` are keywords of ``find`` besides the folder; ``bad_px`` is the
    disparity error above which a pixel is bad in its benchmark, if any.
    """

    name: str
    find: Callable[..., list[SampleRef]]
    load: Callable[[SampleRef], StereoSample]
    cap_m: float | None
    obtain: str
    options: tuple[str, ...] = ()
    needs_folder: bool = True
    bad_px: float | None = None


def folders(root: Path, depth: int) -> list[Path]:
    """Return ``root`` and its subfolders down to ``depth`` levels, sorted."""
    levels = [[root] if os.path.isdir(root) else []]
    for _ in range(depth):
        below = chain.from_iterable(sorted(parent.iterdir()) for parent in levels[-1])
        levels.append([path for path in below if path.is_dir()])
    return list(chain(*levels))


def existing(path: Path) -> Path | None:
    """Return the path if it is a file."""
    return path if path.is_file() else None


def check_size(path: Path, got: tuple[int, ...], expected: tuple[int, ...], side: str = "left") -> None:
    """Raise ``ValueError`` with ``path`` if its ``(H, W)`` differs from the image of a ``side``."""
    if tuple(got[:2]) != tuple(expected[:2]):
        size = f"for {expected[1]} x {expected[0]} pixels as the {side} image"
        hint = "Image, calibration and ground truth must have the same resolution."
        bad_value(str(path), size, f"{got[1]} x {got[0]}", hint)


def like(image: Array, path: Path, values: Array) -> Array:
    """Return the values of a file, which must have the image's size."""
    check_size(path, values.shape, image.shape)
    return values


def step_px(disparity: Array) -> float:
    """Return the step between neighbouring disparity values, 0 if practically continuous."""
    gaps = np.diff(np.unique(disparity))
    # Floats have gaps far below 1/16 px; ground truth made from 8-bit maps does not.
    return float(gaps.min()) if gaps.size and gaps.min() > 1 / 16 else 0.0


def disparity_to_depth(disparity_px: Array, K_left: Array, K_right: Array, E: Array) -> Array:
    """Convert a rectified pair's disparity to ``(H, W)`` float32 metres: ``f b / (d + cx_right - cx_left)``.

    The difference of the centres is Middlebury's ``doffs``; 0 if the sum is not positive or not finite.
    """
    if E[0, 3] <= 0:
        bad_value("E[0, 3]", "positive, the right camera to the right", E[0, 3], "Swap the two views.")
    shifted = np.asarray(disparity_px, np.float64) + (K_right[0, 2] - K_left[0, 2])
    known = np.isfinite(shifted) & (shifted > 0)
    return np.where(known, K_left[0, 0] * E[0, 3] / np.where(known, shifted, 1.0), 0).astype(np.float32)


def depth_to_disparity(depth_m: Array, K_left: Array, K_right: Array, E: Array) -> Array:
    """Convert depth to disparity, ``(H, W)`` float64 pixels; inverse of ``disparity_to_depth``."""
    return K_left[0, 0] * E[0, 3] / np.asarray(depth_m, np.float64) - (K_right[0, 2] - K_left[0, 2])


def read_rgb(path: Path, name: str) -> Array:
    """Read an image file as ``(H, W, 3)`` uint8, repeating grey; errors as in ``formats.read_image``."""
    image_01, _ = read_image(path, name)
    return in_8_bits(image_01)


def read_depth_m(path: Path, name: str) -> Array:
    """Read ``(H, W)`` metres from a float npy file, a PFM file, or a 16-bit PNG in millimetres."""
    if path.suffix == ".png":
        return read_depth_png(path, name=name)[0]
    values = read_map(path, name)
    if path.suffix == ".npy":
        stored = np.load(path, mmap_mode="r")
        check_metres(stored, name, f"{path}, {stored.dtype}")
    return values


def make_sample(
    ref: SampleRef, images: Images, rig: Rig, depth_m: Array, notes: dict[str, Any], **masks: Any
) -> StereoSample:
    """Build the sample of a reference from its files.

    ``images`` are ``(H, W, 3)`` uint8, left and right, and ``rig`` is their rig; ``depth_m`` is ``(H, W)``
    metres, unknown where not positive; ``masks`` are ``occluded``, ``material`` and ``extra_views``.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0)
    return StereoSample(
        *(ref.dataset, ref.name, *images, rig.K_left, rig.K_right, rig.E),
        depth_m=np.where(valid, depth_m, 0).astype(np.float32),
        valid=valid,
        rectified=is_rectified(rig.left, rig.right, rig.T_right_from_left),
        notes=notes,
        **masks,
    )


#: Minimum error drawn, as a fraction of the requested maximum.
MIN_FRACTION = 0.3


def changed_ref(ref: SampleRef, kind: str, change: Numbers) -> SampleRef:
    """Return the reference to a sample with a change (a key of ``CHANGES``), named by its two numbers."""
    name = f"{ref.name}-{CHANGES[kind][0].format(*change)}"
    return replace(ref, name=name, files={**ref.files, kind: change})


def two_numbers(text: str, option: str) -> Numbers:
    """Parse the two non-negative numbers of ``--perturb`` or ``--drift``; else ``ValueError``."""
    names, limits = ("DEGREES,FRACTION", (30, 0.9)) if option == "--perturb" else ("DEGREES,PIXELS", (5, 20))
    parts = re.fullmatch(r"\s*(\d*\.?\d+)\s*,\s*(\d*\.?\d+)\s*", text)
    first, second = map(float, parts.groups()) if parts else (-1.0, -1.0)
    if not (0 <= first <= limits[0] and 0 <= second <= limits[1]):
        expected = f"{names}, such as 0.3,0.1, in [0, {limits[0]:g}] and [0, {limits[1]:g}]"
        bad_value(option, expected, repr(text))
    return first, second


def with_drifted_rig(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Rotate the right camera and shift its image by a homography; the name seeds axis and sign."""
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


def with_perturbed_poses(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Perturb the poses of the right views by at most these degrees and this fraction of the baseline.

    Every second error resembles a tracker's: the translation compensates the rotation at the scene's depth.
    """
    sample.check_ground_truth()
    limits = _PoseError(*change)
    depth_m = float(np.median(sample.depth_m[sample.valid]))
    rng = np.random.default_rng(zlib.crc32(name.encode()))  # draws for the first view, then for the others
    E = _perturbed_pose(sample.E, limits, depth_m, rng)
    extra_views = tuple(
        view._replace(E=_perturbed_pose(view.E, limits, depth_m, rng)) for view in sample.extra_views
    )
    return replace(sample, name=name, E=E, E_true=sample.E_scored, extra_views=extra_views)


class _PoseError(NamedTuple):
    """Maximum error of a pose."""

    degrees: float
    fraction: float  # of the baseline


def _perturbed_pose(E: Array, limits: _PoseError, depth_m: float, rng: np.random.Generator) -> Array:
    """Return a camera-to-world pose with a random error, and with the same length of its baseline."""
    rotation_axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    rotation = rotation_axis * np.radians(limits.degrees) * rng.uniform(MIN_FRACTION, 1.0)
    baseline = float(np.linalg.norm(E[:3, 3]))
    limit_m = limits.fraction * baseline
    shift = direction * limit_m * rng.uniform(MIN_FRACTION, 1.0)
    if rng.random() < 0.5:  # like a tracker's: points at this depth stay in place
        shift = -np.cross(rotation, (0.0, 0.0, depth_m))
        shift *= min(1.0, limit_m / max(float(np.linalg.norm(shift)), 1e-12))
    position = E[:3, 3] + E[:3, :3] @ shift
    perturbed = E.copy()
    perturbed[:3, :3] = E[:3, :3] @ Rotation.from_rotvec(rotation).as_matrix()
    perturbed[:3, 3] = position * baseline / np.linalg.norm(position)
    return perturbed


def with_scaled_rig(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Scale translations and ground truth by the first number, and the right image by the second.

    A scene and its cameras can be scaled together without changing an image, so depth must follow the
    translations. A resized right image has another K than the left one.
    """
    factor, zoom = change

    def scaled(E: Array) -> Array:
        moved = E.copy()
        moved[:3, 3] *= factor
        return moved

    height, width = sample.right.shape[:2]
    size = round(width * zoom), round(height * zoom)
    right = sample.right
    camera = Camera(sample.K_right, (width, height)).resized(size)
    if size != (width, height):
        right = cv2.resize(right, size, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC)
    E = scaled(sample.E)
    return replace(
        sample,
        name=name,
        right=right,
        K_right=camera.K,
        E=E,
        depth_m=sample.depth_m * np.float32(factor),
        rectified=is_rectified(Camera(sample.K_left), camera, np.linalg.inv(E)),
        E_true=None if sample.E_true is None else scaled(sample.E_true),
        extra_views=tuple(view._replace(E=scaled(view.E)) for view in sample.extra_views),
    )


#: Entry of ``SampleRef.files`` -> suffix of the name, and the change of the sample.
CHANGES: dict[str, tuple[str, Callable[[StereoSample, Any, str], StereoSample]]] = {
    "perturbed": ("turn{:g}-shift{:g}", with_perturbed_poses),
    "drifted": ("drift{:g}-{:g}px", with_drifted_rig),
    "scaled": ("scaled{:g}-right{:g}", with_scaled_rig),
}
