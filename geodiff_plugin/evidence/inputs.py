"""Reads and checks the user's input in all its forms: left image, views, cameras, points (S3.3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from geodiff_plugin._internal.camera_checks import (
    check_baseline,
    check_intrinsics,
    check_intrinsics_fit,
    check_metres,
    check_pose,
    check_size_of,
    warn_of_far_points,
)
from geodiff_plugin._internal.checks import bad_type, bad_value
from geodiff_plugin.cameras import Camera, PosedViews, View
from geodiff_plugin.evidence.valid import alpha_mask, as_mask, both, neutral_views
from geodiff_plugin.formats import as_image_01, image_size_of, warn_of_other_lens
from geodiff_plugin.geometry import image_size
from geodiff_plugin.types import Rig

#: Maximum excess of a confidence over 1 that is rounded to 1.
ROUNDING = 1e-6
#: Description of the ``points`` argument in messages.
POINTS = "a sparse depth map (H, W) or points (N, 3) in the left camera's frame, metres"


@dataclass(frozen=True, eq=False)
class Inputs:
    """The checked user input for one left image, without that image."""

    left: Camera  # float64, without the size of the left image
    views: tuple[View, ...]  # right views of native size, on the CPU
    rigs: tuple[Rig, ...]  # their cameras in float64, for reports and exports
    points: Tensor | None  # float32 metres in the form of ``points_to_matches``
    unit: str | None = "m"
    shared_intrinsics: bool = False  # one K was given for all views, so all images must have one size
    mask: Any = None  # mask of the left image, in any form of ``as_mask``
    valid: Tensor | None = None  # (H, W) bool, of the left image, once it is known; None for all
    detects_borders: bool = True  # whether black borders of views without a mask are detected

    def with_left(self, left_01: Tensor) -> PosedViews:
        """Combine the left image, on any device, with its right views as read, on the CPU."""
        return PosedViews(View.single(left_01, self.left, np.eye(4), self.valid), self.views)

    def posed_views(self, left_01: Tensor) -> PosedViews:
        """Combine the left image with its right views on its device; cameras stay on the CPU, all float32."""
        device = left_01.device
        views = (view._replace(image_01=view.image_01.to(device, torch.float32)) for view in self.views)
        left, rights = self.with_left(left_01)._replace(rights=tuple(views))
        return PosedViews(_mask_on(left, device), tuple(_mask_on(view, device) for view in rights))

    def points_on(self, device: torch.device) -> Tensor | None:
        """Copy the known depths to a device as float32."""
        return None if self.points is None else self.points.to(device, torch.float32)

    def with_valid_pixels(self, left_01: Tensor, alpha: Tensor | None) -> tuple[Tensor, Inputs]:
        """Return the left image and the inputs with neutral content where pixels are not valid.

        ``alpha (H, W)`` bool states where the left image has an alpha above 0. Without a mask or alpha
        channel, constant borders are detected if ``detects_borders``. Both results are the same objects if
        every pixel is valid.
        """
        size = image_size(left_01)
        given = both(as_mask(self.mask, "mask", size), alpha)
        images = [left_01, *(view.image_01 for view in self.views)]
        masks = [given, *(view.valid for view in self.views)]
        (image_01, valid), *rights = neutral_views(images, masks, self.detects_borders)
        views = tuple(
            view if mask is None else view._replace(image_01=image, valid=mask)
            for view, (image, mask) in zip(self.views, rights, strict=True)
        )
        if valid is None and all(one is other for one, other in zip(views, self.views, strict=True)):
            return left_01, self
        return image_01, replace(self, views=views, valid=valid)


def _mask_on(view: View, device: torch.device) -> View:
    """Move the valid pixels of a view to a device."""
    return view if view.valid is None else view._replace(valid=view.valid.to(device))


@dataclass(frozen=True, eq=False)
class Arguments:
    """Arguments of ``GeometryGuidance`` in any of their forms, for all left images or for one."""

    right: Any
    K: Any
    E: Any
    points: Any
    points_confidence: Any
    mask: Any = None
    right_mask: Any = None

    def of_image(self, i: int, count: int) -> Arguments:
        """Return the arguments of image ``i`` out of ``count``."""
        return Arguments(**{name: _entry(value, name, i, count) for name, value in vars(self).items()})


def read_inputs(given: Arguments, *, cropped: bool = False, unit: str | None = "m") -> list[Inputs]:
    """Check the arguments and return one entry per left image."""
    right, points = given.right, given.points
    if right is None and points is None:
        bad_value("right", "an image, or None together with points", "None without points")
    if points is None and given.points_confidence is not None:
        bad_value("points_confidence", "passed together with points", "no points")
    lists = [x for x in (right, points) if isinstance(x, list) and not _is_nested_matrix(x)]
    count = len(lists[0]) if lists else 1
    if right is not None and not isinstance(right, list) and count == 1:
        # With one left image, a list of matrices can only mean one camera per view.
        given = replace(given, K=_as_views(given.K), E=_as_views(given.E))
    if count == 0:
        bad_value("right", "an image or a list with one image per left image", "an empty list")
    inputs = []
    for i in range(count):
        label = "{}" if count == 1 else f"{{}}[{i}]"
        inputs.append(_read_image(given.of_image(i, count), label, cropped, unit))
    _check_for_all("right", [bool(entry.views) for entry in inputs])
    _check_for_all("points", [entry.points is not None for entry in inputs])
    return inputs


def _check_for_all(name: str, given: list[bool]) -> None:
    """Raise an error for an argument that is given for some left images only."""
    if any(given) and not all(given):
        bad_value(name, "passed for every left image or for none", f"None for {given.index(False)}")


def _read_image(given: Arguments, label: str, cropped: bool, unit: str | None) -> Inputs:
    """Read the entry of one left image; ``label`` formats argument names for messages."""
    points: Tensor | None = None
    if given.points is not None:
        points = as_points(given.points, label.format("points"), given.points_confidence)
    several = given.right if isinstance(given.right, tuple) else (given.right,)
    rights = () if given.right is None else several
    count = len(rights)
    name = label.format("right")
    names = [name if count == 1 else f"{name}, view {v + 1}," for v in range(count)]
    images = [as_image_01(image, name) for image, name in zip(rights, names, strict=True)]
    valid = right_masks(given.right_mask, label.format("right_mask"), rights, images)
    K_name = label.format("K")
    shared = not isinstance(given.K, tuple)
    K_left, K_rights = _intrinsics(given.K, K_name, count)
    poses = _poses(given.E, label.format("E"), count, unit)
    left = Camera(K_left)
    rights_and_poses = zip(map(Camera, K_rights), poses, strict=True)
    rigs = tuple(Rig(left, camera, pose) for camera, pose in rights_and_poses)
    for v, (rig, image) in enumerate(zip(rigs, images, strict=True)):
        if not cropped:
            is_left = shared or np.array_equal(rig.K_right, K_left)
            named = K_name if is_left else f"{K_name}[{_view(v, count)}]"
            check_size_of(rig.K_right, image_size(image), named, "the right image")
        if isinstance(rights[v], Image.Image):
            warn_of_other_lens(rights[v], rig.K_right, names[v])
    views = tuple(
        View.single(image, rig.right, rig.T_right_from_left, mask)
        for image, rig, mask in zip(images, rigs, valid, strict=True)
    )
    if points is not None and unit == "m":
        warn_of_far_points(points.numpy(), label.format("points"))
    return Inputs(left, views, rigs, points, unit, shared, mask=given.mask)


def right_masks(value: Any, name: str, rights: tuple[Any, ...], images: list[Tensor]) -> list[Tensor | None]:
    """Return the valid pixels of each right image, from its mask and its alpha channel."""
    given = value if isinstance(value, tuple) else (value,) * len(images)
    if len(given) != len(images):
        bad_value(name, f"one mask, or a tuple of {len(images)}, one per right view", f"{len(given)}")
    masks = (as_mask(mask, name, image_size(image)) for mask, image in zip(given, images, strict=True))
    return [both(mask, alpha_mask(image)) for mask, image in zip(masks, rights, strict=True)]


def _is_nested_matrix(value: list[Any]) -> bool:
    """Return whether ``value`` is one matrix as nested lists, not a list with one entry per image."""
    rows = bool(value) and all(isinstance(row, (list, tuple)) for row in value)
    return rows and all(isinstance(entry, Real) for row in value for entry in row)


def _as_views(value: Any) -> Any:
    """Convert a list of matrices to a tuple with one per view."""
    several = isinstance(value, list) and len(value) > 1 and not _is_nested_matrix(value)
    return tuple(value) if several else value


def _entry(value: Any, name: str, i: int, count: int) -> Any:
    """Return the entry of image ``i``: a list has one per image, any other value applies to all."""
    if not isinstance(value, list) or _is_nested_matrix(value):
        return value
    if len(value) != count:
        bad_value(name, f"a list of {count} entries, one per left image", f"{len(value)} entries")
    return value[i]


def _view(v: int, views: int) -> str:
    return "right" if views == 1 else f"right view {v + 1}"


def _intrinsics(K: Any, name: str, views: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the K of the left image and of every right one."""
    if not isinstance(K, tuple):
        matrix = check_intrinsics(K, name)
        return matrix, [matrix] * views
    if len(K) != 1 + views:
        expected = f"a 3x3 matrix or a tuple (K_left, K_right{', ...' if views > 1 else ''}), left one first"
        bad_value(name, expected, f"a tuple of {len(K)}, with right views: {views}")
    rights = [check_intrinsics(matrix, f"{name}[{_view(v, views)}]") for v, matrix in enumerate(K[1:])]
    return check_intrinsics(K[0], f"{name}[left]"), rights


def _poses(E: Any, name: str, views: int, unit: str | None) -> list[np.ndarray]:
    """Return the pose of every right camera in the left camera's frame."""
    if views == 0:
        if E is not None:
            bad_value(name, "None without a right view", "a pose", "Points are in the left camera's frame.")
        return []
    if isinstance(E, tuple):
        if len(E) != 1 + views:
            expected = "a tuple (E_left, E_right, ...) of camera-to-world poses, left one first"
            hint = "Put np.eye(4) first, or pass several right views as a tuple: right=(right_1, right_2)."
            bad_value(name, expected, f"a tuple of {len(E)}, with right views: {views}", hint)
        to_left = np.linalg.inv(check_pose(E[0], f"{name}[left]"))
        poses = [to_left @ check_pose(pose, f"{name}[{_view(v, views)}]") for v, pose in enumerate(E[1:])]
    elif views > 1:
        bad_type(name, "a tuple (E_left, E_right, ...) of camera-to-world poses for several right views", E)
    else:
        poses = [check_pose(E, name)]
    for v, pose in enumerate(poses):
        named = name if views == 1 else f"{name}[{_view(v, views)}]"
        check_baseline(pose, named, unit)
    return poses


def as_points(value: Any, name: str, confidence: Any = None) -> Tensor:
    """Convert points to ``(N, 3)`` with finite rows, or to ``(H, W)`` with 0 for unknown, float32, metres.

    A ``confidence`` in [0, 1], ``(N,)`` or ``(H, W)``, becomes the last channel; 0 marks unknown depth.
    """
    array = _point_numbers(value, name)
    if array.shape[1] != 3 or not isinstance(value, (list, tuple)):  # a typed list is in metres
        check_metres(array, name)
    array, is_cloud = array.astype(np.float32), array.shape[1] == 3
    known = np.isfinite(array).all(1) if is_cloud else np.isfinite(array) & (array > 0)
    parts = [array]
    if confidence is not None:
        parts.append(_as_confidence(confidence, array, f"{name}_confidence"))
        known &= parts[1] > 0
    if not known.any():
        bad_value(name, f"{POINTS}, at least one of them known", "only 0, NaN or infinite values")
    if is_cloud:
        array = np.column_stack(parts)[known]
    else:
        array = np.stack([np.where(known, part, np.float32(0)) for part in parts], axis=-1)
        array = array if confidence is not None else array[..., 0]
    return torch.from_numpy(np.ascontiguousarray(array))


def _point_numbers(value: Any, name: str) -> np.ndarray:
    """Convert points ``(N, 3)`` or a map ``(H, W)`` to an array, keeping the number type."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value.float() if value.dtype == torch.bfloat16 else value).numpy()  # numpy has no bfloat16
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        bad_type(name, POINTS, value)
    if array.dtype.kind not in "fiu":
        bad_type(name, POINTS, value)
    if array.ndim != 2 or array.shape[1] < 3:
        bad_value(name, POINTS, f"shape {array.shape}")
    # Drop an intensity or colour. No image is only 4 or 6 pixels wide.
    return array[:, :3] if array.shape[1] in (4, 6) else array


def _as_confidence(value: Any, points: np.ndarray, name: str) -> np.ndarray:
    """Convert the confidence of points or a map to float32 in [0, 1], and non-finite values to 0."""
    shape = (len(points),) if points.shape[1] == 3 else points.shape
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value, dtype=np.float32)
    except (ValueError, TypeError):
        bad_type(name, f"numbers of shape {shape}", value)
    if array.shape != shape:
        bad_value(name, f"of shape {shape}, like the points", f"shape {array.shape}")
    array = np.where(np.isfinite(array), array, np.float32(0))
    # Rounding, for example of normalised values, may exceed 1.
    near_1 = (array > 1) & (array <= 1 + ROUNDING)
    array = np.where(near_1, np.float32(1), array)
    if array.min() < 0 or array.max() > 1:
        # str gives a float32 the fewest digits that identify it, so that 1.000002 is not shown as 1.
        low, high = (float(str(value)) for value in (array.min(), array.max()))
        hint = "Rescale it: 1 means a measured depth, 0 an unknown one."
        bad_value(name, "in [0, 1]", f"values from {low:.9g} to {high:.9g}", hint)
    return array


class SplitViews(NamedTuple):
    """Views of ``from_views``, the left one first, in the form of the constructor's arguments."""

    left_size: tuple[int, int] | None  # (width, height); ``None`` without a left image
    rights: tuple[Any, ...]
    Ks: tuple[Any, ...]  # of all views
    Es: tuple[Any, ...]


def split_views(views: Any, *, cropped: bool = False) -> SplitViews:
    """Split the views of ``from_views`` into constructor arguments and check the left view if possible."""
    form = "a list [(image, K, E), ...] with the left view first"
    if not isinstance(views, (list, tuple)):
        bad_type("views", form, views)
    if len(views) < 2:
        bad_value("views", f"{form}, at least two", str(len(views)), "A single image has no metric scale.")
    if not all(isinstance(view, (list, tuple)) and len(view) == 3 for view in views):
        kinds = [len(v) if isinstance(v, (list, tuple)) else type(v).__name__ for v in views]
        bad_value("views", form, f"{len(views)} entries of lengths {kinds}", "Pass three values per view.")
    images, Ks, Es = (tuple(column) for column in zip(*views, strict=True))
    if images[0] is None:
        return SplitViews(None, images[1:], Ks, Es)
    width, height = image_size_of(images[0], "the left view's image")
    K_left = check_intrinsics(Ks[0], "K[left]")
    if not cropped:
        check_intrinsics_fit(K_left, width, height, "K[left]", "the left view's image")
    if isinstance(images[0], Image.Image):
        warn_of_other_lens(images[0], K_left, "the left view's image")
    return SplitViews((width, height), images[1:], Ks, Es)


def left_alphas(image: Any) -> list[Tensor | None]:
    """Return ``alpha_mask`` of each left image."""
    return [alpha_mask(entry) for _, entry in _named(image, "image")]


def left_images(image: Any) -> Tensor:
    """Read left images as ``(N, 3, H, W)`` float32 in [0, 1], like right ones; also ``(H, W)`` or a batch."""
    named = list(_named(image, "image"))
    if not named:
        bad_value("image", "an image or a list of images", "an empty list or batch")
    tensors = [as_image_01(entry, name) for name, entry in named]
    size = tensors[0].shape
    for (name, _), tensor in zip(named, tensors, strict=True):
        if tensor.shape != size:
            expected = f"{size[2]}x{size[1]} pixels, like {named[0][0]}"
            got = f"{tensor.shape[2]}x{tensor.shape[1]}"
            bad_value(name, expected, got, "Use one call per image size.")
    return torch.stack(tensors) if len(tensors) > 1 else tensors[0][None]  # do not copy a single image


def _named(image: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield every image with its name for messages; names within a batch have an index."""
    several = isinstance(image, list)
    if isinstance(image, (np.ndarray, Tensor)):
        several = image.ndim == 4
        image = image[None] if isinstance(image, Tensor) and image.ndim == 2 else image
    if not several:
        yield name, image
        return
    for i, entry in enumerate(image):
        yield from _named(entry, f"{name}[{i}]")
