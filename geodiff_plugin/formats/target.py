"""Reads the target camera of ``--reproject``: a JSON file with K, E, width and height."""

from __future__ import annotations

import json

from geodiff_plugin._internal.camera_checks import check_posed_camera
from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.formats.files import PathLike, read_text

NEEDED = ("K", "E", "width", "height")
#: Default ROS frame of the target camera.
FRAME_ID = "reprojected"
_WHAT = 'a JSON file such as {"K": [[fx, 0, cx], ...], "E": [[...], ...], "width": 640, "height": 480}'


def _read(path: PathLike) -> dict[str, object]:
    name = "--reproject"
    try:
        entries = json.loads(read_text(path, name, _WHAT))
    except (ValueError, RecursionError) as error:
        bad_value(name, _WHAT, f"{path}, which is not JSON ({type(error).__name__})")
    missing = [key for key in NEEDED if not isinstance(entries, dict) or key not in entries]
    if missing:
        bad_value(name, _WHAT, f"{path} without {', '.join(missing)}")
    return entries


def read_target_camera(path: PathLike) -> PosedCamera:
    """Read ``K (3, 3)`` pixels, ``E (4, 4)`` pose in the left camera's frame, ``width`` and ``height``.

    E is camera-to-world with the left camera as world, OpenCV's axes, metres, as in the whole package.

    Raises:
        InputError: not such a JSON file, or an invalid camera.
    """
    entries = _read(path)
    return check_posed_camera(
        entries["K"], entries["E"], (entries["width"], entries["height"]), "--reproject"
    )


def frame_of_target(path: PathLike) -> str:
    """Return ``frame_id`` of the file: the ROS frame of the camera."""
    return str(_read(path).get("frame_id", FRAME_ID))
