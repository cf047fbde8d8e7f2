"""Luxonis' calibration of an OAK-D, as ``CalibrationHandler.eepromToJsonFile`` writes it.

Data flow: ``cameraData`` by socket, ``stereoRectificationData`` -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.lenses import NO_MODEL, FactoryCamera, lens_of, rig_of_cameras, scaled_to
from geodiff_plugin.formats.rigs import check_rigid, pose_to_the_right, whole_pixels
from geodiff_plugin.formats.structured import array_of, entry, parse_json
from geodiff_plugin.types import Distortion, Rig

__all__ = ["OAK", "matches", "read"]

#: CAM_B and CAM_C, where every OAK-D has its left and its right camera.
LEFT, RIGHT = 1, 2
METRES_PER_CENTIMETRE = 0.01
#: dai::CameraModel by its number; the others are none of OpenCV's.
LENSES = {0: "opencv", 1: "fisheye"}


def matches(text: str, path: Path) -> bool:
    """Whether the text is a JSON object with ``"cameraData"`` in it."""
    return text.lstrip().startswith("{") and '"cameraData"' in text


def _cameras(data: dict[str, Any], path: Path) -> dict[int, dict[str, Any]]:
    """Cameras by socket; the file holds pairs ``[socket, camera]``."""
    pairs = entry(data, "cameraData", f"{path}")
    if not isinstance(pairs, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
        bad_value(f"cameraData in {path}", "pairs of a socket and a camera", type(pairs).__name__)
    return dict(pairs)


def _camera(cameras: dict[int, dict[str, Any]], socket: int, path: Path) -> FactoryCamera:
    where = f"the camera of socket {socket} in {path}"
    if socket not in cameras:
        bad_value("cameras", f"sockets of {path} ({', '.join(map(str, sorted(cameras)))})", socket)
    camera = cameras[socket]
    K = array_of(entry(camera, "intrinsicMatrix", where), (3, 3), f"intrinsicMatrix of {where}")
    width, height = (
        whole_pixels(entry(camera, key, where), f"{key} of {where}") for key in ("width", "height")
    )
    return FactoryCamera(K, (width, height))


def _lens(cameras: dict[int, dict[str, Any]], socket: int, path: Path) -> Distortion | None:
    where = f"the camera of socket {socket} in {path}"
    name = f"distortionCoeff of {where}"
    numbers = array_of(entry(cameras[socket], "distortionCoeff", where), (-1,), name)
    kind = cameras[socket].get("cameraType", 0)
    if kind not in LENSES:
        bad_value(f"cameraType of {where}", "0 (perspective) or 1 (fisheye)", repr(kind), NO_MODEL)
    # A fisheye has four, in a list that may be filled up with zeros.
    numbers = numbers if LENSES[kind] == "opencv" or numbers[4:].any() else numbers[:4]
    return lens_of(numbers, name, LENSES[kind])


def _to_root(cameras: dict[int, dict[str, Any]], socket: int, path: Path) -> dict[int, np.ndarray]:
    """For every camera along the links from ``socket``: takes points of ``socket`` to it."""
    reached, T = {socket: np.eye(4)}, np.eye(4)
    while True:
        link = entry(cameras.get(socket), "extrinsics", f"the camera of socket {socket} in {path}")
        where = f"extrinsics of socket {socket} in {path}"
        socket = entry(link, "toCameraSocket", where)
        if socket not in cameras or socket in reached:
            return reached
        step, shift = np.eye(4), entry(link, "translation", where)
        step[:3, :3] = array_of(entry(link, "rotationMatrix", where), (3, 3), f"rotationMatrix, {where}")
        step[:3, 3] = array_of([entry(shift, axis, where) for axis in "xyz"], (3,), f"translation, {where}")
        step[:3, 3] *= METRES_PER_CENTIMETRE
        T = check_rigid(step, where) @ T
        reached[socket] = T


def _pose(cameras: dict[int, dict[str, Any]], left: int, right: int, path: Path) -> np.ndarray:
    """E through the first camera that the links of both sides reach."""
    from_left, from_right = (_to_root(cameras, socket, path) for socket in (left, right))
    common = [socket for socket in from_left if socket in from_right]
    if not common:
        bad_value(f"extrinsics in {path}", f"a way from socket {left} to {right}", "none", "Calibrate again.")
    return np.linalg.inv(from_left[common[0]]) @ from_right[common[0]]


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the rectified images (``rectifiedLeft``, ``rectifiedRight``), at ``choice.image_size``.

    Where the file holds the rectifying rotations, both images are those of a pinhole with the right camera's
    intrinsics, a baseline apart; that is what ``StereoDepth`` makes. Without them, or for other sockets, the
    cameras stand as they are, with their lenses. Lengths are centimetres.

    Raises:
        ValueError: an entry is missing or malformed, no such socket, a lens that OpenCV has no model of.
    """
    path = files[0].path
    data = parse_json(files[0].text, path)
    cameras = _cameras(data, path)
    stereo = data.get("stereoRectificationData") or {}
    pair = (stereo.get("leftCameraSocket", LEFT), stereo.get("rightCameraSocket", RIGHT))
    pair = pair if min(pair) >= 0 else (LEFT, RIGHT)
    left, right = choice.cameras or pair
    first, second = (
        scaled_to(_camera(cameras, socket, path), choice.image_size, str(path)) for socket in (left, right)
    )
    E = _pose(cameras, left, right, path)
    if (left, right) == pair and stereo.get("rectifiedRotationLeft"):
        E = pose_to_the_right(float(np.linalg.norm(E[:3, 3])))
        return rig_of_cameras(second, second, E, str(path), rectified=True)
    first, second = (
        replace(camera, lens=_lens(cameras, socket, path))
        for camera, socket in ((first, left), (second, right))
    )
    return rig_of_cameras(first, second, E, str(path))


OAK = CalibrationFormat("OAK-D calibration JSON (cameraData)", matches, read, uses_cameras=True)
