"""Checks and sorts the input beside the left image: right views with cameras, known points.

Data flow: ``right, K, E, points`` in any of their forms -> one ``ImageInputs`` per left image.
Paper: S3.3 (two views with known cameras); more views and points go beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from geodiff_plugin._camera_checks import (
    check_baseline,
    check_intrinsics,
    check_intrinsics_fit,
    check_pose,
    warn_of_long_baseline,
    warn_of_other_size,
)
from geodiff_plugin._checks import bad_type, bad_value, check_metres
from geodiff_plugin.formats import as_image_01, picture_size
from geodiff_plugin.formats.exif import warn_of_other_lens
from geodiff_plugin.types import CameraView, Rig

__all__ = ["ImageInputs", "as_points", "read_inputs", "split_views"]


@dataclass(frozen=True, eq=False)
class ImageInputs:
    """What is known beside one left image.

    Attributes:
        K_left: ``(3, 3)`` float64, pixels of the left image.
        rights: the right images, ``(3, H, W)`` float32 in [0, 1] each, native size.
        rigs: the cameras, one a right image.
        points: ``(N, 3)`` float32 metres in the left camera's frame, or ``(H, W)`` float32 metres with 0
            where unknown; ``None`` for none.
    """

    K_left: np.ndarray
    rights: tuple[Tensor, ...]
    rigs: tuple[Rig, ...]
    points: Tensor | None

    def on(self, device: torch.device) -> tuple[list[CameraView], Tensor, Tensor | None]:
        """The further views, ``K_left``, points: float32 on a device."""

        def moved(x: np.ndarray | Tensor) -> Tensor:
            return torch.as_tensor(x, dtype=torch.float32, device=device)

        views = [
            CameraView(moved(image), moved(rig.K_right), moved(rig.T_right_from_left))
            for image, rig in zip(self.rights, self.rigs, strict=True)
        ]
        return views, moved(self.K_left), None if self.points is None else moved(self.points)


def read_inputs(
    right: Any, K: Any, E: Any, points: Any, *, cropped: bool = False, unit: str | None = "m"
) -> list[ImageInputs]:
    """Sort out the forms that ``GeometryGuidance`` takes, and check every entry.

    Args:
        right: as in ``GeometryGuidance``.
        K: likewise.
        E: likewise.
        points: likewise.
        cropped: likewise.
        unit: likewise.

    Returns:
        One entry per left image.

    Raises:
        TypeError, ValueError: anything of the wrong rank, size, number or rigidity, naming the argument.
    """
    if right is None and points is None:
        bad_value("right", "an image, or None together with points", "None without points")
    batch = next((x for x in (right, points) if isinstance(x, list) and not _is_nested_matrix(x)), [None])
    count = len(batch)
    if right is not None and not isinstance(right, list) and count == 1:
        K, E = _as_tuple(K), _as_tuple(E)
    if count == 0:
        bad_value("right", "an image or a list with one image per left image", "an empty list")
    found = [_read_one(right, K, E, points, i, count, cropped, unit) for i in range(count)]
    for name, given in (
        ("right", [bool(one.rights) for one in found]),
        ("points", [one.points is not None for one in found]),
    ):
        if any(given) and not all(given):
            bad_value(name, "given for every left image or for none", f"None for {given.index(False)}")
    return found


def _read_one(
    right: Any, K: Any, E: Any, points: Any, i: int, count: int, cropped: bool, unit: str | None
) -> ImageInputs:
    """The entry of left image ``i`` of ``count``."""

    def label(name: str) -> str:
        return name if count == 1 else f"{name}[{i}]"

    own_right = _entry(right, "right", i, count)
    views = own_right if isinstance(own_right, tuple) else () if own_right is None else (own_right,)
    names = [
        label("right") if len(views) == 1 else f"{label('right')}, view {v + 1}," for v in range(len(views))
    ]
    images = tuple(as_image_01(image, name) for image, name in zip(views, names, strict=True))
    own_K = _entry(K, "K", i, count)
    K_left, K_rights = _intrinsics(own_K, label("K"), len(images))
    poses = _poses(_entry(E, "E", i, count), label("E"), len(images), unit)
    for v, (K_right, image) in enumerate(zip(K_rights, images, strict=True)):
        if cropped:
            break
        name = f"{label('K')}[{_view(v, len(images))}]" if isinstance(own_K, tuple) else label("K")
        fit = (K_right, image.shape[-1], image.shape[-2], name, "the right image")
        check_intrinsics_fit(*fit)
        warn_of_other_size(*fit)
    for image, K_right, name in zip(views, K_rights, names, strict=True):
        if isinstance(image, Image.Image):
            warn_of_other_lens(image, K_right, name)
    rigs = tuple(Rig(K_left, K_right, pose) for K_right, pose in zip(K_rights, poses, strict=True))
    own_points = _entry(points, "points", i, count)
    return ImageInputs(
        K_left, images, rigs, None if own_points is None else as_points(own_points, label("points"))
    )


def _is_nested_matrix(value: list[Any]) -> bool:
    """A matrix written as nested lists of numbers, as opposed to a list with one entry per image."""
    rows = bool(value) and all(isinstance(row, (list, tuple)) for row in value)
    return rows and all(isinstance(entry, Real) for row in value for entry in row)


def _as_tuple(value: Any) -> Any:
    """A list of matrices beside one left image is the tuple of cameras that is meant."""
    matrices = isinstance(value, list) and len(value) > 1 and not _is_nested_matrix(value)
    return tuple(value) if matrices else value


def _entry(value: Any, name: str, i: int, count: int) -> Any:
    """The entry of image ``i``: a list has one per image, anything else serves all."""
    if not isinstance(value, list) or _is_nested_matrix(value):
        return value
    if len(value) != count:
        bad_value(name, f"a list of {count} entries, one per right image", f"{len(value)} entries")
    return value[i]


def _view(v: int, views: int) -> str:
    return "right" if views == 1 else f"right view {v + 1}"


def _intrinsics(K: Any, name: str, views: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """K of the left image and of every right one."""
    if not isinstance(K, tuple):
        matrix = check_intrinsics(K, name)
        return matrix, [matrix] * views
    if len(K) != 1 + views:
        expected = f"a 3x3 matrix or a tuple (K_left, K_right{', ...' if views > 1 else ''}), left one first"
        bad_value(name, expected, f"a tuple of {len(K)} for {views} right views")
    rights = [check_intrinsics(own, f"{name}[{_view(v, views)}]") for v, own in enumerate(K[1:])]
    return check_intrinsics(K[0], f"{name}[left]"), rights


def _poses(E: Any, name: str, views: int, unit: str | None) -> list[np.ndarray]:
    """Pose of every right camera in the left camera's frame."""
    if views == 0:
        if E is not None:
            bad_value(name, "None without a right view", "a pose", "Points are in the left camera's frame.")
        return []
    if isinstance(E, tuple):
        if len(E) != 1 + views:
            expected = "a tuple (E_left, E_right, ...) of camera-to-world poses, left one first"
            bad_value(name, expected, f"a tuple of {len(E)} for {views} right views")
        to_left = np.linalg.inv(check_pose(E[0], f"{name}[left]"))
        poses = [to_left @ check_pose(own, f"{name}[{_view(v, views)}]") for v, own in enumerate(E[1:])]
    elif views > 1:
        expected = (
            "a tuple (E_left, E_right, ...) of camera-to-world poses where there are several right views"
        )
        bad_type(name, expected, E)
    else:
        poses = [check_pose(E, name)]
    for v, pose in enumerate(poses):
        named = name if views == 1 else f"{name}[{_view(v, views)}]"
        check_baseline(pose, named)
        if unit == "m":
            warn_of_long_baseline(pose, named)
    return poses


def as_points(value: Any, name: str) -> Tensor:
    """``(N, 3)`` of finite rows, or ``(H, W)`` with 0 where unknown, float32, metres."""
    forms = "a sparse depth map (H, W) or points (N, 3) in the left camera's frame, metres"
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value.float() if value.dtype == torch.bfloat16 else value).numpy()  # numpy has no bfloat16
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        bad_type(name, forms, value)
    if array.dtype.kind not in "fiu":
        bad_type(name, forms, value)
    if array.ndim != 2 or array.shape[1] < 3:
        bad_value(name, forms, f"shape {array.shape}")
    if array.shape[1] in (4, 6):  # with an intensity, or a colour; no image is that narrow
        array = array[:, :3]
    if array.shape[1] != 3 or not isinstance(value, (list, tuple)):  # whole metres typed by hand are meant so
        check_metres(array, name)
    array = array.astype(np.float32)
    finite = np.isfinite(array)
    if array.shape[1] == 3:
        array = array[finite.all(1)]
        known = len(array)
    else:
        array = np.where(finite & (array > 0), array, np.float32(0))
        known = int(np.count_nonzero(array))
    if not known:
        bad_value(name, forms + ", at least one of them known", "none: all are 0, NaN or infinite")
    return torch.from_numpy(np.ascontiguousarray(array))


def split_views(
    views: Any, *, cropped: bool = False
) -> tuple[tuple[int, int] | None, tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    """Take ``[(image, K, E), ...]`` apart, the left view first.

    Args:
        views: as in ``GeometryGuidance.from_views``.
        cropped: as in ``GeometryGuidance``.

    Returns:
        ``(width, height)`` of the left image or ``None``, the right images, all K's and all E's.

    Raises:
        TypeError, ValueError: not at least two triples; a left K that is not for its image.
    """
    form = "a list [(image, K, E), ...] with the left view first"
    if not isinstance(views, (list, tuple)):
        bad_type("views", form, views)
    if len(views) < 2 or not all(isinstance(view, (list, tuple)) and len(view) == 3 for view in views):
        kinds = [len(v) if isinstance(v, (list, tuple)) else type(v).__name__ for v in views]
        bad_value("views", form, f"{len(views)} entries of lengths {kinds}", "Three values each.")
    images, Ks, Es = (tuple(column) for column in zip(*views, strict=True))
    if images[0] is None:
        return None, images[1:], Ks, Es
    width, height = picture_size(images[0], "the left view's image")
    K_left = check_intrinsics(Ks[0], "K[left]")
    if not cropped:
        check_intrinsics_fit(K_left, width, height, "K[left]", "the left view's image")
    if isinstance(images[0], Image.Image):
        warn_of_other_lens(images[0], K_left, "the left view's image")
    return (width, height), images[1:], Ks, Es
