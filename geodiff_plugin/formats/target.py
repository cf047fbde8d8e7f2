"""The camera that depth is wanted in, ``--into``: a JSON file with K, E, width and height."""

from __future__ import annotations

import json

from geodiff_plugin._checks import bad_value
from geodiff_plugin._reprojection import PosedCamera
from geodiff_plugin.formats.files import PathLike, read_text

NEEDED = ("K", "E", "width", "height")
#: The frame of that camera in ROS, where the file does not say it.
FRAME_ID = "into"
_WHAT = 'a JSON file such as {"K": [[fx, 0, cx], ...], "E": [[...], ...], "width": 640, "height": 480}'


def _read(path: PathLike) -> dict[str, object]:
    name = "--into"
    try:
        said = json.loads(read_text(path, name, _WHAT))
    except (ValueError, RecursionError) as error:
        bad_value(name, _WHAT, f"{path}, which is no JSON ({type(error).__name__})")
    missing = [key for key in NEEDED if not isinstance(said, dict) or key not in said]
    if missing:
        bad_value(name, _WHAT, f"{path} without {', '.join(missing)}")
    return said


def read_target_camera(path: PathLike) -> PosedCamera:
    """``K (3, 3)`` pixels, ``E (4, 4)`` pose in the left camera's frame, ``width`` and ``height`` of a file.

    E is camera-to-world with the left camera as the world, OpenCV's axes, metres, as everywhere here.

    Raises:
        InputError: a file that is no such JSON, or whose camera is none.
    """
    said = _read(path)
    return PosedCamera.checked(said["K"], said["E"], (said["width"], said["height"]), "--into")


def frame_of_target(path: PathLike) -> str:
    """``frame_id`` of such a file: the name of the camera's frame in ROS."""
    return str(_read(path).get("frame_id", FRAME_ID))
