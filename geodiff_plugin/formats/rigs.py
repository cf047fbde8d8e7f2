"""Two cameras as a calibration file describes them, and ``make_rig``, which checks and builds."""

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

from geodiff_plugin._camera_checks import check_intrinsics, check_pose
from geodiff_plugin._checks import InputError, InputFileError, bad_value, check_positive, refuse
from geodiff_plugin.types import Distortion, Rig

Size = tuple[int, int]
Entry = TypeVar("Entry")

#: Coefficients below this move no pixel of a 12 megapixel image by a tenth of a pixel.
DISTORTION_TOLERANCE = 1e-6
#: Images of one sensor differ in their ratio of sides by rounding only; beyond this one of them was cropped.
RATIO_TOLERANCE = 0.01
#: What files call the lenses that OpenCV has, in small letters -> the model's name in ``Distortion``.
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
#: Models of COLMAP that OpenCV does not have, and how many coefficients each has; pycolmap removes them.
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
    """Which two cameras of a file with more than two, and at which resolution; as in ``read_calibration``."""

    cameras: tuple[int, int] | None = None
    image_folder_hint: str | None = None
    image_names: tuple[str, str] | None = None
    image_size: Size | None = None
    baseline_m: float | None = None


@dataclass(frozen=True)
class Camera:
    """One camera as a file describes it, in numbers or text; the first pixel's centre is at (0, 0).

    ``coefficients`` of the lens are in OpenCV's order; ``model`` is what the file calls it.
    """

    K: Any
    size: Any = None
    coefficients: Any = ()
    model: str = "opencv"


@dataclass(frozen=True)
class CalibrationFormat:
    """One entry of ``CALIBRATION_FORMATS``; ``summary`` names it in messages.

    ``mark`` is a regular expression that its texts have, and none of a format before it; ``^`` begins a line.
    ``read`` makes the rig of the texts by ``make_rig``, and may raise whatever a missing entry raises. Files
    may be as many as ``file_counts`` says, hold more than two cameras (``uses_cameras``), or a pose in no
    known unit for each of many images (``by_image``), or cameras of the pixels as image files store them, not
    as EXIF turns them (``as_stored``). ``beside`` gives the names of files in the folder of the one that was
    given, whose texts ``read`` takes too.
    """

    summary: str
    mark: str
    read: Callable[[tuple[str, ...], CameraChoice], Rig]
    file_counts: tuple[int, ...] = (1,)
    uses_cameras: bool = False
    by_image: bool = False
    as_stored: bool = False
    beside: Callable[[str], list[str]] | None = None


def is_cut_off(text: str) -> bool:
    """Whether a text ends in the middle: a bracket or the last line is not closed."""
    opened = sum(text.count(bracket) for bracket in "[{")
    closed = sum(text.count(bracket) for bracket in "]}")
    unfinished = "\n" in text and not text.endswith(("\n", "}", "]", ">"))
    return opened > closed or unfinished


def _ended_early(error: Exception) -> bool:
    """Whether a text ended before what was read of it did."""
    if isinstance(error, json.JSONDecodeError):
        return error.pos >= len(error.doc.rstrip())
    return isinstance(error, (yaml.MarkedYAMLError, EOFError, ElementTree.ParseError))  # others are named


@contextmanager
def reading_whole(
    source: object, summary: str, *texts: str, cure: str = "Is it of another program?"
) -> Iterator[None]:
    """Whatever is wrong in the files that are read inside becomes a sentence with their names.

    Only where one of their ``texts`` ends in the middle the sentence asks whether it was cut off.
    """
    try:
        yield
    except InputFileError:
        raise
    except InputError as error:
        refuse(f"{source}: {error}")
    except Exception as error:  # of any kind that a damaged file leads to
        got = str(error) if isinstance(error, ValueError) else "other entries"
        got = f"no {error}" if isinstance(error, KeyError) else got
        cut = _ended_early(error) or any(map(is_cut_off, texts))
        bad_value(str(source), f"a whole {summary}", got, "Is the file cut off?" if cut else cure)


def array_of(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Finite numbers, or text of them, as a float64 array of ``shape``; ``(-1,)`` takes any count."""
    count = math.prod(shape)
    expected = {1: "a finite number"}.get(count, f"{count} finite numbers" if count > 0 else "finite numbers")
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # a whole number of any length is JSON
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        bad_value(name, expected, repr(value), CHECK_FILE)
    if count >= 0 and numbers.size != count:
        bad_value(name, expected, f"{numbers.size}", CHECK_FILE)
    return numbers.reshape(shape)


def intrinsics(fx: Any, fy: Any, cx: Any, cy: Any) -> np.ndarray:
    """The ``(3, 3)`` float64 camera matrix of four numbers in pixels."""
    fx, fy, cx, cy = array_of((fx, fy, cx, cy), (4,), "fx, fy, cx, cy")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def rigid(matrix: Any, name: str) -> np.ndarray:
    """A ``(4, 4)`` float64 transform of 12 or 16 numbers, its rotation projected to the nearest one."""
    numbers = array_of(matrix, (-1,), name)
    matrix = array_of(numbers, (3, 4) if numbers.size == 12 else (4, 4), name)
    return check_pose(matrix, name, "Are rows and columns swapped, or is a scale multiplied in?")


def transform(rotation: Any, translation: Any, name: str) -> np.ndarray:
    """The ``(4, 4)`` float64 rigid transform of a rotation of 9 numbers, row by row, and a translation."""
    R = array_of(rotation, (3, 3), f"the rotation of {name}")
    return rigid(np.column_stack([R, array_of(translation, (3,), f"the translation of {name}")]), name)


def pose_of(turn: Rotation, place: Any) -> np.ndarray:
    """The ``(4, 4)`` pose of a rotation and a place."""
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = turn.as_matrix(), array_of(place, (3,), "a place")
    return E


def central_camera(fx: float, fy: float, size: Size, coefficients: tuple[float, ...] = ()) -> Camera:
    """A camera whose principal point is the middle of its image."""
    return Camera(intrinsics(fx, fy, (size[0] - 1) / 2, (size[1] - 1) / 2), size, coefficients)


def resized(camera: Camera, size: Size, name: str, cure: str) -> Camera:
    """The camera at another resolution of the whole image, which messages name; a crop is refused."""
    width, height = camera.size or size
    s_x, s_y = size[0] / width, size[1] / height
    if abs(s_x / s_y - 1) > RATIO_TOLERANCE:
        expected = f"of the shape of its camera's images ({width}x{height})"
        bad_value(name, expected, "{}x{}".format(*size), cure)
    scale = np.array([[s_x, 0, 0.5 * s_x - 0.5], [0, s_y, 0.5 * s_y - 0.5], [0, 0, 1]])
    return replace(camera, K=scale @ camera.K, size=size)


def of_size(by_size: Mapping[Size, Entry], choice: CameraChoice) -> Entry:
    """What a file has for images of ``choice.image_size``, or all that it has where that is one."""
    size = choice.image_size
    size = next(iter(by_size)) if size is None and len(by_size) == 1 else size
    if size is None or size not in by_size:
        sizes = ", ".join("{}x{}".format(*size) for size in sorted(by_size)) or "none"
        got = "no image" if size is None else "{}x{}. A side-by-side image is two".format(*size)
        bad_value("the left image", f"of one of the file's sizes ({sizes})", got)
    return by_size[size]


def two_cameras(
    choice: CameraChoice, available: Collection[int], default: tuple[int, int]
) -> tuple[int, int]:
    """``choice.cameras``, else the default, as two different ones of those that a file has."""
    if len(available) == 1:
        cure = "Give the stereo calibration, in which one camera's pose is given beside the other's."
        bad_value("the file", "of two cameras", "one of one camera", cure)
    left, right = choice.cameras or default
    if left == right or not {left, right} <= set(available):
        have = ", ".join(map(str, sorted(available))) or "none"
        bad_value("cameras", f"two different cameras of the file ({have})", f"{left},{right}")
    return left, right


def names_of_pair(names: Collection[str], choice: CameraChoice) -> tuple[str, str]:
    """The names in a file of both images; they and the paths may lack folders, or a suffix."""
    if choice.image_names is None:
        bad_value("image_names", "given, as ('left.jpg', 'right.jpg'), for a file of many images", "none")
    numbers = []
    for wanted in choice.image_names:
        in_common = {name: _parts_in_common(name, str(wanted)) for name in names}
        most = max(in_common.values(), default=0)
        fitting = sorted(name for name, count in in_common.items() if count == most)
        if most == 0:
            expected = f"one of the {len(names)} in the file ({', '.join(sorted(names)[:3])}, ...)"
            bad_value("the image", expected, wanted, "Check its name.")
        if len(fitting) > 1:
            got = f"{wanted}, which may be {' and '.join(fitting[:2])}"
            bad_value("the image", "one image of the file", got, "Add its folder.")
        numbers += fitting
    if numbers[0] == numbers[1]:
        bad_value("the images", "two of those in the file", f"{numbers[0]} for both", "Check their names.")
    return numbers[0], numbers[1]


def _parts_in_common(name: str, wanted: str) -> int:
    """How many parts both paths have in common, if one of them ends the other; else 0."""
    # Files of Windows programs have backslashes; a step upwards says nothing about the name.
    paths = (PurePath(text.replace("\\", "/")).parts for text in (name, wanted))
    ours, theirs = ([part for part in parts if part != ".."] for parts in paths)
    if ours and theirs and ours[-1] == PurePath(theirs[-1]).stem:  # NeRF's names have no suffix
        theirs[-1] = ours[-1]
    count = min(len(ours), len(theirs))
    return count if ours[len(ours) - count :] == theirs[len(theirs) - count :] else 0


def is_distorted(lens: Distortion | None) -> bool:
    """Whether a lens moves any pixel; others than OpenCV's first do with coefficients of zero as well."""
    if lens is None:
        return False
    return lens.model != "opencv" or np.abs(lens.coefficients).max(initial=0.0) > DISTORTION_TOLERANCE


def lens_of(camera: Camera, name: str) -> Distortion | None:
    """The lens of a camera, which messages name; ``None`` where it moves no pixel."""
    if camera.model in COLMAP_LENSES:
        return _colmap_lens(camera, name)
    model = LENS_MODELS.get(camera.model.lower(), "")
    if not model:
        cure = "OpenCV does not have this model: undistort or rectify both images to a pinhole first."
        bad_value(f"the lens model of {name}", "opencv or fisheye", camera.model, cure)
    numbers = array_of(camera.coefficients, (-1,), f"the lens distortion of {name}")
    if model == "fisheye" and not numbers[4:].any():  # lists may be filled up with zeros
        numbers = numbers[:4]
    lens = Distortion(model, numbers)
    if not is_distorted(lens):
        return None
    counts = COEFFICIENT_COUNTS[model]
    if numbers.size not in counts:
        expected = f"{', '.join(map(str, counts))} coefficients in OpenCV's order ({model})"
        bad_value(f"the lens distortion of {name}", expected, numbers.tolist(), CHECK_FILE)
    return lens


def _colmap_lens(camera: Camera, name: str) -> Distortion:
    """The lens of a model that only pycolmap has."""
    if find_spec("pycolmap") is None:
        cure = "Run: pip install pycolmap, or undistort the images first (colmap image_undistorter)."
        bad_value(f"the lens model of {name}", "opencv or fisheye without pycolmap", camera.model, cure)
    count = COLMAP_LENSES[camera.model]
    return Distortion(camera.model, array_of(camera.coefficients, (count,), f"the lens distortion of {name}"))


def _pixels(size: Any, name: str) -> Size | None:
    if size is None or all(side is None for side in size):
        return None
    width, height = array_of(size, (2,), f"the width and height of {name}")
    if min(width, height) < 1 or width % 1 or height % 1:
        bad_value(f"the width and height of {name}", "whole numbers of pixels", list(size), CHECK_FILE)
    return int(width), int(height)


def make_rig(left: Camera, right: Camera, pose: Any, *, rectified: bool = False) -> Rig:
    """A ``Rig`` of raw numbers: finite, in the right form, with whole pixels and lenses that OpenCV has.

    ``pose`` is the right camera's in the left camera's frame, ``(4, 4)`` metres, or the baseline of a right
    camera that stands to the right. ``rectified`` images have no lens distortion.
    """
    E = np.eye(4)
    if np.ndim(pose) == 0:
        E[0, 3] = array_of(pose, (), "the baseline")
        if E[0, 3] <= 0:
            bad_value("the baseline", "above 0", E[0, 3], CHECK_FILE)
    else:
        E = array_of(pose, (4, 4), "the pose")
    cameras = (("the left camera", left), ("the right camera", right))
    Ks = [check_intrinsics(array_of(c.K, (3, 3), f"K of {name}"), f"K of {name}") for name, c in cameras]
    sizes = [_pixels(camera.size, name) for name, camera in cameras]
    left_lens, right_lens = (lens_of(camera, name) for name, camera in cameras)
    rectified = rectified and left_lens is right_lens is None
    lenses = (left_lens, right_lens)
    return Rig(Ks[0], Ks[1], E, sizes[0], sizes[1], distortion=lenses, rectified=rectified)


def projected(P_left: Any, P_right: Any, size_left: Any = None, size_right: Any = None) -> Rig:
    """The rig of two rectified ``(3, 4)`` projections ``K [I | t]``, whose centres are ``-t``."""
    cameras, places = [], []
    for side, values, size in (("left", P_left, size_left), ("right", P_right, size_right)):
        P = array_of(values, (3, 4), f"the {side} projection")
        cameras.append(Camera(check_intrinsics(P[:, :3], f"K of the {side} camera"), size))
        places.append(np.linalg.solve(P[:, :3], P[:, 3:]))
    E = np.vstack([np.hstack([np.eye(3), places[0] - places[1]]), (0, 0, 0, 1)])
    return make_rig(cameras[0], cameras[1], E, rectified=True)


def in_units(rig: Rig, units: float) -> Rig:
    """The rig in metres, of one in a unit of which a metre has ``units``."""
    E = rig.E.copy()
    E[:3, 3] /= units
    return replace(rig, E=E, as_taken=None if rig.as_taken is None else in_units(rig.as_taken, units))


def rectified_from(rig: Rig, left: Camera, right: Camera, turns: tuple[Any, Any]) -> Rig:
    """A rectified rig with the cameras that it was made from, by the rotations that rectified them."""
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
    """A rectified rig from the numbers of a data sheet.

    ``fx fy cx cy`` are in pixels of both images, the centre of the first pixel at 0; ``cx_right`` is the
    right one's (``doffs``), which stands ``baseline_m`` metres to the right. ``size`` is (width, height).
    Raises ``TypeError`` or ``ValueError`` for what is no finite number, or not above 0 where it must be.
    """
    for name, value, unit in (("fx", fx, "pixels"), ("fy", fy, "pixels"), ("baseline", baseline_m, "metres")):
        check_positive(value, name, unit)
    columns = (cx, cx if cx_right is None else cx_right)
    left, right = (Camera(intrinsics(fx, fy, x, cy), size) for x in columns)
    return make_rig(left, right, baseline_m)
