"""The sample that every data set yields, its reference, what readers share, samples changed on purpose."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin._camera_checks import check_metres
from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import read_depth_png, read_image
from geodiff_plugin.formats.clouds import in_8_bits
from geodiff_plugin.formats.depth import read_map
from geodiff_plugin.geometry import is_rectified
from geodiff_plugin.types import Rig

Array = np.ndarray
Images = tuple[Array, Array]
Numbers = tuple[float, float]


class ExtraView(NamedTuple):
    """A further right view: image ``(H, W, 3)`` uint8, its K, its pose in the left camera's frame, metres."""

    image: Array
    K: Array
    E: Array


@dataclass(frozen=True, eq=False)
class StereoSample:
    """Two posed views with the truth of the left one, the reference view."""

    dataset: str
    name: str
    left: Array  # (H, W, 3) uint8, as the right one, which may have another size
    right: Array
    K_left: Array  # (3, 3) float64, pixels
    K_right: Array
    E: Array  # (4, 4) float64, metres: pose of the right camera in the left camera's frame
    depth_m: Array  # (H, W) float32; 0 where the truth is unknown
    valid: Array  # (H, W) bool, where it is known
    occluded: Array | None = None  # (H, W) bool, hidden in the right view or outside it, if the set says
    material: Array | None = None  # (H, W) uint8 class, if the set has any
    rectified: bool = False  # as geometry.is_rectified
    notes: Mapping[str, Any] = field(default_factory=dict)  # for a reader: truth, disparity_step_px ...
    extra_views: tuple[ExtraView, ...] = ()
    E_true: Array | None = None  # where E is wrong on purpose, but for the length of the baseline

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"

    @property
    def E_scored(self) -> Array:
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
    """A sample that was not read yet; a result is kept by what is in the files that ``files`` names."""

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


def disparity_to_depth(disparity_px: Array, K_left: Array, K_right: Array, E: Array) -> Array:
    """``(H, W)`` float32 metres of a rectified pair's disparity: ``f b / (d + cx_right - cx_left)``.

    The difference of the centres is Middlebury's ``doffs``; 0 where the sum is not positive or not finite.
    """
    if E[0, 3] <= 0:
        bad_value("E[0, 3]", "positive, the right camera to the right", E[0, 3], "Swap the two views.")
    shifted = np.asarray(disparity_px, np.float64) + (K_right[0, 2] - K_left[0, 2])
    known = np.isfinite(shifted) & (shifted > 0)
    return np.where(known, K_left[0, 0] * E[0, 3] / np.where(known, shifted, 1.0), 0).astype(np.float32)


def depth_to_disparity(depth_m: Array, K_left: Array, K_right: Array, E: Array) -> Array:
    """``(H, W)`` float64, pixels: the inverse of ``disparity_to_depth`` for positive depth."""
    return K_left[0, 0] * E[0, 3] / np.asarray(depth_m, np.float64) - (K_right[0, 2] - K_left[0, 2])


def read_rgb(path: Path, name: str) -> Array:
    """``(H, W, 3)`` uint8 of an image file, grey repeated; errors as ``formats.read_image``."""
    image_01, _ = read_image(path, name)
    return in_8_bits(image_01)


def read_depth_m(path: Path, name: str) -> Array:
    """``(H, W)`` metres of an npy file of floats, a PFM file, or a 16-bit PNG of millimetres."""
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
    """The sample of a reference, once its files are read.

    ``images`` are ``(H, W, 3)`` uint8 each, left and right, and ``rig`` is theirs; ``depth_m`` is ``(H, W)``
    metres, unknown where not positive; ``masks`` are ``occluded``, ``material`` and ``extra_views``.
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


def changed_ref(ref: SampleRef, kind: str, change: Numbers) -> SampleRef:
    """The reference to a sample with a change, a key of ``CHANGES``, by whose two numbers it is named."""
    name = f"{ref.name}-{CHANGES[kind][0].format(*change)}"
    return replace(ref, name=name, files={**ref.files, kind: change})


def two_numbers(text: str, option: str) -> Numbers:
    """The two numbers of ``--perturb`` or ``--drift`` as typed, each from 0 on; else ``ValueError``."""
    names, most = ("DEGREES,SHARE", (30, 0.9)) if option == "--perturb" else ("DEGREES,PIXELS", (5, 20))
    parts = re.fullmatch(r"\s*(\d*\.?\d+)\s*,\s*(\d*\.?\d+)\s*", text)
    first, second = map(float, parts.groups()) if parts else (-1.0, -1.0)
    if not (0 <= first <= most[0] and 0 <= second <= most[1]):
        expected = f"{names}, such as 0.3,0.1, in [0, {most[0]:g}] and [0, {most[1]:g}]"
        bad_value(option, expected, repr(text))
    return first, second


def with_drifted_rig(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """The right camera has turned and its image moved, a homography; the name draws axis and sign."""
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
    """Give the poses of the right views wrongly, by at most degrees and that share of the baseline.

    Every second error is of a tracker's kind: its shift makes up for its turn at the scene's depth.
    """
    sample.check_truth()
    rng, (degrees, share) = np.random.default_rng(zlib.crc32(name.encode())), change
    depth_m = float(np.median(sample.depth_m[sample.valid]))

    def wrong(E: Array) -> Array:
        axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        turn = axis * np.radians(degrees) * rng.uniform(LEAST, 1.0)
        baseline = float(np.linalg.norm(E[:3, 3]))
        shift = way * share * baseline * rng.uniform(LEAST, 1.0)
        if rng.random() < 0.5:
            shift = -np.cross(turn, (0.0, 0.0, depth_m))
            shift *= min(1.0, share * baseline / max(float(np.linalg.norm(shift)), 1e-12))
        given, moved = E.copy(), E[:3, 3] + E[:3, :3] @ shift
        given[:3, :3] = E[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        given[:3, 3] = moved * baseline / np.linalg.norm(moved)
        return given

    E, extra = wrong(sample.E), tuple(view._replace(E=wrong(view.E)) for view in sample.extra_views)
    return replace(sample, name=name, E=E, E_true=sample.E_scored, extra_views=extra)


#: Entry of ``SampleRef.files`` -> what it adds to the name, and how a sample becomes so.
CHANGES: dict[str, tuple[str, Callable[[StereoSample, Any, str], StereoSample]]] = {
    "perturbed": ("turn{:g}-shift{:g}", with_perturbed_poses),
    "drifted": ("drift{:g}-{:g}px", with_drifted_rig),
}
