"""Calibrations of data sets (S5.1) and stereo cameras: KITTI, Middlebury, MVSNet, ZED, RealSense, OAK-D."""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value, warn
from geodiff_plugin.formats.depth import KITTI_ROW
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    of_size,
    projected,
    resized,
    rigid,
    transform,
    two_cameras,
)
from geodiff_plugin.types import Rig

MM_PER_METRE = 1000.0
ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Files are printed with three decimals, so an honest cam1 agrees with doffs better than this.
DOFFS_TOLERANCE_PX = 0.05
PROJECTION = re.compile(r"(P_rect_|P)(\d+)")
#: KITTI's grey pair and colour pair.
PAIRS = ((0, 1), (2, 3))
#: Folder names of the benchmarks: image_2 and image_02, and colored_0 of KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")
WHICH = (
    "Of the grey pair 0,1 and the colour pair 2,3 of the calibration 2,3 is taken. Give cameras (--cameras)."
)
#: Width and height of the images that a ZED's section is for.
ZED_SIZES = {
    **{"4K": (3840, 2160), "QHDPLUS": (3200, 1800), "2K": (2208, 1242), "FHD1200": (1920, 1200)},
    **{"FHD": (1920, 1080), "HD": (1280, 720), "SVGA": (960, 600), "VGA": (672, 376)},
}
#: In OpenCV's order, which is that of its models with 5 and with 8 coefficients.
ZED_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

RS_PRINTED = r'^\s*Intrinsic of "'
RS_INTRINSIC = re.compile(
    r'^\s*Intrinsic of "Infrared ([12])" */ *\d+x\d+[^\n]*\n(.*?)(?=\n\s*\n|\Z)', re.M | re.S
)
RS_EXTRINSIC = re.compile(
    r'^\s*Extrinsic from "Infrared 1"\s+To\s+"Infrared 2"[^\n]*\n(.*?)(?=\n\s*Extrinsic|\Z)', re.M | re.S
)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
#: CAM_B and CAM_C, where every OAK-D has its left and its right camera.
OAK_PAIR = (1, 2)
METRES_PER_CENTIMETRE = 0.01

Sockets = dict[int, dict[str, Any]]


def _matrix(entries: dict[str, str], key: str) -> np.ndarray:
    value = entries[key]
    if not value.endswith("]"):
        bad_value(key, "[f 0 cx; 0 f cy; 0 0 1]", repr(value), "Is the file cut off?")
    return array_of([row.split() for row in value.strip("[]").split(";")], (3, 3), key)


def read_middlebury(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``doffs = cx1 - cx0`` is what the ground truth was made with, so it goes before ``cam1``."""
    entries = dict(ENTRY.findall(texts[0]))
    K_left = _matrix(entries, "cam0")
    K_right = _matrix(entries, "cam1") if "cam1" in entries else None
    if K_right is None or "doffs" in entries:
        expected = K_left[0, 2] + float(entries["doffs"])
        if K_right is None or abs(K_right[0, 2] - expected) > DOFFS_TOLERANCE_PX:
            said = "is missing" if K_right is None else f"says cx = {K_right[0, 2]:g}"
            warn(f"cam1 {said}; using cx0 + doffs = {expected:g} px for the right image.")
            K_right = K_left.copy() if K_right is None else K_right
            K_right[0, 2] = expected
    size = entries.get("width"), entries.get("height")
    baseline_m = float(entries["baseline"]) / MM_PER_METRE
    return make_rig(Camera(K_left, size), Camera(K_right, size), baseline_m, rectified=True)


def read_foundation_stereo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``K.txt``: nine numbers of K of both images, and the baseline in metres."""
    values = texts[0].replace(",", " ").split()
    if len(values) != 10:
        cure = "Add the baseline as a second line; a file that holds only K or E goes to K and E (--K, --E)."
        bad_value("the file", "9 numbers of K and the baseline in metres", f"{len(values)} numbers", cure)
    camera = Camera(array_of(values[:9], (3, 3), "K"))
    return make_rig(camera, camera, values[9])


def read_stereodemo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Older files have one principal point for both images."""
    data = json.loads(texts[0])
    size = data.get("width"), data.get("height")
    left, right = (
        Camera(intrinsics(data["fx"], data["fy"], data["cx" if "cx" in data else cx], data["cy"]), size)
        for cx in ("cx0", "cx1")
    )
    return make_rig(left, right, data["baseline_meters"])


def _kitti_cameras(available: Collection[int], choice: CameraChoice) -> tuple[int, int]:
    """The pair that was given, else of the image folder's name, else the colour pair, else the only one."""
    have = sorted(available)
    pairs = [pair for pair in PAIRS if set(pair) <= set(have)] or [(have[0], have[-1])]
    for kind, camera in FOLDER.findall(str(choice.image_folder_hint))[-1:]:
        pair = PAIRS[kind == "colored" or int(camera) >= 2]
        if pair in pairs:
            return two_cameras(choice, have, pair)
    if len(pairs) > 1 and choice.cameras is None:
        warn(WHICH)
    return two_cameras(choice, have, pairs[-1])


def read_kitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P_rect_02`` with ``S_rect_02`` of ``calib_cam_to_cam``, or ``P0`` to ``P3``; DrivingStereo's too."""
    rows = dict(KITTI_ROW.findall(texts[0]))
    named = {int(match[2]): match for match in map(PROJECTION.fullmatch, rows) if match}
    cameras = [named[camera] for camera in _kitti_cameras(named, choice)]
    P = [array_of(rows[camera[0]].split(), (3, 4), camera[0]) for camera in cameras]
    sizes = [rows.get(f"S_rect_{camera[2]}") for camera in cameras]
    return projected(*P, *(None if size is None else size.split() for size in sizes))


def _mvsnet_view(text: str) -> tuple[np.ndarray, Camera]:
    """World-to-camera transform and camera; the line of depth range behind them is never looked at."""
    extrinsic, _, intrinsic = text.partition("extrinsic")[2].partition("intrinsic")
    # The rotations of hand-held sets are rigid to a few 1e-4 only; inverting them as they are would shear E.
    T = rigid(extrinsic.split()[:16], "extrinsic")
    return T, Camera(array_of(intrinsic.split()[:9], (3, 3), "intrinsic"))


def read_mvsnet(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """One ``cam.txt`` a view, in the unit of the files: metres in most sets, millimetres in DTU."""
    (T_left_from_world, left), (T_right_from_world, right) = map(_mvsnet_view, texts)
    return make_rig(left, right, T_left_from_world @ np.linalg.inv(T_right_from_world))


def read_zed(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The raw images of ``SN<number>.conf`` at the resolution of ``choice.image_size``; millimetres.

    ``R = Rodrigues(RX, CV, RZ)`` takes left directions to right ones: ``x_right = R x_left - T``.

    Source: calibration.hpp of stereolabs/zed-opencv-native.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read_string(texts[0])
    sections: dict[str, Any] = {name: dict(section) for name, section in parser.items()}
    there = [name for name in ZED_SIZES if {f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}"} <= sections.keys()]
    name = of_size({ZED_SIZES[name]: name for name in there}, choice)
    cameras = []
    for side in ("LEFT", "RIGHT"):
        section = sections[f"{side}_CAM_{name}"]
        lens = sections.get(f"{side}_DISTO", {}) | section
        keys = ZED_LENS if lens.keys() & set(ZED_LENS[5:]) else ZED_LENS[:5]
        K = intrinsics(*(section[key] for key in ("fx", "fy", "cx", "cy")))
        cameras.append(Camera(K, ZED_SIZES[name], [lens.get(key, 0.0) for key in keys]))
    # Keys are small here; per resolution in some files (TY_HD), once for all in others (TY).
    stereo, at = sections["STEREO"], f"_{name.lower()}"
    shift = [stereo["baseline"], *(stereo.get(key + at, stereo.get(key)) for key in ("ty", "tz"))]
    turn = array_of([stereo[key + at] for key in ("rx", "cv", "rz")], (3,), "RX, CV, RZ of [STEREO]")
    shift_m = -array_of(shift, (3,), "Baseline, TY, TZ of [STEREO]") / MM_PER_METRE
    T = transform(Rotation.from_rotvec(turn).as_matrix(), shift_m, "[STEREO]")
    return make_rig(cameras[0], cameras[1], np.linalg.inv(T))


def _rs_camera(values: dict[str, Any]) -> Camera:
    """A camera of rs2's entries; a lens of coefficients 0 is none, whatever its model."""
    K = intrinsics(*(values[key] for key in ("fx", "fy", "ppx", "ppy")))
    coefficients = array_of(values.get("coeffs", ()), (-1,), "coeffs")
    model = re.sub(r"^.*distortion|[^a-z0-9]", "", str(values.get("model", "none")).lower())
    model = {"4": "brownconrady", "5": "kannalabrandt4"}.get(model, model)  # the numbers of rs2_distortion
    if model != "kannalabrandt4" and not coefficients.any():
        model = "none"
    return Camera(K, (values["width"], values["height"]), coefficients, model)


def _rs_printed(text: str, choice: CameraChoice) -> tuple[Camera, Camera, np.ndarray]:
    """Of what ``rs-enumerate-devices -c`` prints, which holds every resolution."""
    cameras: dict[str, dict[tuple[int, int], Camera]] = {"1": {}, "2": {}}
    for side, block in RS_INTRINSIC.findall(text):
        pairs = (line.partition(":") for line in block.splitlines())
        values: dict[str, Any] = {key.strip().lower(): value.strip() for key, _, value in pairs}
        values |= {"coeffs": NUMBER.findall(values.get("coeffs", "")), "model": values.get("distortion")}
        cameras[side].setdefault((int(values["width"]), int(values["height"])), _rs_camera(values))
    between = RS_EXTRINSIC.search(text)
    if not (cameras["1"] and cameras["2"] and between):
        expected = 'what rs-enumerate-devices -c prints, with "Infrared 1", "Infrared 2" and the extrinsics'
        bad_value("the file", expected, "less", "Is the file cut off?")
    left, right = (of_size(cameras[side], choice) for side in "12")
    rotation, translation = (NUMBER.findall(part) for part in between[1].partition("Translation")[::2])
    return left, right, transform(rotation[:9], translation[:3], "the extrinsics")


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
    objects = list(_objects(json.loads(text)))
    views = [(name, values) for name, values in objects if "ppx" in values]
    # A file of the whole device has colour and depth too; the pair is the two infrared ones.
    infrared = [view for view in views if re.search(r"infra|left|right|\bir", view[0])]
    views = infrared if len(infrared) >= 2 else views
    other = re.compile("color|depth|imu|gyro|accel")
    between = [values for name, values in objects if "translation" in values and not other.search(name)]
    if len(views) != 2 or len(between) != 1:
        expected = "two rs2 intrinsics (fx, fy, ppx, ppy) of the infrared pair and their extrinsics"
        bad_value("the file", expected, f"{len(views)} and {len(between)}", "Is the file cut off?")
    # rs2 keeps a rotation column by column.
    R = array_of(between[0]["rotation"], (3, 3), "the rotation of the extrinsics").T
    T = transform(R, between[0]["translation"], "the extrinsics")
    # From the left to the right one x becomes smaller; a file that says it the other way round is inverted.
    return _rs_camera(views[0][1]), _rs_camera(views[1][1]), T if T[0, 3] <= 0 else np.linalg.inv(T)


def read_realsense(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The infrared pair, whose images the camera rectifies itself, or the T265's fisheyes."""
    printed = re.search(RS_PRINTED, texts[0], re.MULTILINE)
    left, right, T = _rs_printed(texts[0], choice) if printed else _rs_json(texts[0])
    return make_rig(left, right, np.linalg.inv(T), rectified=True)


def _oak_camera(cameras: Sockets, socket: int, choice: CameraChoice, with_lens: bool) -> Camera:
    """The camera, at another resolution of the whole sensor where one is asked for."""
    entries = cameras[socket]
    K = array_of(entries["intrinsicMatrix"], (3, 3), f"intrinsicMatrix of socket {socket}")
    camera = Camera(K, (entries["width"], entries["height"]))
    if with_lens:
        model = f"cameraType {entries.get('cameraType', 0)}"
        camera = replace(camera, coefficients=entries["distortionCoeff"], model=model)
    cure = "It is a crop of the sensor: give --fx --fy --cx --cy --baseline of the cropped image."
    return resized(camera, choice.image_size or camera.size, "the left image", cure)


def _oak_links(cameras: Sockets, socket: int) -> dict[int, np.ndarray]:
    """For every camera along the links from ``socket``: takes points of ``socket`` to it."""
    reached, T = {socket: np.eye(4)}, np.eye(4)
    while True:
        link, where = cameras[socket]["extrinsics"], f"extrinsics of socket {socket}"
        socket = link["toCameraSocket"]
        if socket not in cameras or socket in reached:
            return reached
        shift = array_of([link["translation"][axis] for axis in "xyz"], (3,), where) * METRES_PER_CENTIMETRE
        T = transform(link["rotationMatrix"], shift, where) @ T
        reached[socket] = T


def read_oak(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The rectified images, at ``choice.image_size``, or the cameras as they stand; centimetres.

    Where the file holds the rectifying rotations, both images have the right camera's K, as ``StereoDepth``
    makes them.
    """
    data = json.loads(texts[0])
    cameras: Sockets = dict(data["cameraData"])  # pairs of a socket and its camera
    stereo = data.get("stereoRectificationData") or {}
    pair = stereo.get("leftCameraSocket", OAK_PAIR[0]), stereo.get("rightCameraSocket", OAK_PAIR[1])
    pair = pair if min(pair) >= 0 else OAK_PAIR
    left, right = two_cameras(choice, cameras, pair)
    rectified = (left, right) == pair and bool(stereo.get("rectifiedRotationLeft"))
    first, second = (_oak_camera(cameras, socket, choice, not rectified) for socket in (left, right))
    from_left, from_right = _oak_links(cameras, left), _oak_links(cameras, right)
    common = next((socket for socket in from_left if socket in from_right), None)
    if common is None:
        bad_value("extrinsics", f"a way from socket {left} to {right}", "none", "Calibrate again.")
    E = np.linalg.inv(from_left[common]) @ from_right[common]
    if rectified:
        return make_rig(second, second, float(np.linalg.norm(E[:3, 3])), rectified=True)
    return make_rig(first, second, E)
