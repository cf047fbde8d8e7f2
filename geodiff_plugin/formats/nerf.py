"""``transforms.json`` of nerfstudio, instant-ngp and NeRF's scenes: cameras and poses of frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    RawRig,
    array_of,
    intrinsics,
    names_of_pair,
    number,
    rigid,
    size_of,
)
from geodiff_plugin.formats.structured import parse_json
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

__all__ = ["nerf_camera", "nerf_frames", "nerf_pose", "read_nerf"]

#: What ``Camera.model`` calls the lenses of ``camera_model``.
MODELS = {"OPENCV": "opencv", "PINHOLE": "opencv", "SIMPLE_PINHOLE": "opencv", "OPENCV_FISHEYE": "fisheye"}
#: Keys by which instant-ngp says that a lens is none of these.
FOREIGN = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
#: Coefficients in OpenCV's order, and those that OpenCV's model does not have.
LENSES = {
    "opencv": (("k1", "k2", "p1", "p2", "k3"), ("k4",)),
    "fisheye": (("k1", "k2", "k3", "k4"), ("p1", "p2")),
}
#: The order of nerfstudio's ``distortion_params``.
PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")

Frame = dict[str, Any]


def nerf_frames(text: str) -> dict[str, Frame]:
    """Frames by ``file_path``, each with the entries of the whole file that it does not have itself.

    Raises:
        ValueError: not JSON, frames without a name, or Mitsuba's axes.
    """
    data = parse_json(text)
    if data.get("from_mitsuba"):
        cure = "Its cameras have other axes: export camera-to-world matrices with y up and z backward."
        bad_value("from_mitsuba", "false or left out", "true", cure)
    frames = data["frames"]
    if not isinstance(frames, list):
        bad_value("frames", "a list", type(frames).__name__)
    shared = {key: value for key, value in data.items() if key not in ("frames", "transform_matrix")}
    named = {}
    for position, frame in enumerate(frames):
        if not isinstance(frame.get("file_path"), str):
            bad_value(f"file_path of frame {position}", "a name", repr(frame.get("file_path"))[:80])
        named[frame["file_path"]] = shared | frame
    return named


def _lens(frame: Frame) -> tuple[str, list[float]]:
    model = frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV")
    model = next((key for key in FOREIGN if key in frame), model)
    if model not in MODELS:
        return str(model), []
    if "distortion_params" in frame:
        params = array_of(frame["distortion_params"], (len(PARAMS),), "distortion_params")
        frame = frame | dict(zip(PARAMS, params.tolist(), strict=True))
    numbers = {key: number(frame.get(key, 0.0), key) for key in PARAMS}
    coefficients, others = LENSES[MODELS[model]]
    for key in others:
        if numbers[key] != 0:
            cure = "OpenCV does not have this model: undistort or rectify both images first."
            bad_value(key, f"zero for {model}", numbers[key], cure)
    return MODELS[model], [numbers[key] for key in coefficients]


def _focal_px(frame: Frame, axis: str, side: float) -> float | None:
    """The focal length of one axis, or ``None`` where the file leaves it to the other one."""
    if f"fl_{axis}" in frame:
        return number(frame[f"fl_{axis}"], f"fl_{axis}")
    key = f"camera_angle_{axis}"
    if key not in frame:
        return None
    angle = number(frame[key], key)
    if not 0 < angle < math.pi:
        bad_value(key, "an angle in radians, between 0 and pi", angle, "Is it in degrees?")
    return 0.5 * side / math.tan(0.5 * angle)


def nerf_camera(frame: Frame, image_size: tuple[int, int] | None = None) -> Camera:
    """The camera of a frame, with K as this package has it (first pixel's centre at 0).

    ``image_size`` is ``(width, height)`` of its image, for files without ``w`` and ``h``.

    Raises:
        ValueError: no size, no focal length, or a lens with coefficients that OpenCV's model has not.
    """
    size = size_of(frame, "w", "h") or image_size
    if size is None:
        cure = "Give image_size, the (width, height) of the images."
        bad_value("the file", "one with entries 'w' and 'h'", "none", cure)
    sides = [number(side, key) for side, key in zip(size, "wh", strict=True)]
    focals = [_focal_px(frame, axis, side) for axis, side in zip("xy", sides, strict=True)]
    given = [focal for focal in focals if focal is not None]
    if not given:
        expected = "one with an entry 'fl_x' or 'camera_angle_x'"
        bad_value("the file", expected, "none", "Is this the right file?")
    # As COLMAP, both programs put the centre of the first pixel at (0.5, 0.5).
    keyed = zip(("cx", "cy"), sides, strict=True)
    cx, cy = (number(frame.get(key, side / 2), key) - 0.5 for key, side in keyed)
    model, coefficients = _lens(frame)
    return Camera(intrinsics(given[0], given[-1], cx, cy), size, coefficients, model)


def nerf_pose(frame: Frame) -> np.ndarray:
    """``(4, 4)`` camera-to-world in OpenCV's axes, lengths as before nerfstudio's ``applied_scale``.

    Raises:
        ValueError: no rigid ``transform_matrix`` of 12 or 16 numbers, or an ``applied_scale`` that is none.
    """
    pose = rigid(frame["transform_matrix"], "transform_matrix") @ OPENGL_FROM_OPENCV
    scale = number(frame.get("applied_scale", 1.0), "applied_scale")
    if scale <= 0:
        bad_value("applied_scale", "above 0", scale)
    pose[:3, 3] /= scale
    return pose


def read_nerf(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The two images of ``choice.image_names``; a frame's entries go before the file's.

    Lengths keep the unit of the poses; ``applied_transform`` turns the world and changes no relative pose.
    Without ``w`` and ``h`` both images are of ``choice.image_size``; without ``cx`` and ``cy`` the principal
    point is the middle of the image.

    Source: data conventions of nerfstudio's documentation, its ``colmap_utils.py`` (intrinsics are written as
        COLMAP has them) and ``cameras.py`` (rays through pixel + 0.5); ``nerf_loader.cu`` of instant-ngp.
    """
    frames = nerf_frames(texts[0])
    pair = [frames[name] for name in names_of_pair(frames, choice)]
    left, right = (nerf_camera(frame, choice.image_size) for frame in pair)
    E_left, E_right = (nerf_pose(frame) for frame in pair)
    return RawRig(left, right, np.linalg.inv(E_left) @ E_right)
