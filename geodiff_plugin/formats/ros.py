"""Reads ROS calibrations: files of ``camera_calibration``, old and new, and printed ``camera_info``."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.rigs import (
    CHECK_FILE,
    COLMAP_LENSES,
    LENS_MODELS,
    CameraChoice,
    RawCamera,
    array_of,
    make_rig,
    projected,
    rectified_from,
)
from geodiff_plugin.formats.storage import read_yaml
from geodiff_plugin.types import Rig

Entries = dict[str, Any]


#: Hint for files without a relative pose of the cameras.
ROS_ALONE = "These are of single cameras. Calibrate the pair (camera_calibration with two topics)."
#: Hint for files whose P is zero.
ZERO_P_HINT = (
    "Calibrate the pair (camera_calibration with two topics). For cameras calibrated separately, pass K and "
    "the pose of the right camera (--K, --K-right, --E)."
)
#: Names of a matrix in a file of ``camera_calibration``, and in messages of ROS 1 and ROS 2.
ROS_NAMES = {
    "P": ("projection_matrix", "P", "p"),
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
}


def _of_ros(info: Entries, name: str) -> Any:
    """Return the numbers of a matrix, or ``None``."""
    matrix = next((info[key] for key in ROS_NAMES[name] if key in info), None)
    return matrix.get("data") if isinstance(matrix, dict) else matrix


def _projection(info: Entries, binning: np.ndarray) -> np.ndarray:
    return _of_window(info, binning) @ array_of(_of_ros(info, "P"), (3, 4), "projection_matrix")


def _of_window(info: Entries, binning: np.ndarray) -> np.ndarray:
    """Return ``(3, 3)`` from pixels of the whole sensor, which K and P use, to pixels of the image.

    The image is the region of interest, binned by ``binning`` (2,).
    Source: ``fromCameraInfo`` of ``image_geometry/pinhole_camera_model.cpp`` (ros-perception/vision_opencv).
    """
    roi = info.get("roi") or {}
    shift = np.eye(3)
    shift[:2, 2] = array_of([-roi.get("x_offset", 0), -roi.get("y_offset", 0)], (2,), "roi")
    return np.diag([*(1.0 / binning), 1.0]) @ shift


def _window_size(info: Entries) -> tuple[Any, Any]:
    """Return width and height of the images before binning: of the region of interest, if set."""
    roi = info.get("roi") or {}
    sides = (("width", "image_width"), ("height", "image_height"))
    width, height = (roi.get(side) or info.get(whole, info.get(side)) for side, whole in sides)
    return width, height


def _binning(info: Entries, choice: CameraChoice) -> np.ndarray:
    """Return the factors (2,) by which the images are smaller than the region of interest.

    Zero means none. Some drivers state the binning, but write K, P and the size of the binned images. Images
    of the stated size are therefore not binned again.
    """
    stated = array_of([info.get(f"binning_{axis}") or 1 for axis in "xy"], (2,), "binning_x, binning_y")
    if (stated < 1).any() or (stated % 1).any():
        bad_value("binning_x, binning_y", "whole numbers of pixels", stated.tolist(), CHECK_FILE)
    window = _window_size(info)
    if None not in window and choice.image_size == tuple(array_of(window, (2,), "width, height")):
        return np.ones(2)
    return stated


def _image_size(info: Entries, binning: np.ndarray) -> tuple[Any, Any]:
    """Return width and height of the images, which are the binned region of interest."""
    window = _window_size(info)
    if None in window or (binning == 1).all():
        return window
    width, height = array_of(window, (2,), "width, height") // binning
    return width, height


def read_ros(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read files of ``camera_calibration`` or printed messages: rectified images, from ``P``.

    Files with ``rectified: false`` (``recordings.stereo_calibration``) describe raw images. For a left image
    alone one file is enough, even if its ``P`` is zero, as for a camera that was not calibrated in a pair.
    """
    infos = [read_yaml(text) for text in texts]
    return (
        _single_camera(infos[0], choice)
        if choice.is_alone and len(infos) == 1
        else _rig_of_infos(infos, choice)
    )


#: Headings in the older form of ``camera_calibration`` -> entries of the newer one.
INI_NAMES = {
    "camera matrix": "camera_matrix",
    "distortion": "distortion_coefficients",
    "rectification": "rectification_matrix",
    "projection": "projection_matrix",
    "width": "image_width",
    "height": "image_height",
}


def read_ros_ini(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read ``left.ini`` and ``right.ini``, or both in one file, as written by ``camera_calibration``."""
    blocks = [block for text in texts for block in re.split(r"(?m)^\[image\][ \t]*$", text)[1:]]
    if len(blocks) != 2:
        hint = "Pass left.ini and right.ini, or a file with both, left one first."
        bad_value(
            "the file", "a file of two cameras, each starting with [image]", f"{len(blocks)} of them", hint
        )
    return _rig_of_infos([_ini_entries(block) for block in blocks], choice)


def _ini_entries(block: str) -> Entries:
    """Return the entries of a camera under their names in the newer form."""
    entries: Entries = {"distortion_model": "plumb_bob"}
    heading = r"(?m)^(" + "|".join(INI_NAMES) + r")[ \t]*\n((?:[ \t]*[-+.\deE \t]+\n?)+)"
    for name, numbers in re.findall(heading, block):
        words = numbers.split()
        entries[INI_NAMES[name]] = words[0] if len(words) == 1 else {"data": words}
    return entries


def _rig_of_infos(infos: list[Entries], choice: CameraChoice) -> Rig:
    """Return the rig of rectified images from ``P``, or of raw images if the entries state it."""
    binnings = [_binning(info, choice) for info in infos]
    sizes = [_image_size(info, binning) for info, binning in zip(infos, binnings, strict=True)]
    if any(_of_ros(info, "P") is None for info in infos):
        bad_value("projection_matrix", "specified in both files", "none", ROS_ALONE)
    projections = [_projection(info, binning) for info, binning in zip(infos, binnings, strict=True)]
    if not all(P.any() for P in projections):
        got = "zeros: the camera is not calibrated, or not as part of a pair"
        bad_value(
            "projection_matrix (P)", "the projection of the rectified image in both files", got, ZERO_P_HINT
        )
    rig = projected(*projections, *sizes)
    if not rig.E[:3, 3].any():
        expected = "-fx * baseline in the right camera's file"
        bad_value("projection_matrix[0, 3]", expected, "the same in both", ROS_ALONE)
    are_raw = not all(info.get("rectified", True) for info in infos)
    if not are_raw and not all(map(_has_raw_camera, infos)):
        return rig
    with_raw = _with_raw_cameras(rig, infos, sizes, binnings)
    return with_raw.as_taken or rig if are_raw else with_raw


def _single_camera(info: Entries, choice: CameraChoice) -> Rig:
    """Return a rig of one camera twice: of the rectified image, or of the raw one if P is zero or missing."""
    binning = _binning(info, choice)
    size = _image_size(info, binning)
    P = None if _of_ros(info, "P") is None else _projection(info, binning)
    if info.get("rectified", True) and P is not None and P.any():
        camera = RawCamera(P[:, :3], size)
    else:
        camera = _raw_camera(info, size, binning)
    return make_rig(camera, camera, np.eye(4))


def _raw_camera(info: Entries, size: tuple[Any, Any], binning: np.ndarray) -> RawCamera:
    """Return the camera before rectification."""
    K = _of_window(info, binning) @ array_of(_of_ros(info, "K"), (3, 3), "K")
    return RawCamera(K, size, _of_ros(info, "D"), str(info["distortion_model"]))


def _has_raw_camera(info: Entries) -> bool:
    """Whether entries for rectified images also describe the camera before rectification.

    Drivers may leave these entries out, empty or zero, or name a lens model that OpenCV lacks.

    Raises:
        InputError: entries that are no numbers.
    """
    K, D, R = (_of_ros(info, name) for name in "KDR")
    if K is None or D is None or R is None or "distortion_model" not in info:
        return False
    model = str(info["distortion_model"])
    if model.lower() not in LENS_MODELS and model not in COLMAP_LENSES:
        return False
    return bool(array_of(K, (-1,), "K").any() and array_of(R, (-1,), "R").any())


def _with_raw_cameras(
    rig: Rig, infos: list[Entries], sizes: list[tuple[Any, Any]], binnings: list[np.ndarray]
) -> Rig:
    """Return the rectified rig with its raw cameras."""
    left, right = (
        _raw_camera(info, size, binning) for info, size, binning in zip(infos, sizes, binnings, strict=True)
    )
    R_left, R_right = (_of_ros(info, "R") for info in infos)
    return rectified_from(rig, left, right, (R_left, R_right))
