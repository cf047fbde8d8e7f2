"""Factory calibrations of stereo cameras: ZED, RealSense, OAK-D."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    RawRig,
    array_of,
    intrinsics,
    is_distorted,
    number,
    of_size,
    rigid,
)
from geodiff_plugin.formats.structured import CUT_OFF, parse_ini, parse_json
from geodiff_plugin.types import Distortion

__all__ = ["RS_PRINTED", "read_oak", "read_realsense", "read_zed"]

#: Width and height of the images that a ZED's section is for.
ZED_SIZES = {
    "4K": (3840, 2160),
    "QHDPLUS": (3200, 1800),
    "2K": (2208, 1242),
    "FHD1200": (1920, 1200),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
#: In OpenCV's order, which is that of its models with 5 and with 8 coefficients.
ZED_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
MM_PER_METRE = 1000.0

RS_PRINTED = re.compile(r'^\s*Intrinsic of "', re.MULTILINE)
RS_INTRINSIC = re.compile(
    r'^\s*Intrinsic of "Infrared ([12])" */ *\d+x\d+[^\n]*\n(.*?)(?=\n\s*\n|\Z)', re.M | re.S
)
RS_EXTRINSIC = re.compile(
    r'^\s*Extrinsic from "Infrared 1"\s+To\s+"Infrared 2"[^\n]*\n(.*?)(?=\n\s*Extrinsic|\Z)', re.M | re.S
)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
#: rs2_distortion by its number.
RS_MODELS = (
    *("none", "modified brown conrady", "inverse brown conrady"),
    *("ftheta", "brown conrady", "kannala brandt4"),
)

#: CAM_B and CAM_C, where every OAK-D has its left and its right camera.
OAK_PAIR = (1, 2)
METRES_PER_CENTIMETRE = 0.01
#: dai::CameraModel by its number; the others are none of OpenCV's.
OAK_LENSES = {0: "opencv", 1: "fisheye"}
#: Images of one sensor differ in their ratio of sides by rounding only; beyond this one of them was cropped.
RATIO_TOLERANCE = 0.01

Sockets = dict[int, dict[str, Any]]


def _transform(rotation: Any, translation: Any, name: str, order: Any = "C") -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = array_of(rotation, (9,), f"the rotation of {name}").reshape(3, 3, order=order)
    T[:3, 3] = array_of(translation, (3,), f"the translation of {name}")
    return rigid(T, name)


def read_zed(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The raw images of ``SN<number>.conf`` at the resolution of ``choice.image_size``.

    Lengths are millimetres. ``R = Rodrigues(RX, CV, RZ)`` takes left directions to right ones, and
    ``Baseline``, ``TY``, ``TZ`` point from the left camera to the right one: ``x_right = R x_left - T``.

    Source: calibration.hpp of stereolabs/zed-opencv-native.
    """
    sections = parse_ini(texts[0])

    def entry(section: str, *keys: str) -> float:
        key = next((key for key in keys if sections.has_option(section, key)), keys[-1])
        return number(sections.get(section, key, fallback=None), f"{key} of [{section}]")

    def camera(side: str) -> Camera:
        section = f"{side}_CAM_{name}"
        K = intrinsics(*(entry(section, key) for key in ("fx", "fy", "cx", "cy")))
        has = sections.has_option
        lens = section if any(has(section, key) for key in ZED_LENS) else f"{side}_DISTO"
        count = len(ZED_LENS) if any(has(lens, key) for key in ZED_LENS[5:]) else 5
        coefficients = [entry(lens, key) if has(lens, key) else 0.0 for key in ZED_LENS[:count]]
        return Camera(K, ZED_SIZES[name], coefficients)

    there = {
        size: name
        for name, size in ZED_SIZES.items()
        if all(sections.has_section(f"{side}_CAM_{name}") for side in ("LEFT", "RIGHT"))
    }
    name = of_size(there, choice)
    baseline = entry("STEREO", "Baseline")
    if baseline <= 0:
        bad_value("Baseline of [STEREO]", "above 0", baseline, "Check the calibration file.")
    # Per resolution in some files (TY_HD), once for all in others (TY).
    offsets = [entry("STEREO", f"{key}_{name}", key) for key in ("TY", "TZ")]
    R = Rotation.from_rotvec([entry("STEREO", f"{axis}_{name}") for axis in ("RX", "CV", "RZ")])
    T = _transform(R.as_matrix(), -np.array([baseline, *offsets]) / MM_PER_METRE, "[STEREO]")
    return RawRig(camera("LEFT"), camera("RIGHT"), np.linalg.inv(T))


def _rs_camera(values: dict[str, Any]) -> Camera:
    """A camera of rs2's entries; a lens of coefficients 0 is none, whatever its model."""
    K = intrinsics(*(values[key] for key in ("fx", "fy", "ppx", "ppy")))
    coefficients = array_of(values.get("coeffs", ()), (-1,), "coeffs")
    said = values.get("model", "none")
    said = RS_MODELS[said] if isinstance(said, int) and 0 <= said < len(RS_MODELS) else said
    text = re.sub(r"[\s_]+", " ", str(said).lower()).strip()
    model = text.removeprefix("distortion.").removeprefix("rs2 distortion ")
    if model == "kannala brandt4":
        model, coefficients = "fisheye", coefficients[:4]
    elif model == "brown conrady" or not is_distorted(Distortion("opencv", coefficients)):
        model = "opencv"
    return Camera(K, (values["width"], values["height"]), coefficients, model)


def _rs_printed(text: str, choice: CameraChoice) -> tuple[Camera, Camera, np.ndarray]:
    """Of what ``rs-enumerate-devices -c`` prints, which holds every resolution."""
    cameras: dict[str, dict[tuple[int, int], Camera]] = {"1": {}, "2": {}}
    for side, block in RS_INTRINSIC.findall(text):
        pairs = (line.partition(":") for line in block.splitlines())
        values: dict[str, Any] = {key.strip().lower(): value.strip() for key, _, value in pairs}
        coefficients = NUMBER.findall(values.get("coeffs", ""))
        camera = _rs_camera(values | {"coeffs": coefficients, "model": values.get("distortion", "none")})
        cameras[side].setdefault((int(camera.size[0]), int(camera.size[1])), camera)
    between = RS_EXTRINSIC.search(text)
    if not (cameras["1"] and cameras["2"] and between):
        expected = 'what rs-enumerate-devices -c prints, with "Infrared 1", "Infrared 2" and the extrinsics'
        bad_value("the file", expected, "less", CUT_OFF)
    rotation, _, translation = between[1].partition("Translation")
    left, right = (of_size(cameras[side], choice) for side in "12")
    turn, shift = NUMBER.findall(rotation)[:9], NUMBER.findall(translation)[:3]
    return left, right, _transform(turn, shift, "the extrinsics")


def _objects(value: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every object of a JSON value with the keys that lead to it, in the order of the file."""
    if isinstance(value, dict):
        yield name.lower(), value
        for key, inner in value.items():
            yield from _objects(inner, f"{name}/{key}")
    elif isinstance(value, list):
        for inner in value:
            yield from _objects(inner, name)


def _rs_json(text: str) -> tuple[Camera, Camera, np.ndarray]:
    """Of ``rs2_intrinsics``, left before right, and ``rs2_extrinsics`` between them, under any names."""
    objects = list(_objects(parse_json(text)))
    views = [(name, values) for name, values in objects if "ppx" in values]
    # A file of the whole device has colour and depth too; the pair is the two infrared ones.
    infrared = [view for view in views if re.search(r"infra|left|right|\bir", view[0])]
    views = infrared if len(infrared) >= 2 else views
    other = re.compile("color|depth|imu|gyro|accel")
    between = [values for name, values in objects if "translation" in values and not other.search(name)]
    if len(views) != 2 or len(between) != 1:
        expected = "two rs2 intrinsics (fx, fy, ppx, ppy) of the infrared pair and their extrinsics"
        bad_value("the file", expected, f"{len(views)} and {len(between)}", CUT_OFF)
    # rs2 keeps a rotation column by column.
    T = _transform(between[0]["rotation"], between[0]["translation"], "the extrinsics", "F")
    # From the left to the right one x becomes smaller; a file that says it the other way round is inverted.
    return _rs_camera(views[0][1]), _rs_camera(views[1][1]), T if T[0, 3] <= 0 else np.linalg.inv(T)


def read_realsense(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The infrared pair, whose images the camera rectifies itself, or the T265's fisheyes."""
    printed = RS_PRINTED.search(texts[0]) is not None
    left, right, T = _rs_printed(texts[0], choice) if printed else _rs_json(texts[0])
    lenses = [Distortion(camera.model, np.asarray(camera.coefficients)) for camera in (left, right)]
    return RawRig(left, right, np.linalg.inv(T), rectified=not any(map(is_distorted, lenses)))


def _oak_camera(cameras: Sockets, socket: int, choice: CameraChoice, with_lens: bool) -> Camera:
    """The camera, at another resolution of the whole sensor where one is asked for."""
    if socket not in cameras:
        bad_value("cameras", f"sockets of the file ({', '.join(map(str, sorted(cameras)))})", socket)
    entries = cameras[socket]
    K = array_of(entries["intrinsicMatrix"], (3, 3), f"intrinsicMatrix of socket {socket}")
    size = entries["width"], entries["height"]
    wanted = choice.image_size or size
    if wanted != size:
        s_x, s_y = wanted[0] / size[0], wanted[1] / size[1]
        if abs(s_x / s_y - 1) > RATIO_TOLERANCE:
            cure = "It is a crop of the sensor: give --fx --fy --cx --cy --baseline of the cropped image."
            expected = "of the shape of {}x{} pixels, as the file says".format(*size)
            bad_value("the left image", expected, "{}x{}".format(*wanted), cure)
        K = np.array([[s_x, 0, 0.5 * s_x - 0.5], [0, s_y, 0.5 * s_y - 0.5], [0, 0, 1]]) @ K
    if not with_lens:
        return Camera(K, wanted)
    numbers = array_of(entries["distortionCoeff"], (-1,), "distortionCoeff")
    kind = entries.get("cameraType", 0)
    model = OAK_LENSES.get(kind, f"cameraType {kind}")
    # A fisheye has four, in a list that may be filled up with zeros.
    numbers = numbers if model == "opencv" or numbers[4:].any() else numbers[:4]
    return Camera(K, wanted, numbers, model)


def _oak_links(cameras: Sockets, socket: int) -> dict[int, np.ndarray]:
    """For every camera along the links from ``socket``: takes points of ``socket`` to it."""
    reached, T = {socket: np.eye(4)}, np.eye(4)
    while True:
        link, where = cameras[socket]["extrinsics"], f"extrinsics of socket {socket}"
        socket = link["toCameraSocket"]
        if socket not in cameras or socket in reached:
            return reached
        shift = array_of([link["translation"][axis] for axis in "xyz"], (3,), where) * METRES_PER_CENTIMETRE
        T = _transform(link["rotationMatrix"], shift, where) @ T
        reached[socket] = T


def read_oak(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The rectified images (``rectifiedLeft``, ``rectifiedRight``), at ``choice.image_size``.

    Where the file holds the rectifying rotations, both images are those of a pinhole with the right camera's
    intrinsics, a baseline apart; that is what ``StereoDepth`` makes. Without them, or for other sockets, the
    cameras stand as they are, with their lenses. Lengths are centimetres.
    """
    data = parse_json(texts[0])
    cameras: Sockets = dict(data["cameraData"])  # pairs of a socket and its camera
    stereo = data.get("stereoRectificationData") or {}
    pair = stereo.get("leftCameraSocket", OAK_PAIR[0]), stereo.get("rightCameraSocket", OAK_PAIR[1])
    pair = pair if min(pair) >= 0 else OAK_PAIR
    left, right = choice.cameras or pair
    rectified = (left, right) == pair and bool(stereo.get("rectifiedRotationLeft"))
    first, second = (_oak_camera(cameras, socket, choice, not rectified) for socket in (left, right))
    from_left, from_right = _oak_links(cameras, left), _oak_links(cameras, right)
    common = next((socket for socket in from_left if socket in from_right), None)
    if common is None:
        bad_value("extrinsics", f"a way from socket {left} to {right}", "none", "Calibrate again.")
    E = np.linalg.inv(from_left[common]) @ from_right[common]
    if rectified:
        return RawRig(second, second, float(np.linalg.norm(E[:3, 3])), rectified=True)
    return RawRig(first, second, E)
