"""``transforms.json`` of nerfstudio, instant-ngp and NeRF's scenes, and the names of two images in it.

Data flow: the frames of two images, with what the file says of all frames -> ``Rig``, in the file's unit.
Paper: none.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.image_names import names_of_pair
from geodiff_plugin.formats.lenses import NO_MODEL, FactoryCamera, lens_of, rig_of_cameras
from geodiff_plugin.formats.rigs import check_rigid, finite, intrinsics, positive, whole_pixels
from geodiff_plugin.formats.structured import array_of, entry, parse_json
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.types import Distortion, Rig

__all__ = ["MARK", "NERF", "matches", "read"]

MARK = '"transform_matrix"'
#: OpenCV's names of the lenses of ``camera_model``.
MODELS = {
    "OPENCV": "opencv",
    "PINHOLE": "opencv",
    "SIMPLE_PINHOLE": "opencv",
    "OPENCV_FISHEYE": "fisheye",
}
#: Keys by which instant-ngp says that a lens is none of these.
FOREIGN = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
#: Coefficients in OpenCV's order, and those that OpenCV's model does not have.
LENSES = {
    "opencv": (("k1", "k2", "p1", "p2", "k3"), ("k4",)),
    "fisheye": (("k1", "k2", "k3", "k4"), ("p1", "p2")),
}
#: The order of nerfstudio's ``distortion_params``.
PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")

Size = tuple[int, int]


def matches(text: str, path: Path) -> bool:
    """Whether the text is a JSON object with ``"frames"`` and ``"transform_matrix"`` in it."""
    return text.lstrip().startswith("{") and '"frames"' in text and MARK in text


def _frames(data: Any, path: Path) -> dict[str, dict[str, Any]]:
    """Frames by ``file_path``, each with the entries of the whole file that it does not have itself."""
    frames = entry(data, "frames", f"{path}")
    if not isinstance(frames, list):
        bad_value(f"frames in {path}", "a list", type(frames).__name__)
    shared = {key: value for key, value in data.items() if key not in ("frames", "transform_matrix")}
    named = {}
    for number, frame in enumerate(frames):
        name = entry(frame, "file_path", f"frame {number} in {path}")
        if not isinstance(name, str):
            bad_value(f"file_path of frame {number} in {path}", "a name", repr(name)[:80])
        named[name] = shared | frame
    return named


def _lens(frame: dict[str, Any], where: str) -> Distortion | None:
    model = frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV")
    model = next((key for key in FOREIGN if key in frame), model)
    if model not in MODELS:
        bad_value(f"camera_model of {where}", f"one of {', '.join(MODELS)}", repr(model), NO_MODEL)
    kind = MODELS[model]
    if "distortion_params" in frame:
        params = array_of(frame["distortion_params"], (len(PARAMS),), f"distortion_params of {where}")
        frame = frame | dict(zip(PARAMS, params.tolist(), strict=True))
    numbers = {key: finite(frame.get(key, 0.0), f"{key} of {where}") for key in PARAMS}
    coefficients, others = LENSES[kind]
    for key in others:
        if numbers[key] != 0:
            bad_value(f"{key} of {where}", f"zero for {model}", numbers[key], NO_MODEL)
    return lens_of(np.array([numbers[key] for key in coefficients]), f"the lens of {where}", kind)


def _focal_px(frame: dict[str, Any], axis: str, side: int, where: str) -> float | None:
    """The focal length of one axis, or ``None`` where the file leaves it to the other one."""
    if f"fl_{axis}" in frame:
        return positive(frame[f"fl_{axis}"], f"fl_{axis} of {where}")
    key = f"camera_angle_{axis}"
    if key not in frame:
        return None
    angle = finite(frame[key], f"{key} of {where}")
    if not 0 < angle < math.pi:
        bad_value(f"{key} of {where}", "an angle in radians, between 0 and pi", angle, "Is it in degrees?")
    return 0.5 * side / math.tan(0.5 * angle)


def _camera(frame: dict[str, Any], image_size: Size | None, where: str) -> FactoryCamera:
    size: Size | None = image_size
    if "w" in frame and "h" in frame:
        width, height = (whole_pixels(frame[key], f"{key} of {where}") for key in "wh")
        size = (width, height)
    if size is None:
        bad_value(where, "entries 'w' and 'h'", "none", "Give image_size, the (width, height) of the images.")
    focals = [_focal_px(frame, axis, side, where) for axis, side in zip("xy", size, strict=True)]
    known = [focal for focal in focals if focal is not None]
    if not known:
        bad_value(where, "an entry 'fl_x' or 'camera_angle_x'", "none", "Is this the right file?")
    # As COLMAP, both programs put the centre of the first pixel at (0.5, 0.5).
    cx, cy = (
        finite(frame.get(key, side / 2), f"{key} of {where}") - 0.5
        for key, side in zip(("cx", "cy"), size, strict=True)
    )
    return FactoryCamera(intrinsics(known[0], known[-1], cx, cy), size, _lens(frame, where))


def _pose(frame: dict[str, Any], where: str) -> np.ndarray:
    """Camera-to-world in OpenCV's axes."""
    name = f"transform_matrix of {where}"
    numbers = array_of(entry(frame, "transform_matrix", where), (-1,), name)
    if numbers.size == 12:  # instant-ngp never reads the last row
        numbers = np.append(numbers, (0, 0, 0, 1))
    return check_rigid(array_of(numbers, (4, 4), name), name) @ OPENGL_FROM_OPENCV


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the two images of ``choice.image_names``; a frame's own entries go before the file's.

    Lengths keep the unit that the poses had before nerfstudio's ``applied_scale``. ``applied_transform``
    turns the world and changes no relative pose. Without ``w`` and ``h`` both images are of
    ``choice.image_size``; without ``cx`` and ``cy`` the principal point is the middle of the image.

    Raises:
        ValueError: no such images, no names, an entry that is missing or malformed, a ``camera_model`` that
            OpenCV does not have, Mitsuba's axes.

    Source: data conventions of nerfstudio's documentation, its ``colmap_utils.py`` (intrinsics are written as
        COLMAP has them) and ``cameras.py`` (rays through pixel + 0.5); ``nerf_loader.cu`` of instant-ngp.
    """
    path = files[0].path
    data = parse_json(files[0].text, path)
    frames = _frames(data, path)
    if data.get("from_mitsuba"):
        cure = "Its cameras have other axes: export camera-to-world matrices with y up and z backward."
        bad_value(f"from_mitsuba in {path}", "false or left out", "true", cure)
    names = names_of_pair(frames, choice, path, "a transforms.json")
    places = [f"{name} in {path}" for name in names]
    left, right = (
        _camera(frames[name], choice.image_size, where) for name, where in zip(names, places, strict=True)
    )
    E_left, E_right = (_pose(frames[name], where) for name, where in zip(names, places, strict=True))
    E = np.linalg.inv(E_left) @ E_right
    E[:3, 3] /= positive(data.get("applied_scale", 1.0), f"applied_scale in {path}")
    return rig_of_cameras(left, right, E, str(path))


NERF = CalibrationFormat(
    "transforms.json of nerfstudio or instant-ngp (frames, transform_matrix)",
    matches,
    read,
    has_unit=False,
    by_image=True,
)
