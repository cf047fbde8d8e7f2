"""``transforms.json`` of nerfstudio, instant-ngp and NeRF's scenes: cameras and poses of frames."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    names_of_pair,
    rigid,
)
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.types import Rig

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
    """Frames by ``file_path``, each with the entries of the whole file that it does not have itself."""
    data = json.loads(text)
    if data.get("from_mitsuba"):
        cure = "Its cameras have other axes: export camera-to-world matrices with y up and z backward."
        bad_value("from_mitsuba", "false or left out", "true", cure)
    shared = {key: value for key, value in data.items() if key not in ("frames", "transform_matrix")}
    return {str(frame["file_path"]): shared | frame for frame in data["frames"]}


def _lens(frame: Frame) -> tuple[str, list[float]]:
    model = frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV")
    model = next((key for key in FOREIGN if key in frame), model)
    if model not in MODELS:
        return str(model), []
    params = frame.get("distortion_params", [frame.get(key, 0.0) for key in PARAMS])
    numbers = dict(zip(PARAMS, array_of(params, (6,), ", ".join(PARAMS)).tolist(), strict=True))
    coefficients, others = LENSES[MODELS[model]]
    if any(numbers[key] for key in others):
        cure = "OpenCV does not have this model: undistort or rectify both images first."
        bad_value(" and ".join(others), f"zero for {model}", [numbers[key] for key in others], cure)
    return MODELS[model], [numbers[key] for key in coefficients]


def _focal_px(frame: Frame, axis: str, side: float) -> float | None:
    """The focal length of one axis, or ``None`` where the file leaves it to the other one."""
    angle = frame.get(f"camera_angle_{axis}")
    if f"fl_{axis}" in frame or angle is None:
        return frame.get(f"fl_{axis}")
    if not 0 < angle < math.pi:
        bad_value(f"camera_angle_{axis}", "in radians, between 0 and pi", angle, "Is it in degrees?")
    return 0.5 * side / math.tan(0.5 * angle)


def nerf_camera(frame: Frame, image_size: tuple[int, int] | None = None) -> Camera:
    """The camera of a frame; ``image_size`` is that of its image, for files without ``w`` and ``h``."""
    size = (frame["w"], frame["h"]) if "w" in frame else image_size
    if size is None:
        cure = "Give image_size, the (width, height) of the images."
        bad_value("the file", "one with entries 'w' and 'h'", "none", cure)
    focals = [_focal_px(frame, axis, float(side)) for axis, side in zip("xy", size, strict=True)]
    given = [focal for focal in focals if focal is not None]
    if not given:
        expected = "one with an entry 'fl_x' or 'camera_angle_x'"
        bad_value("the file", expected, "none", "Is this the right file?")
    K = intrinsics(given[0], given[-1], frame.get("cx", size[0] / 2), frame.get("cy", size[1] / 2))
    K[:2, 2] -= 0.5  # as COLMAP, both programs put the centre of the first pixel at (0.5, 0.5)
    model, coefficients = _lens(frame)
    return Camera(K, size, coefficients, model)


def nerf_pose(frame: Frame) -> np.ndarray:
    """``(4, 4)`` camera-to-world in OpenCV's axes, lengths as before nerfstudio's ``applied_scale``."""
    pose = rigid(frame["transform_matrix"], "transform_matrix") @ OPENGL_FROM_OPENCV
    pose[:3, 3] /= float(frame.get("applied_scale", 1.0))
    return pose


def read_nerf(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The two images of ``choice.image_names``; a frame's entries go before the file's.

    Lengths keep the unit of the poses; ``applied_transform`` turns the world and changes no relative pose.
    Without ``w`` and ``h`` both images are of ``choice.image_size``; without ``cx`` and ``cy`` the principal
    point is the middle of the image.

    Source: data conventions of nerfstudio's documentation, its ``colmap_utils.py`` (intrinsics are written as
        COLMAP has them) and ``cameras.py`` (rays through pixel + 0.5); ``nerf_loader.cu`` of instant-ngp.
    """
    frames = nerf_frames(texts[0])
    left, right = (frames[name] for name in names_of_pair(frames, choice))
    E = np.linalg.inv(nerf_pose(left)) @ nerf_pose(right)
    return make_rig(nerf_camera(left, choice.image_size), nerf_camera(right, choice.image_size), E)
