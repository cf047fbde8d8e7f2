"""Reads calibrations stored in stereo cameras: ZED, RealSense, OAK-D."""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Size
from geodiff_plugin.formats.maps import MM_PER_METRE
from geodiff_plugin.formats.rigs import (
    DISTORTION_TOLERANCE,
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    of_size,
    resized,
    transform,
    two_cameras,
)
from geodiff_plugin.types import Rig

CM_PER_METRE = 100.0
ZED_SIZES = {
    **{"4K": (3840, 2160), "QHDPLUS": (3200, 1800), "2K": (2208, 1242), "FHD1200": (1920, 1200)},
    **{"FHD": (1920, 1080), "HD": (1280, 720), "SVGA": (960, 600), "VGA": (672, 376)},
}
#: Coefficients in OpenCV's order, for its models with 5 and with 8 of them.
ZED_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
RS_PRINTED = r'^\s*Intrinsic of "'
#: Entries of a camera at one resolution, and of the transform between two cameras.
RS_INTRINSIC = r'^\s*Intrinsic of "{}" */ *\d+x\d+[^\n]*\n(.*?)(?=\n\s*\n|\Z)'
RS_EXTRINSIC = r'^\s*Extrinsic from "{}"\s+To\s+"{}"[^\n]*\n(.*?)(?=\n\s*Extrinsic|\Z)'
#: Names of the infrared pair, left first, and of the colour camera.
RS_PAIR, RS_COLOUR = ("Infrared 1", "Infrared 2"), "Color"
#: Matches names outside the infrared pair, in lower case; the depth map belongs to its left camera.
RS_OTHERS = re.compile(r"colou?r|rgb|depth|gyro|accel|imu|confidence")
#: Keys of the baseline in metres.
RS_BASELINES = ("baseline", "baseline_m", "baseline_meters", "baseline_metres")
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
#: Sockets CAM_B and CAM_C, an OAK-D's left and right camera.
OAK_PAIR = (1, 2)
#: Names of depthai's sockets, new and old.
SOCKETS = {
    **{f"CAM_{letter}": number for number, letter in enumerate("ABCDEFGHIJ")},
    **{"RGB": 0, "CENTER": 0, "LEFT": 1, "RIGHT": 2},
}
Entries = dict[str, Any]
Sockets = dict[int, Entries]


def read_zed(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read the raw images' cameras in ``SN<number>.conf`` for ``choice.image_size``; millimetres.

    ``x_right = Rodrigues(RX, CV, RZ) x_left - T``. Source: calibration.hpp of stereolabs/zed-opencv-native.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read_string(texts[0])
    sections: dict[str, Entries] = {name: dict(section) for name, section in parser.items()}
    available = [name for name in ZED_SIZES if {f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}"} <= sections.keys()]
    name = of_size({ZED_SIZES[name]: name for name in available}, choice)
    cameras = []
    for side in ("LEFT", "RIGHT"):
        section = sections[f"{side}_CAM_{name}"]
        lens = sections.get(f"{side}_DISTO", {}) | section
        keys = ZED_LENS if lens.keys() & set(ZED_LENS[5:]) else ZED_LENS[:5]
        K = intrinsics(*(section[key] for key in ("fx", "fy", "cx", "cy")))
        cameras.append(RawCamera(K, ZED_SIZES[name], [lens.get(key, 0.0) for key in keys]))
    # Keys are lower case here. Some files have them per resolution (TY_HD), others once for all (TY); files
    # of the first cameras lack them.
    stereo = sections["STEREO"]
    at = f"_{name.lower()}"
    shift = [stereo["baseline"], *(stereo.get(key + at, stereo.get(key, 0.0)) for key in ("ty", "tz"))]
    turn = array_of([stereo[key + at] for key in ("rx", "cv", "rz")], (3,), "RX, CV, RZ of [STEREO]")
    shift_m = -array_of(shift, (3,), "Baseline, TY, TZ of [STEREO]") / MM_PER_METRE
    T = transform(Rotation.from_rotvec(turn).as_matrix(), shift_m, "[STEREO]")
    return make_rig(cameras[0], cameras[1], np.linalg.inv(T))


def _rs_camera(values: Entries) -> RawCamera:
    """Return a camera of rs2's entries; zero coefficients mean no distortion, for any model."""
    K = intrinsics(*(values[key] for key in ("fx", "fy", "ppx", "ppy")))
    coefficients = array_of(values.get("coeffs", ()), (-1,), "coeffs")
    model = re.sub(r"^.*distortion|[^a-z0-9]", "", str(values.get("model", "none")).lower())
    model = {"4": "brownconrady", "5": "kannalabrandt4"}.get(model, model)  # numbers of rs2_distortion
    if model != "kannalabrandt4" and not coefficients.any():
        model = "none"
    return RawCamera(K, (values["width"], values["height"]), coefficients, model)


class _Pair(NamedTuple):
    """Two cameras, and the transform from the left to the right camera frame, in metres."""

    left: RawCamera
    right: RawCamera
    T: np.ndarray  # (4, 4)


def _rs_printed(text: str, choice: CameraChoice) -> _Pair:
    """Parse the infrared pair in the output of ``rs-enumerate-devices -c``."""
    left, right = (of_size(_rs_cameras(text, name), choice) for name in RS_PAIR)
    return _Pair(left, right, _rs_between(text, *RS_PAIR))


def _rs_cameras(text: str, name: str) -> dict[Size, RawCamera]:
    """Parse a camera at every resolution in the output of ``rs-enumerate-devices -c``."""
    cameras = dict[Size, RawCamera]()
    for block in re.findall(RS_INTRINSIC.format(name), text, re.M | re.S):
        pairs = (line.partition(":") for line in block.splitlines())
        values: Entries = {key.strip().lower(): value.strip() for key, _, value in pairs}
        values |= {"coeffs": NUMBER.findall(values.get("coeffs", "")), "model": values.get("distortion")}
        size = int(values["width"]), int(values["height"])
        cameras.setdefault(size, _rs_camera(values))  # a size is listed once for every pixel format
    return cameras


def _rs_between(text: str, source: str, target: str) -> np.ndarray:
    """Parse the transform ``(4, 4)`` from one camera's frame to another's, in metres."""
    extrinsics = re.search(RS_EXTRINSIC.format(source, target), text, re.M | re.S)
    rotation, _, translation = (extrinsics[1] if extrinsics else "").partition("Translation")
    return transform(NUMBER.findall(rotation)[:9], NUMBER.findall(translation)[:3], "the extrinsics")


def is_realsense_text(text: str) -> bool:
    """Whether a text is the output of ``rs-enumerate-devices -c``."""
    return re.search(RS_PRINTED, text, re.MULTILINE) is not None


def realsense_colour(text: str, size: Size | None) -> tuple[np.ndarray, np.ndarray, Size]:
    """Parse the colour camera in the output of ``rs-enumerate-devices -c``.

    Source: ``print`` of ``rs2_extrinsics`` in ``tools/enumerate-devices/rs-enumerate-devices.cpp`` of
    IntelRealSense/librealsense, which prints rotations row by row.

    Args:
        text: the output.
        size: ``(width, height)`` of the colour images; may be ``None`` if the text has only one.

    Returns:
        ``K (3, 3)`` pixels, the pose ``(4, 4)`` in the left infrared camera's frame, and the size.
    """
    cameras = _rs_cameras(text, RS_COLOUR)
    if size is None and len(cameras) == 1:
        (size,) = cameras
    if size is None or size not in cameras:
        sizes = ", ".join("{}x{}".format(*each) for each in sorted(cameras)) or "none"
        got = "no size" if size is None else "{}x{}".format(*size)
        bad_value("--reproject-size", f"a size of the colour images in the file ({sizes})", got)
    camera = cameras[size]
    if np.abs(camera.coefficients).max(initial=0.0) > DISTORTION_TOLERANCE:
        hint = "Undistort the colour images, and pass their K, E, width and height as JSON."
        bad_value("the colour camera", "without lens distortion", f"coefficients {camera.coefficients}", hint)
    K = array_of(camera.K, (3, 3), "K of the colour camera")
    return K, np.linalg.inv(_rs_between(text, RS_PAIR[0], RS_COLOUR)), size


def _rs_json(text: str) -> _Pair:
    """Parse ``rs2_intrinsics`` (left before right) and ``rs2_extrinsics`` between them, under any names.

    Ignores other cameras if the names identify the pair. A baseline in metres may replace the extrinsics.
    """
    data = json.loads(text)
    found = list(_rs_objects(data, ""))
    views = _of_pair([(name, values) for name, values in found if "ppx" in values], 2)
    between = _of_pair([(name, values) for name, values in found if "translation" in values], 1)
    baseline = next((data[name] for name in RS_BASELINES if isinstance(data, dict) and name in data), None)
    is_posed = len(between) == 1 or (not between and baseline is not None)
    if len(views) != 2 or not is_posed:
        expected = "two rs2 intrinsics (fx, fy, ppx, ppy) of the infrared pair and its extrinsics only"
        hint = "Keep the entries of the infrared pair; a baseline in metres may replace the extrinsics."
        bad_value("the file", expected, f"{len(views)} and {len(between)}", hint)
    left, right = map(_rs_camera, views)
    if not between:
        T = transform(np.eye(3), (-array_of(baseline, (), "the baseline"), 0, 0), "the baseline")
        return _Pair(left, right, T)
    # rs2 stores rotations column-major.
    R = array_of(between[0]["rotation"], (3, 3), "the rotation of the extrinsics").T
    T = transform(R, between[0]["translation"], "the extrinsics")
    # x decreases from the left to the right camera frame; a transform in the other direction is inverted.
    return _Pair(left, right, T if T[0, 3] <= 0 else np.linalg.inv(T))


def _rs_objects(data: Any, name: str) -> Iterator[tuple[str, Entries]]:
    """Yield every object of a JSON value in order, with the path of names to it."""
    if isinstance(data, dict):
        yield name, data
    pairs = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in pairs:
        yield from _rs_objects(value, f"{name}.{key}".lower())


def _of_pair(named: list[tuple[str, Entries]], count: int) -> list[Entries]:
    """Select objects of the pair if there are more than ``count``, excluding names of other cameras."""
    if len(named) > count:
        named = [(name, values) for name, values in named if not RS_OTHERS.search(name)]
    return [values for _, values in named]


def read_realsense(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read the infrared pair, whose images the camera rectifies, or the T265's fisheyes."""
    printed = is_realsense_text(texts[0])
    left, right, T = _rs_printed(texts[0], choice) if printed else _rs_json(texts[0])
    return make_rig(left, right, np.linalg.inv(T), rectified=True)


def _socket(value: Any) -> int:
    """Return the number of a socket from its number (older files) or name; -1 if unknown."""
    return SOCKETS.get(str(value).upper(), -1) if isinstance(value, str) else int(value)


def _oak_camera(cameras: Sockets, socket: int, choice: CameraChoice, with_lens: bool) -> RawCamera:
    """Return the camera, optionally at another resolution of the whole sensor."""
    entries = cameras[socket]
    K = array_of(entries["intrinsicMatrix"], (3, 3), f"intrinsicMatrix of socket {socket}")
    lens = (entries["distortionCoeff"], f"cameraType {entries.get('cameraType', 0)}") if with_lens else ()
    camera = RawCamera(K, (entries["width"], entries["height"]), *lens)
    hint = "For a crop of the sensor, pass --fx --fy --cx --cy --baseline of the cropped image."
    return resized(camera, choice.image_size or camera.size, "the left image", hint)


def _oak_links(cameras: Sockets, socket: int) -> dict[int, np.ndarray]:
    """Return the transform in metres from ``socket`` to every camera linked to it."""
    reached = {socket: np.eye(4)}
    T = np.eye(4)
    while True:
        link = cameras[socket]["extrinsics"]
        where = f"extrinsics of socket {socket}"
        socket = _socket(link["toCameraSocket"])
        if socket not in cameras or socket in reached:
            return reached
        shift_cm = array_of([link["translation"][axis] for axis in "xyz"], (3,), where)
        T = transform(link["rotationMatrix"], shift_cm / CM_PER_METRE, where) @ T
        reached[socket] = T


def read_oak(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read the raw cameras, or with rectifying rotations ``StereoDepth``'s, with the right one's K."""
    data = json.loads(texts[0])
    found = data["cameraData"]  # list of (socket, camera), or an object
    pairs = found.items() if isinstance(found, dict) else found
    cameras: Sockets = {_socket(key): each for key, each in pairs}
    stereo = data.get("stereoRectificationData") or {}
    sides = zip(("leftCameraSocket", "rightCameraSocket"), OAK_PAIR, strict=True)
    pair = [_socket(stereo.get(side, default)) for side, default in sides]
    given = (pair[0], pair[1]) if min(pair) >= 0 else OAK_PAIR
    left, right = two_cameras(choice, cameras, given)
    rectified = (left, right) == given and bool(stereo.get("rectifiedRotationLeft"))
    first, second = (_oak_camera(cameras, socket, choice, not rectified) for socket in (left, right))
    from_left, from_right = _oak_links(cameras, left), _oak_links(cameras, right)
    common = next((socket for socket in from_left if socket in from_right), None)
    if common is None:
        bad_value("extrinsics", f"a chain of links from socket {left} to {right}", "none", "Calibrate again.")
    E = np.linalg.inv(from_left[common]) @ from_right[common]
    if rectified:
        return make_rig(second, second, float(np.linalg.norm(E[:3, 3])), rectified=True)
    return make_rig(first, second, E)
