"""Describes two cameras of a calibration file; ``make_rig`` checks them and builds a ``Rig``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import PurePath
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.camera_checks import check_intrinsics, check_pose
from geodiff_plugin._internal.checks import (
    NEGATIVE_BASELINE,
    InputError,
    InputFileError,
    bad_value,
    check_baseline_m,
    check_number,
    check_positive,
    raise_input_error,
)
from geodiff_plugin.cameras import Camera, Distortion, Size
from geodiff_plugin.types import Rig

Entry = TypeVar("Entry")

#: Coefficients below this value displace no pixel of a 12 megapixel image by a tenth of a pixel.
DISTORTION_TOLERANCE = 1e-6
#: Relative tolerance of aspect ratios: rounding stays below it, cropping exceeds it.
RATIO_TOLERANCE = 0.01
#: Names of OpenCV's lens models in files, in lower case -> name of the model in ``Distortion``.
LENS_MODELS = {
    **{"": "opencv", "cameratype 0": "opencv", "cameratype 1": "fisheye"},
    **dict.fromkeys("opencv pinhole simple_pinhole none brownconrady".split(), "opencv"),
    **dict.fromkeys("full_opencv simple_radial radial perspective".split(), "opencv"),
    **dict.fromkeys(
        "radtan radial-tangential radial_tangential radialtangential radialtangential8".split(), "opencv"
    ),
    **dict.fromkeys("plumb_bob rational_polynomial".split(), "opencv"),
    **dict.fromkeys("fisheye opencv_fisheye equidistant kannalabrandt4 kannalabrandt8".split(), "fisheye"),
    **dict.fromkeys("simple_fisheye simple_radial_fisheye radial_fisheye".split(), "fisheye"),
}
COEFFICIENT_COUNTS = {"opencv": (4, 5, 8, 12, 14), "fisheye": (4,)}
#: COLMAP models that OpenCV lacks, with their number of coefficients; undistorted with pycolmap.
COLMAP_LENSES = {
    "FOV": 1,
    "THIN_PRISM_FISHEYE": 8,
    "RAD_TAN_THIN_PRISM_FISHEYE": 12,
    "SIMPLE_DIVISION": 1,
    "DIVISION": 1,
    "EUCM": 2,
}
CHECK_FILE = "Check the calibration file."


@dataclass(frozen=True)
class CameraChoice:
    """Selects two cameras of a file with more than two, and the resolution; see ``read_calibration``.

    With ``is_alone``, only the left camera is used, for a left image without a second view.
    """

    cameras: tuple[int, int] | None = None
    image_folder_hint: str | None = None
    image_names: tuple[str, str] | None = None
    image_size: Size | None = None
    baseline_m: float | None = None
    is_alone: bool = False


@dataclass(frozen=True)
class RawCamera:
    """One camera as described by a file, in numbers or text; the centre of the first pixel is at (0, 0).

    ``K`` is ``None`` if unknown. ``coefficients`` of the lens are in OpenCV's order; ``model`` is its name in
    the file.
    """

    K: Any
    size: Any = None
    coefficients: Any = ()
    model: str = "opencv"


@dataclass(frozen=True)
class CalibrationFormat:
    """One entry of ``CALIBRATION_FORMATS``; ``summary`` names it in messages.

    ``mark`` is a regular expression that matches its texts, and no text of earlier formats; ``^`` matches at
    line starts. ``read`` builds the rig with ``make_rig``, and may raise any error of a missing entry.
    ``file_counts`` is the allowed number of files; for a left image alone one is enough if ``one_is_enough``.
    Files may have more than two cameras (``uses_cameras``), a pose without a known unit per image
    (``by_image``), or cameras of the pixels as stored, before EXIF orientation (``as_stored``).
    ``companions`` returns the names of further files in the same folder, whose texts ``read`` takes too.
    """

    summary: str
    mark: str
    read: Callable[[tuple[str, ...], CameraChoice], Rig]
    file_counts: tuple[int, ...] = (1,)
    uses_cameras: bool = False
    by_image: bool = False
    as_stored: bool = False
    one_is_enough: bool = False
    companions: Callable[[str], list[str]] | None = None


def is_cut_off(text: str) -> bool:
    """Whether a text is truncated: a bracket or the last line is not closed."""
    opened = sum(text.count(bracket) for bracket in "[{")
    closed = sum(text.count(bracket) for bracket in "]}")
    unfinished = "\n" in text and not text.endswith(("\n", "}", "]", ">"))
    return opened > closed or unfinished


def _ended_early(error: Exception) -> bool:
    """Whether an error indicates a truncated text."""
    if isinstance(error, json.JSONDecodeError):
        return error.pos >= len(error.doc.rstrip())
    return isinstance(
        error, (yaml.MarkedYAMLError, EOFError, ElementTree.ParseError)
    )  # other errors state the cause


@contextmanager
def reading_file(
    source: object, summary: str, *texts: str, hint: str = "Check that it is the correct kind of file."
) -> Iterator[None]:
    """Convert any error of reading files inside the block to a message with their names.

    The hint asks about truncation only if one of ``texts`` is truncated.
    """
    try:
        yield
    except InputFileError:
        raise
    except InputError as error:
        raise_input_error(f"{source}: {error}", code=error.code)
    except Exception as error:  # any error that a damaged file may cause
        got = str(error) if isinstance(error, ValueError) else "other entries"
        got = f"no {error}" if isinstance(error, KeyError) else got
        cut = _ended_early(error) or any(map(is_cut_off, texts))
        hint = "The file seems truncated." if cut else hint
        misses_baseline = isinstance(error, KeyError) and error.args == ("baseline",) and not cut
        code = "calibration.no-baseline" if misses_baseline else ""
        bad_value(str(source), f"a whole {summary}", got, hint, code=code)


def array_of(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Convert numbers or their text to a finite float64 array of ``shape``; ``(-1,)``: any count."""
    count = math.prod(shape)
    expected = {1: "a finite number"}.get(count, f"{count} finite numbers" if count > 0 else "finite numbers")
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # JSON allows integers of any length
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        bad_value(name, expected, repr(value), CHECK_FILE)
    if count >= 0 and numbers.size != count:
        bad_value(name, expected, f"{numbers.size}", CHECK_FILE)
    return numbers.reshape(shape)


def intrinsics(fx: Any, fy: Any, cx: Any, cy: Any) -> np.ndarray:
    """Return the ``(3, 3)`` float64 camera matrix of four numbers in pixels."""
    fx, fy, cx, cy = array_of((fx, fy, cx, cy), (4,), "fx, fy, cx, cy")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def rigid(matrix: Any, name: str) -> np.ndarray:
    """Return a ``(4, 4)`` float64 transform of 12 or 16 numbers, with the nearest rotation."""
    numbers = array_of(matrix, (-1,), name)
    matrix = array_of(numbers, (3, 4) if numbers.size == 12 else (4, 4), name)
    return check_pose(matrix, name, "Check for swapped rows and columns, or a scale factor.")


def transform(rotation: Any, translation: Any, name: str) -> np.ndarray:
    """Return the ``(4, 4)`` float64 transform of a rotation (9 numbers, row-major) and a translation."""
    R = array_of(rotation, (3, 3), f"the rotation of {name}")
    return rigid(np.column_stack([R, array_of(translation, (3,), f"the translation of {name}")]), name)


def pose_of(turn: Rotation, place: Any) -> np.ndarray:
    """Return the ``(4, 4)`` pose of a rotation and a position."""
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = turn.as_matrix(), array_of(place, (3,), "a place")
    return E


def central_camera(fx: float, fy: float, size: Size, coefficients: tuple[float, ...] = ()) -> RawCamera:
    """Return a camera with its principal point at the image centre."""
    return RawCamera(intrinsics(fx, fy, (size[0] - 1) / 2, (size[1] - 1) / 2), size, coefficients)


def resized(camera: RawCamera, size: Size, name: str, hint: str) -> RawCamera:
    """Return the camera at another resolution of the whole image; raise with ``name`` if it is a crop."""
    width, height = camera.size or size
    if abs(size[0] / width / (size[1] / height) - 1) > RATIO_TOLERANCE:
        expected = f"of the aspect ratio of its camera's images ({width}x{height})"
        bad_value(name, expected, "{}x{}".format(*size), hint, code="calibration.size")
    K = Camera(array_of(camera.K, (3, 3), f"K of {name}"), (width, height)).resized(size).K
    return replace(camera, K=K, size=size)


def of_size(by_size: Mapping[Size, Entry], choice: CameraChoice) -> Entry:
    """Return the entry for images of ``choice.image_size``, or the only entry."""
    size = choice.image_size
    size = next(iter(by_size)) if size is None and len(by_size) == 1 else size
    if size is None or size not in by_size:
        sizes = ", ".join("{}x{}".format(*size) for size in sorted(by_size)) or "none"
        got = "no image" if size is None else "{}x{}. A side-by-side image contains two images".format(*size)
        bad_value("the left image", f"of a size in the file ({sizes})", got, code="calibration.size")
    return by_size[size]


def two_cameras(
    choice: CameraChoice, available: Collection[int], default: tuple[int, int]
) -> tuple[int, int]:
    """Return ``choice.cameras``, or the default, as two different cameras of the file."""
    if len(available) == 1:
        hint = "Pass the stereo calibration, which has the pose of one camera relative to the other."
        expected = "a calibration of two cameras"
        bad_value("the file", expected, "one camera", hint, code="calibration.one-camera")
    left, right = choice.cameras or default
    if left == right or not {left, right} <= set(available):
        have = ", ".join(map(str, sorted(available))) or "none"
        bad_value("cameras", f"two different cameras of the file ({have})", f"{left},{right}")
    return left, right


def names_of_pair(names: Collection[str], choice: CameraChoice) -> tuple[str, str]:
    """Return the names of both images in a file; given names may omit folders or the suffix."""
    if choice.image_names is None:
        bad_value(
            "image_names", "specified for a file of many images, such as ('left.jpg', 'right.jpg')", "none"
        )
    numbers = []
    for wanted in choice.image_names:
        in_common = {name: _parts_in_common(name, str(wanted)) for name in names}
        longest = max(in_common.values(), default=0)
        fitting = sorted(name for name, count in in_common.items() if count == longest)
        if longest == 0:
            expected = f"one of the {len(names)} in the file ({', '.join(sorted(names)[:3])}, ...)"
            bad_value("the image", expected, wanted, "Check its name.")
        if len(fitting) > 1:
            got = f"{wanted}, which may be {' and '.join(fitting[:2])}"
            bad_value("the image", "one image of the file", got, "Include its folder.")
        numbers += fitting
    if numbers[0] == numbers[1]:
        bad_value("the images", "two images of the file", f"{numbers[0]} for both", "Check their names.")
    return numbers[0], numbers[1]


def _parts_in_common(name: str, wanted: str) -> int:
    """Return the number of parts that both paths share, if one is a suffix of the other; otherwise 0."""
    # Files of Windows programs have backslashes; ".." is not part of the name.
    paths = (PurePath(text.replace("\\", "/")).parts for text in (name, wanted))
    ours, theirs = ([part for part in parts if part != ".."] for parts in paths)
    if ours and theirs and ours[-1] == PurePath(theirs[-1]).stem:  # NeRF's names have no suffix
        theirs[-1] = ours[-1]
    count = min(len(ours), len(theirs))
    return count if ours[len(ours) - count :] == theirs[len(theirs) - count :] else 0


def is_distorted(lens: Distortion | None) -> bool:
    """Whether a lens displaces any pixel; some models do so even with zero coefficients."""
    if lens is None:
        return False
    return lens.model != "opencv" or np.abs(lens.coefficients).max(initial=0.0) > DISTORTION_TOLERANCE


def lens_of(camera: RawCamera, name: str) -> Distortion | None:
    """Return the lens of a camera, ``None`` without distortion; errors use ``name``."""
    if camera.model in COLMAP_LENSES:
        return _colmap_lens(camera, name)
    model = LENS_MODELS.get(camera.model.lower(), "")
    if not model:
        hint = "OpenCV lacks this model. Undistort or rectify both images first."
        bad_value(f"the lens model of {name}", "opencv or fisheye", camera.model, hint)
    numbers = array_of(camera.coefficients, (-1,), f"the lens distortion of {name}")
    if model == "fisheye" and not numbers[4:].any():  # lists may be padded with zeros
        numbers = numbers[:4]
    lens = Distortion(model, numbers)
    if not is_distorted(lens):
        return None
    counts = COEFFICIENT_COUNTS[model]
    if numbers.size not in counts:
        expected = f"{', '.join(map(str, counts))} coefficients in OpenCV's order ({model})"
        bad_value(f"the lens distortion of {name}", expected, numbers.tolist(), CHECK_FILE)
    return lens


def _colmap_lens(camera: RawCamera, name: str) -> Distortion:
    """Return the lens of a model that only pycolmap supports."""
    if find_spec("pycolmap") is None:
        hint = "Run: pip install pycolmap, or undistort the images first (colmap image_undistorter)."
        bad_value(f"the lens model of {name}", "opencv or fisheye without pycolmap", camera.model, hint)
    count = COLMAP_LENSES[camera.model]
    return Distortion(camera.model, array_of(camera.coefficients, (count,), f"the lens distortion of {name}"))


def _pixels(size: Any, name: str) -> Size | None:
    if size is None or all(side is None for side in size):
        return None
    width, height = array_of(size, (2,), f"the width and height of {name}")
    if min(width, height) < 1 or width % 1 or height % 1:
        bad_value(f"the width and height of {name}", "whole numbers of pixels", list(size), CHECK_FILE)
    return int(width), int(height)


def make_rig(left: RawCamera, right: RawCamera, pose: Any, *, rectified: bool = False) -> Rig:
    """Build a checked ``Rig``: finite numbers, valid shapes, integer pixel sizes, supported lenses.

    ``pose`` is the right camera's pose in the left camera's frame, ``(4, 4)`` metres, or the baseline of a
    camera to the right. ``rectified`` images have no lens distortion.
    """
    E = np.eye(4)
    if np.ndim(pose) == 0:
        E[0, 3] = array_of(pose, (), "the baseline")
        if E[0, 3] <= 0:
            hint = NEGATIVE_BASELINE if E[0, 3] < 0 else CHECK_FILE
            bad_value("the baseline", "positive", E[0, 3], hint, code="baseline.sign")
    else:
        E = array_of(pose, (4, 4), "the pose")
    made_left, made_right = _made(left, "the left camera"), _made(right, "the right camera")
    rectified = rectified and made_left.lens is made_right.lens is None
    return Rig(made_left, made_right, E, rectified=rectified)


def _made(camera: RawCamera, name: str) -> Camera:
    """Check the values of a camera; errors use ``name``."""
    K = check_intrinsics(array_of(camera.K, (3, 3), f"K of {name}"), f"K of {name}")
    return Camera(K, _pixels(camera.size, name), lens_of(camera, name))


def projected(P_left: Any, P_right: Any, size_left: Any = None, size_right: Any = None) -> Rig:
    """Return the rig of two rectified ``(3, 4)`` projections ``K [I | t]``, whose centres are ``-t``."""
    cameras, places = [], []
    for side, values, size in (("left", P_left, size_left), ("right", P_right, size_right)):
        P = array_of(values, (3, 4), f"the {side} projection")
        cameras.append(RawCamera(check_intrinsics(P[:, :3], f"K of the {side} camera"), size))
        places.append(np.linalg.solve(P[:, :3], P[:, 3:]))
    E = np.vstack([np.hstack([np.eye(3), places[0] - places[1]]), (0, 0, 0, 1)])
    return make_rig(cameras[0], cameras[1], E, rectified=True)


def in_units(rig: Rig, units: float) -> Rig:
    """Convert a rig in a unit with ``units`` per metre to metres."""
    E = rig.E.copy()
    E[:3, 3] /= units
    return replace(rig, E=E, as_taken=None if rig.as_taken is None else in_units(rig.as_taken, units))


def with_baseline(rig: Rig, baseline_m: float) -> Rig:
    """Scale a rig to the measured distance between its cameras, in metres."""
    check_number(baseline_m, "baseline_m", float(np.finfo(np.float64).tiny), 1e9)
    length = float(np.linalg.norm(rig.E[:3, 3]))
    if length == 0:
        hint = "Both its cameras have the same position."
        bad_value("baseline_m", f"omitted for {rig.source}", baseline_m, hint)
    return replace(in_units(rig, length / baseline_m), measured=True)


def rectified_from(rig: Rig, left: RawCamera, right: RawCamera, turns: tuple[Any, Any]) -> Rig:
    """Return a rectified rig with its original cameras, given the rectifying rotations."""
    R_left, R_right = (transform(R, (0, 0, 0), "the rectifying rotation") for R in turns)
    return replace(rig, as_taken=make_rig(left, right, np.linalg.inv(R_left) @ rig.E @ R_right))


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
    """Build a rectified rig from the numbers of a data sheet.

    ``fx fy cx cy`` are in pixels of both images, with the centre of the first pixel at 0; ``cx_right`` is the
    right one's (``doffs``). The right camera is ``baseline_m`` metres to the right. ``size`` is (width,
    height). Raises ``TypeError`` or ``ValueError`` for numbers that are not finite, or not positive where
    required.
    """
    check_positive(fx, "fx", "pixels")
    check_positive(fy, "fy", "pixels")
    check_baseline_m(baseline_m, "baseline")
    columns = (cx, cx if cx_right is None else cx_right)
    left, right = (RawCamera(intrinsics(fx, fy, x, cy), size) for x in columns)
    return make_rig(left, right, baseline_m)
