"""Reads the target camera of ``--reproject``: JSON with K, E, width and height, or a RealSense's text."""

from __future__ import annotations

import json
from typing import Any

from geodiff_plugin._internal.camera_checks import check_posed_camera
from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.cameras import PosedCamera, Size
from geodiff_plugin.formats.devices import is_realsense_text, realsense_colour
from geodiff_plugin.formats.files import PathLike, read_text
from geodiff_plugin.formats.rigs import reading_file

NEEDED = ("K", "E", "width", "height")
#: Default ROS frame of the target camera.
FRAME_ID = "reprojected"
_NAME = "--reproject"
_WHAT = (
    'a JSON file such as {"K": [[fx, 0, cx], ...], "E": [[...], ...], "width": 640, "height": 480}, or the '
    "output of rs-enumerate-devices -c"
)


def _entries(path: PathLike, text: str) -> dict[str, Any]:
    """Parse the JSON of a target camera."""
    try:
        entries = json.loads(text)
    except (ValueError, RecursionError) as error:
        bad_value(_NAME, _WHAT, f"{path}, which is not JSON ({type(error).__name__})")
    missing = [key for key in NEEDED if not isinstance(entries, dict) or key not in entries]
    if missing:
        bad_value(_NAME, _WHAT, f"{path} without {', '.join(missing)}")
    return dict(entries)


def read_target_camera(path: PathLike, size: Size | None = None) -> PosedCamera:
    """Read ``K (3, 3)`` pixels, ``E (4, 4)`` pose in the left camera's frame, ``width`` and ``height``.

    E is camera-to-world with the left camera as world, OpenCV's axes, metres, as in the whole package. The
    text of a RealSense, whose left camera is "Infrared 1", describes the colour camera at several sizes;
    ``size`` selects one.

    Raises:
        InputError: no such file, or an invalid camera.
    """
    text = read_text(path, _NAME, _WHAT)
    if is_realsense_text(text):
        with reading_file(path, "output of rs-enumerate-devices -c", text):
            K, E, size = realsense_colour(text, size)
        return check_posed_camera(K, E, size, _NAME)
    if size is not None:
        raise_input_error(
            f"--reproject-size is for the output of rs-enumerate-devices -c; {path} has a size."
        )
    entries = _entries(path, text)
    return check_posed_camera(entries["K"], entries["E"], (entries["width"], entries["height"]), _NAME)


def frame_of_target(path: PathLike) -> str:
    """Return ``frame_id`` of the file, the ROS frame of the camera; a RealSense's text has none."""
    text = read_text(path, _NAME, _WHAT)
    return FRAME_ID if is_realsense_text(text) else str(_entries(path, text).get("frame_id", FRAME_ID))
