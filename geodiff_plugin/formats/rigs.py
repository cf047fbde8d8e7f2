"""Two cameras as a calibration file describes them, and ``make_rig``, which checks and builds."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from geodiff_plugin._camera_checks import check_intrinsics, check_pose
from geodiff_plugin._checks import bad_value, check_number, check_positive
from geodiff_plugin.geometry import nearest_rotation
from geodiff_plugin.types import Distortion, Rig

__all__ = [
    *("COEFFICIENT_COUNTS", "CalibrationFormat", "Camera", "CameraChoice", "RawRig", "array_of"),
    *("check_no_distortion", "intrinsics", "is_distorted", "make_rig", "names_of_pair", "number", "of_size"),
    *("projected", "rig_from_parameters", "rigid", "size_of", "two_cameras"),
]

Size = tuple[int, int]
Entry = TypeVar("Entry")

#: Coefficients below this move no pixel of a 12 megapixel image by a tenth of a pixel.
DISTORTION_TOLERANCE = 1e-6
#: How many coefficients OpenCV's functions take, by the model's name in ``Distortion``.
COEFFICIENT_COUNTS = {"opencv": (4, 5, 8, 12, 14), "fisheye": (4,)}
CHECK_FILE = "Check the calibration file."


@dataclass(frozen=True)
class CameraChoice:
    """Which two cameras of a file with more than two, and at which resolution.

    Attributes:
        cameras: numbers of the left and the right camera, or ``None`` to choose by the folder or the file.
        image_folder_hint: name or path of the left image's folder (or of the image), or ``None``.
        image_names: names or paths of the left and the right image, or ``None``.
        image_size: ``(width, height)`` of the left image, or ``None``; chooses among a file's resolutions.
    """

    cameras: tuple[int, int] | None = None
    image_folder_hint: str | None = None
    image_names: tuple[str, str] | None = None
    image_size: Size | None = None


@dataclass(frozen=True)
class Camera:
    """One camera as a file describes it; nothing is checked yet.

    Attributes:
        K: ``(3, 3)`` pixels, the centre of the first pixel at (0, 0).
        size: ``(width, height)`` that ``K`` is for, or ``None``.
        coefficients: of the lens, in OpenCV's order; empty for none.
        model: ``"opencv"``, ``"fisheye"``, or the file's name of a model that OpenCV does not have.
    """

    K: np.ndarray
    size: Any = None
    coefficients: Any = ()
    model: str = "opencv"


@dataclass(frozen=True)
class RawRig:
    """Two cameras as a file describes them.

    Attributes:
        left: the left camera.
        right: the right camera.
        pose: ``(4, 4)`` metres, the right camera's pose in the left camera's frame; or the baseline in
            metres of a right camera that stands to the right.
        rectified: whether the file says that its images are rectified.
        notes: sentences about what was assumed, for a warning each.
    """

    left: Camera
    right: Camera
    pose: Any
    rectified: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class CalibrationFormat:
    """One entry of ``CALIBRATION_FORMATS``.

    Attributes:
        summary: the format and its mark, for messages.
        matches: whether a text is of this format, given that no format before it in the table matches.
        read: ``(texts, choice) -> RawRig``. It may raise whatever a missing entry raises, which
            ``read_calibration`` turns into a sentence with the file's name.
        file_counts: how many files may describe one pair.
        uses_cameras: whether a file may hold more than two cameras, so that ``cameras`` has a meaning.
        has_unit: whether its lengths have a known unit (or are taken as metres); a warning says where not.
        by_image: whether it has a pose for each of many images, which are found by their names.
    """

    summary: str
    matches: Callable[[str], object]
    read: Callable[[tuple[str, ...], CameraChoice], RawRig]
    file_counts: tuple[int, ...] = (1,)
    uses_cameras: bool = False
    has_unit: bool = True
    by_image: bool = False


# What readers share. Each raises ValueError with the name of the entry.


def number(value: Any, name: str) -> float:
    """A finite number, as float; text of one is taken, a truth value is not."""
    try:
        result = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):  # a whole number of any length is JSON
        result = math.nan
    if not math.isfinite(result):
        bad_value(name, "a finite number", "none" if value is None else repr(value)[:80], CHECK_FILE)
    return result


def array_of(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Finite numbers as a float64 array; flat lists are brought to ``shape``, ``(-1,)`` takes any count."""
    count = math.prod(shape)
    expected = "numbers" if count < 0 else f"{count} numbers"
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        bad_value(name, f"{expected}, all finite", repr(value)[:80], CHECK_FILE)
    if count >= 0 and numbers.size != count:
        bad_value(name, expected, f"{numbers.size}", "Is the file cut off?")
    return numbers.reshape(shape)


def intrinsics(fx: Any, fy: Any, cx: Any, cy: Any) -> np.ndarray:
    """The ``(3, 3)`` float64 camera matrix of four numbers in pixels."""
    fx, fy, cx, cy = (number(value, name) for value, name in ((fx, "fx"), (fy, "fy"), (cx, "cx"), (cy, "cy")))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def size_of(entries: Mapping[str, Any], width: str = "width", height: str = "height") -> Any:
    """The raw ``(width, height)`` of a mapping; ``None`` where it has neither."""
    pair = entries.get(width), entries.get(height)
    return None if pair == (None, None) else pair


def rigid(matrix: Any, name: str) -> np.ndarray:
    """A ``(4, 4)`` float64 transform of 12 or 16 numbers, its rotation projected to the nearest one."""
    numbers = array_of(matrix, (-1,), name)
    shape = (3, 4) if numbers.size == 12 else (4, 4)
    matrix = array_of(numbers, shape, name)
    cure = "Check that rows and columns are not swapped and that no scale is multiplied in."
    T = check_pose(matrix, name, cure)
    T[:3, :3] = nearest_rotation(torch.from_numpy(matrix[:3, :3].copy())).numpy()  # in torch's last bit
    return T


def projected(P_left: Any, P_right: Any, size_left: Any = None, size_right: Any = None) -> RawRig:
    """The rig of two rectified ``(3, 4)`` projections ``K [I | t]`` that share one frame.

    A camera with ``K [I | t]`` has its centre at ``-t``, so the pose's translation is ``t_left - t_right``.
    """
    P = [array_of(values, (3, 4), f"the {side} projection") for side, values in _sides(P_left, P_right)]
    t_left, t_right = (
        np.linalg.solve(check_intrinsics(matrix[:, :3], f"K of the {side} camera"), matrix[:, 3])
        for side, matrix in _sides(*P)
    )
    E = np.eye(4)
    E[:3, 3] = t_left - t_right
    return RawRig(Camera(P[0][:, :3], size_left), Camera(P[1][:, :3], size_right), E, rectified=True)


def _sides(left: Any, right: Any) -> tuple[tuple[str, Any], tuple[str, Any]]:
    return ("left", left), ("right", right)


def of_size(by_size: Mapping[Size, Entry], choice: CameraChoice) -> Entry:
    """What a file has for images of ``choice.image_size``, or all that it has where that is one."""
    if choice.image_size is None and len(by_size) == 1:
        return next(iter(by_size.values()))
    if choice.image_size is None or choice.image_size not in by_size:
        sizes = ", ".join("{}x{}".format(*size) for size in sorted(by_size)) or "none"
        got = "no image" if choice.image_size is None else "{}x{}".format(*choice.image_size)
        cure = "A side-by-side image is two."
        bad_value("the left image", f"of one of the file's sizes ({sizes})", got, cure)
    return by_size[choice.image_size]


def two_cameras(choice: CameraChoice, available: Collection[int]) -> tuple[int, int]:
    """``choice.cameras``, which must be given, as two different ones of those that a file has."""
    left, right = choice.cameras or (0, 0)
    if left == right or not {left, right} <= set(available):
        have = ", ".join(map(str, sorted(available))) or "none"
        bad_value("cameras", f"two different cameras of the file ({have})", f"{left},{right}")
    return left, right


def names_of_pair(names: Collection[str], choice: CameraChoice) -> tuple[str, str]:
    """The names in a file of ``choice.image_names``.

    Names of the file may hold folders, and may lack the suffix. A path fits a name that it ends with, or that
    ends with it; of several the one with the most folders in common is taken.

    Raises:
        ValueError: no names, no such image, several that fit as well, or one image for both.
    """
    if choice.image_names is None:
        expected = "given for a calibration of many images, as ('left.jpg', 'right.jpg')"
        bad_value("image_names", expected, "none")
    left, right = (_named(names, wanted) for wanted in choice.image_names)
    if left == right:
        bad_value("the images", "two of those in the file", f"{left} for both", "Check their names.")
    return left, right


def _parts(name: str) -> tuple[str, ...]:
    # Files of Windows programs have backslashes; a step upwards says nothing about the name.
    return tuple(part for part in Path(name.replace("\\", "/")).parts if part != "..")


def _agreeing(name: str, wanted: str) -> int:
    """How many parts both paths have in common, if one of them ends the other; else 0."""
    ours, theirs = _parts(name), _parts(wanted)
    if ours and theirs and ours[-1] == Path(theirs[-1]).stem:  # NeRF's names have no suffix
        theirs = (*theirs[:-1], ours[-1])
    count = min(len(ours), len(theirs))
    return count if count and ours[-count:] == theirs[-count:] else 0


def _named(names: Collection[str], wanted: str) -> str:
    agreeing = {name: _agreeing(name, wanted) for name in names}
    most = max(agreeing.values(), default=0)
    fitting = sorted(name for name, count in agreeing.items() if count == most)
    if most == 0:
        some = ", ".join(sorted(names)[:3])
        expected = f"one of the {len(names)} in the file ({some}, ...)"
        bad_value("the image", expected, wanted, "Check its name.")
    if len(fitting) > 1:
        got = f"{wanted}, which may be {' and '.join(fitting[:2])}"
        bad_value("the image", "one image of the file", got, "Add its folder.")
    return fitting[0]


# From raw numbers to the rig.


def is_distorted(lens: Distortion | None) -> bool:
    """Whether a lens moves any pixel; a fisheye does with coefficients of zero as well."""
    if lens is None:
        return False
    return lens.model == "fisheye" or np.abs(lens.coefficients).max(initial=0.0) > DISTORTION_TOLERANCE


def _printed(lens: Distortion) -> str:
    numbers = np.array2string(lens.coefficients, precision=4, separator=", ")
    return f"fisheye {numbers}" if lens.model == "fisheye" else numbers


def check_no_distortion(lens: Distortion | None, name: str) -> None:
    """Refuse a lens that moves pixels: every formula here is of a pinhole camera."""
    if lens is not None and is_distorted(lens):
        cure = (
            "Undistort or rectify both images first and give the calibration of the result (P1, P2), "
            "or use geodiff depth, which undistorts them."
        )
        bad_value(name, "zero (images of a pinhole camera)", _printed(lens), cure)


def _lens(camera: Camera, side: str) -> Distortion | None:
    """The lens, or ``None`` where it moves no pixel."""
    counts = COEFFICIENT_COUNTS.get(camera.model)
    if counts is None:
        cure = "OpenCV does not have this model: undistort or rectify both images to a pinhole first."
        expected = f"one of {', '.join(COEFFICIENT_COUNTS)}"
        bad_value(f"the lens model of the {side} camera", expected, repr(camera.model), cure)
    name = f"Lens distortion of the {side} camera"
    lens = Distortion(camera.model, array_of(camera.coefficients, (-1,), name))
    if not is_distorted(lens):
        return None
    if lens.coefficients.size not in counts:
        expected = f"{', '.join(map(str, counts))} coefficients in OpenCV's order ({camera.model})"
        bad_value(name, expected, f"{lens.coefficients.size}: {_printed(lens)}", CHECK_FILE)
    return lens


def _pixels(size: Any, side: str) -> Size | None:
    if size is None:
        return None
    pair = []
    for name, value in zip(("width", "height"), size, strict=True):
        pixels = number(value, f"the {name} of the {side} image")
        if pixels < 1 or pixels % 1:
            expected = "a whole number of pixels above 0"
            bad_value(f"the {name} of the {side} image", expected, repr(value), CHECK_FILE)
        pair.append(int(pixels))
    return pair[0], pair[1]


def make_rig(raw: RawRig, source: str | Path) -> Rig:
    """A ``Rig`` of raw numbers: finite, in the right form, with whole pixels and lenses that OpenCV has.

    Args:
        raw: as a reader returns it.
        source: the file, for later messages.

    Raises:
        ValueError: what is wrong with which camera, or with the pose.
    """
    pose = raw.pose
    if np.ndim(pose) == 0:
        pose, baseline_m = np.eye(4), number(pose, "the baseline")
        if baseline_m <= 0:
            bad_value("the baseline", "above 0", baseline_m, CHECK_FILE)
        pose[0, 3] = baseline_m
    cameras = _sides(raw.left, raw.right)
    K_left, K_right = (check_intrinsics(camera.K, f"K of the {side} camera") for side, camera in cameras)
    size_left, size_right = (_pixels(camera.size, side) for side, camera in cameras)
    lens_left, lens_right = (_lens(camera, side) for side, camera in cameras)
    E = array_of(pose, (4, 4), "the pose")
    lenses = lens_left, lens_right
    return Rig(K_left, K_right, E, size_left, size_right, str(source), lenses, raw.rectified)


def rig_from_parameters(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    baseline_m: float,
    *,
    cx_right: float | None = None,
    size: Size | None = None,
) -> Rig:
    """A rectified rig from the numbers that a data sheet gives.

    ``fx``, ``fy``, ``cx``, ``cy`` are in pixels, the centre of the first pixel at 0, of both images; the
    right one has ``cx_right`` where that is given (``doffs``). The right camera stands ``baseline_m``
    metres to the right. ``size`` is the ``(width, height)`` that these belong to, where known.

    Raises:
        TypeError, ValueError: not finite numbers, or not above 0 where they must be.
    """
    cx_right = cx if cx_right is None else cx_right
    for name, value, unit in (("fx", fx, "pixels"), ("fy", fy, "pixels"), ("baseline", baseline_m, "metres")):
        check_positive(value, name, unit)
    for name, value in (("cx", cx), ("cy", cy), ("cx_right", cx_right)):
        check_number(value, name, -1e9, 1e9)
    left, right = (Camera(intrinsics(fx, fy, x, cy), size) for x in (cx, cx_right))
    return make_rig(RawRig(left, right, float(baseline_m)), "arguments")
