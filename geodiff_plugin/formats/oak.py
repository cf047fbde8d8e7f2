"""Luxonis' calibration of an OAK-D, as ``CalibrationHandler.eepromToJsonFile`` writes it."""

from __future__ import annotations

from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import CalibrationFormat, Camera, CameraChoice, RawRig, array_of, rigid
from geodiff_plugin.formats.structured import parse_json

__all__ = ["OAK"]

#: CAM_B and CAM_C, where every OAK-D has its left and its right camera.
LEFT, RIGHT = 1, 2
METRES_PER_CENTIMETRE = 0.01
#: dai::CameraModel by its number; the others are none of OpenCV's.
LENSES = {0: "opencv", 1: "fisheye"}
#: Images of one sensor differ in their ratio of sides by rounding only; beyond this one of them was cropped.
RATIO_TOLERANCE = 0.01

Sockets = dict[int, dict[str, Any]]


def _camera(cameras: Sockets, socket: int, image_size: tuple[int, int] | None) -> Camera:
    """The camera without its lens, at another resolution of the whole sensor where one is asked for."""
    if socket not in cameras:
        bad_value("cameras", f"sockets of the file ({', '.join(map(str, sorted(cameras)))})", socket)
    K = array_of(cameras[socket]["intrinsicMatrix"], (3, 3), f"intrinsicMatrix of socket {socket}")
    size = cameras[socket]["width"], cameras[socket]["height"]
    if image_size is None:
        return Camera(K, size)
    s_x, s_y = image_size[0] / size[0], image_size[1] / size[1]
    if abs(s_x / s_y - 1) > RATIO_TOLERANCE:
        cure = "It is a crop of the sensor: give --fx --fy --cx --cy --baseline of the cropped image."
        expected = "of the shape of {}x{} pixels, as the file says".format(*size)
        bad_value("the left image", expected, "{}x{}".format(*image_size), cure)
    S = np.array([[s_x, 0, 0.5 * s_x - 0.5], [0, s_y, 0.5 * s_y - 0.5], [0, 0, 1]])
    return Camera(K if image_size == size else S @ K, image_size)


def _with_lens(camera: Camera, entries: dict[str, Any]) -> Camera:
    numbers = array_of(entries["distortionCoeff"], (-1,), "distortionCoeff")
    kind = entries.get("cameraType", 0)
    model = LENSES.get(kind, f"cameraType {kind}")
    # A fisheye has four, in a list that may be filled up with zeros.
    numbers = numbers if model == "opencv" or numbers[4:].any() else numbers[:4]
    return Camera(camera.K, camera.size, numbers, model)


def _to_root(cameras: Sockets, socket: int) -> dict[int, np.ndarray]:
    """For every camera along the links from ``socket``: takes points of ``socket`` to it."""
    reached, T = {socket: np.eye(4)}, np.eye(4)
    while True:
        link, where = cameras[socket]["extrinsics"], f"extrinsics of socket {socket}"
        socket = link["toCameraSocket"]
        if socket not in cameras or socket in reached:
            return reached
        step = np.eye(4)
        step[:3, :3] = array_of(link["rotationMatrix"], (3, 3), where)
        step[:3, 3] = array_of([link["translation"][axis] for axis in "xyz"], (3,), where)
        step[:3, 3] *= METRES_PER_CENTIMETRE
        T = rigid(step, where) @ T
        reached[socket] = T


def _pose(cameras: Sockets, left: int, right: int) -> np.ndarray:
    """E through the first camera that the links of both sides reach."""
    from_left, from_right = (_to_root(cameras, socket) for socket in (left, right))
    common = next((socket for socket in from_left if socket in from_right), None)
    if common is None:
        bad_value("extrinsics", f"a way from socket {left} to {right}", "none", "Calibrate again.")
    return np.linalg.inv(from_left[common]) @ from_right[common]


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The rectified images (``rectifiedLeft``, ``rectifiedRight``), at ``choice.image_size``.

    Where the file holds the rectifying rotations, both images are those of a pinhole with the right camera's
    intrinsics, a baseline apart; that is what ``StereoDepth`` makes. Without them, or for other sockets, the
    cameras stand as they are, with their lenses. Lengths are centimetres.
    """
    data = parse_json(texts[0])
    cameras: Sockets = dict(data["cameraData"])  # pairs of a socket and its camera
    stereo = data.get("stereoRectificationData") or {}
    pair = stereo.get("leftCameraSocket", LEFT), stereo.get("rightCameraSocket", RIGHT)
    pair = pair if min(pair) >= 0 else (LEFT, RIGHT)
    left, right = choice.cameras or pair
    first, second = (_camera(cameras, socket, choice.image_size) for socket in (left, right))
    E = _pose(cameras, left, right)
    if (left, right) == pair and stereo.get("rectifiedRotationLeft"):
        return RawRig(second, second, float(np.linalg.norm(E[:3, 3])), rectified=True)
    return RawRig(_with_lens(first, cameras[left]), _with_lens(second, cameras[right]), E)


OAK = CalibrationFormat(
    "OAK-D calibration JSON (cameraData)",
    lambda text: text.lstrip().startswith("{") and '"cameraData"' in text,
    _read,
    uses_cameras=True,
)
