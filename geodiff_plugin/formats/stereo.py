"""Readers of calibrations: data sets (S5.1), stereo cameras, robotics, and OpenCV's FileStorage.

OpenCV's own reader is not used: a damaged file can corrupt its memory, and calibrations come from strangers.
"""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value, warn
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
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

MM_PER_METRE, CM_PER_METRE = 1000.0, 100.0
ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Files are printed with three decimals, so an honest cam1 agrees with doffs better than this.
DOFFS_TOLERANCE_PX = 0.05
PROJECTION = re.compile(r"(P_rect_|P)(\d+)")
PAIRS = ((0, 1), (2, 3))
#: Folder names of the benchmarks: image_2 and image_02, and colored_0 of KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")
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
#: CAM_B and CAM_C, an OAK-D's left and right camera.
OAK_PAIR = (1, 2)

Entries = dict[str, Any]
Sockets = dict[int, Entries]


def read_middlebury(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``doffs = cx1 - cx0`` is what the ground truth was made with, so it goes before ``cam1``."""
    entries = dict(ENTRY.findall(texts[0]))
    has_right = "cam1" in entries
    K_left, K_right = (
        array_of(re.split(r"[\s;]+", entries[key].strip("[] \t")), (3, 3), key)
        for key in ("cam0", "cam1" if has_right else "cam0")
    )
    if "doffs" in entries or not has_right:
        cx = K_left[0, 2] + float(entries["doffs"])
        if not has_right or abs(K_right[0, 2] - cx) > DOFFS_TOLERANCE_PX:
            said = f"says cx = {K_right[0, 2]:g}" if has_right else "is missing"
            sentence = f"cam1 {said}; using cx0 + doffs = {cx:g} px for the right image."
            warn(Message("calibration.doffs", sentence))
            K_right[0, 2] = cx
    size = entries.get("width"), entries.get("height")
    baseline_m = float(entries["baseline"]) / MM_PER_METRE
    return make_rig(Camera(K_left, size), Camera(K_right, size), baseline_m, rectified=True)


def read_foundation_stereo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``K.txt``: nine numbers of K of both images, and the baseline in metres."""
    *K, baseline_m = texts[0].replace(",", " ").split()
    if len(K) != 9:
        cure = "Add the baseline as a second line; a file that holds only K or E goes to K and E (--K, --E)."
        bad_value("the file", "9 numbers of K and the baseline in metres", f"{len(K) + 1} numbers", cure)
    return make_rig(Camera(K), Camera(K), baseline_m)


def read_stereodemo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Older files have one principal point for both images."""
    data = json.loads(texts[0])
    size = data.get("width"), data.get("height")
    columns = ("cx", "cx") if "cx" in data else ("cx0", "cx1")
    left, right = (Camera(intrinsics(data["fx"], data["fy"], data[cx], data["cy"]), size) for cx in columns)
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
        which = "Of the grey pair 0,1 and the colour pair 2,3 of the calibration 2,3 is taken."
        warn(Message("calibration.kitti-cameras", f"{which} Give cameras (--cameras)."))
    return two_cameras(choice, have, pairs[-1])


def read_kitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P_rect_02`` with ``S_rect_02`` of ``calib_cam_to_cam``, or ``P0`` to ``P3``; DrivingStereo's too."""
    rows = {key: words.split() for key, words in re.findall(r"(?m)^\s*(\w+)\s*:(.*)$", texts[0])}
    named = {int(match[2]): match for match in map(PROJECTION.fullmatch, rows) if match}
    left, right = (named[camera] for camera in _kitti_cameras(named, choice))
    P = (array_of(rows[match[0]], (3, 4), match[0]) for match in (left, right))
    return projected(*P, *(rows.get(f"S_rect_{match[2]}") for match in (left, right)))


def read_mvsnet(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """One ``cam.txt`` a view, in the unit of the files: metres in most sets, millimetres in DTU."""
    poses, cameras = [], []
    for text in texts:
        extrinsic, _, intrinsic = text.partition("extrinsic")[2].partition("intrinsic")
        # The rotations of hand-held sets are rigid to a few 1e-4; inverting them as they are would shear E.
        poses.append(rigid(extrinsic.split()[:16], "extrinsic"))
        cameras.append(Camera(intrinsic.split()[:9]))  # a line of depth range stands behind
    return make_rig(cameras[0], cameras[1], poses[0] @ np.linalg.inv(poses[1]))


def read_zed(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The raw images of ``SN<number>.conf`` at the resolution of ``choice.image_size``; millimetres.

    ``x_right = Rodrigues(RX, CV, RZ) x_left - T``. Source: calibration.hpp of stereolabs/zed-opencv-native.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read_string(texts[0])
    sections: dict[str, Entries] = {name: dict(section) for name, section in parser.items()}
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


def _rs_camera(values: Entries) -> Camera:
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
        values: Entries = {key.strip().lower(): value.strip() for key, _, value in pairs}
        values |= {"coeffs": NUMBER.findall(values.get("coeffs", "")), "model": values.get("distortion")}
        cameras[side].setdefault((int(values["width"]), int(values["height"])), _rs_camera(values))
    left, right = (of_size(cameras[side], choice) for side in "12")
    between = [*RS_EXTRINSIC.findall(text), ""][0]
    rotation, translation = (NUMBER.findall(part) for part in between.partition("Translation")[::2])
    return left, right, transform(rotation[:9], translation[:3], "the extrinsics")


def _rs_json(text: str) -> tuple[Camera, Camera, np.ndarray]:
    """Of ``rs2_intrinsics``, left before right, and ``rs2_extrinsics`` between them, under any names."""
    objects = list[Entries]()
    json.loads(text, object_hook=objects.append)
    views = [values for values in objects if "ppx" in values]
    between = [values for values in objects if "translation" in values]
    if len(views) != 2 or len(between) != 1:
        expected = "two rs2 intrinsics (fx, fy, ppx, ppy), of the infrared pair, and their extrinsics alone"
        bad_value("the file", expected, f"{len(views)} and {len(between)}", "Is the file cut off?")
    # rs2 keeps a rotation column by column.
    R = array_of(between[0]["rotation"], (3, 3), "the rotation of the extrinsics").T
    T = transform(R, between[0]["translation"], "the extrinsics")
    # From the left to the right one x becomes smaller; a file that says it the other way round is inverted.
    return _rs_camera(views[0]), _rs_camera(views[1]), T if T[0, 3] <= 0 else np.linalg.inv(T)


def read_realsense(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The infrared pair, whose images the camera rectifies itself, or the T265's fisheyes."""
    printed = re.search(RS_PRINTED, texts[0], re.MULTILINE)
    left, right, T = _rs_printed(texts[0], choice) if printed else _rs_json(texts[0])
    return make_rig(left, right, np.linalg.inv(T), rectified=True)


def _oak_camera(cameras: Sockets, socket: int, choice: CameraChoice, with_lens: bool) -> Camera:
    """The camera, at another resolution of the whole sensor where one is asked for."""
    entries = cameras[socket]
    K = array_of(entries["intrinsicMatrix"], (3, 3), f"intrinsicMatrix of socket {socket}")
    lens = (entries["distortionCoeff"], f"cameraType {entries.get('cameraType', 0)}") if with_lens else ()
    camera = Camera(K, (entries["width"], entries["height"]), *lens)
    cure = "It is a crop of the sensor: give --fx --fy --cx --cy --baseline of the cropped image."
    return resized(camera, choice.image_size or camera.size, "the left image", cure)


def _oak_links(cameras: Sockets, socket: int) -> dict[int, np.ndarray]:
    """For every camera along the links from ``socket``: takes points of ``socket`` to it, in metres."""
    reached, T = {socket: np.eye(4)}, np.eye(4)
    while True:
        link, where = cameras[socket]["extrinsics"], f"extrinsics of socket {socket}"
        socket = link["toCameraSocket"]
        if socket not in cameras or socket in reached:
            return reached
        shift_cm = array_of([link["translation"][axis] for axis in "xyz"], (3,), where)
        T = transform(link["rotationMatrix"], shift_cm / CM_PER_METRE, where) @ T
        reached[socket] = T


def read_oak(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The cameras as they stand, or, by rectifying rotations, ``StereoDepth``'s, with the right one's K."""
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


# YAML and OpenCV's FileStorage

#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")
ORB_LENSES = {"PinHole": ("k1", "k2", "p1", "p2", "k3"), "KannalaBrandt8": ("k1", "k2", "k3", "k4")}
#: The right camera's pose in the left one's frame, in settings of version 1.0 and in older ones.
ORB_POSES = ("Stereo.T_c1_c2", "Tlr")
#: The baseline of rectified images and their types, by the left camera's name: settings of version 1.0 say
#: that they are rectified, older ones call them a pinhole's.
ORB_RECTIFIED = {"Camera1": ("Stereo.b", ("Rectified",)), "Camera": ("Camera.bf", ("Rectified", "PinHole"))}


class _Loader(yaml.SafeLoader):
    """YAML as OpenCV writes it: its matrices, since OpenCV 5 of one axis too, are mappings like others."""


for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", lambda loader, node: loader.construct_mapping(node, deep=True)
    )


def _yaml(text: str) -> Entries:
    """The mapping that the first YAML document holds; later documents (``rostopic echo``) are left out."""
    content = next(yaml.load_all(OPENCV_HEAD.sub("", text), _Loader), None)  # noqa: S506  (a safe one)
    if not isinstance(content, dict):
        bad_value("the file", "a YAML file of named entries", type(content).__name__)
    return content


def _storage(text: str) -> Entries:
    """The entries of an OpenCV file by key in small letters: numbers as flat arrays, and strings."""
    if "<opencv_storage" in text:
        if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
            bad_value("the file", "an OpenCV XML file", "a document type with entities", "Remove it.")
        content = _of_element(ElementTree.fromstring(text.strip()))
    else:  # JSON is YAML; older versions of OpenCV write 1. and .Nan into it, which JSON itself does not know
        content = _yaml(text)
    maps = [value for value in content.values() if isinstance(value, dict) and "data" not in value]
    entries: Entries = {}
    for key, value in [item for each in (*maps, content) for item in each.items()]:
        numbers = _numbers(value["data"] if isinstance(value, dict) and "data" in value else value)
        entries[str(key).lower()] = value if numbers is None else numbers
    return entries


def _of_element(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _of_element(child) for child in node}
    words = (node.text or "").split()
    return words[0] if len(words) == 1 and node.tag != "data" else words


def _numbers(value: Any) -> np.ndarray | None:
    """A number or a flat list of numbers, some of which may be text; ``None`` for other things."""
    words = value if isinstance(value, list) else [value]
    try:  # OpenCV writes .Nan and .Inf, which Python reads without the dot
        words = [re.sub(r"\.(nan|inf)", r"\1", w.lower()) if isinstance(w, str) else w for w in words]
        return None if any(isinstance(w, bool) for w in words) else np.array([float(w) for w in words])
    except (TypeError, ValueError, OverflowError):
        return None


def _pinhole(entries: Entries, coefficients: str) -> Camera:
    """A camera of Kalibr or EuRoC; ``coefficients`` names the entry with those of its lens."""
    model = entries["camera_model"]  # of another one the lens is refused
    model = str(entries["distortion_model"] if model == "pinhole" else model)
    return Camera(
        intrinsics(*entries["intrinsics"][-4:]), entries["resolution"], entries[coefficients], model
    )


def read_kalibr(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Two cameras of a chain, cam0 and cam1 unless chosen; ``T_cn_cnm1`` takes points to a camera."""
    chain = _yaml(texts[0])
    pair = two_cameras(choice, [n for n in range(len(chain)) if f"cam{n}" in chain], (0, 1))
    from_first = [np.eye(4)]
    for n in range(1, max(pair) + 1):
        from_first.append(rigid(chain[f"cam{n}"]["T_cn_cnm1"], f"T_cn_cnm1 of cam{n}") @ from_first[-1])
    left, right = (_pinhole(chain[f"cam{n}"], "distortion_coeffs") for n in pair)
    return make_rig(left, right, from_first[pair[0]] @ np.linalg.inv(from_first[pair[1]]))


def read_euroc(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The images as taken, left file first; ``T_BS`` is a camera's pose in the body's frame, in metres."""
    sensors = [_yaml(text) for text in texts]
    T_body_left, T_body_right = (rigid(sensor["T_BS"]["data"], "T_BS") for sensor in sensors)
    left, right = (_pinhole(sensor, "distortion_coefficients") for sensor in sensors)
    return make_rig(left, right, np.linalg.inv(T_body_left) @ T_body_right)


def _projection(info: Entries) -> np.ndarray:
    """``P`` of a file of ``camera_calibration``, or of the message as ROS 1 or ROS 2 prints it."""
    matrix = next((info[name] for name in ("projection_matrix", "P", "p") if name in info), None)
    return array_of(matrix.get("data") if isinstance(matrix, dict) else matrix, (3, 4), "projection_matrix")


def read_ros(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Files of ``camera_calibration``, or the message as ``echo`` prints it: the rectified images, by ``P``.

    Those that say ``rectified: false`` (``recordings.stereo_calibration``) stand for the images as taken.
    """
    infos = [_yaml(text) for text in texts]
    sizes = [(i.get("image_width", i.get("width")), i.get("image_height", i.get("height"))) for i in infos]
    rig = projected(*map(_projection, infos), *sizes)
    if not rig.E[:3, 3].any():
        expected = "-fx * baseline in the right camera's file"
        cure = "These are of single cameras. Calibrate the pair (camera_calibration with two topics)."
        bad_value("projection_matrix[0, 3]", expected, "the same in both", cure)
    if all(info.get("rectified", True) for info in infos):
        return rig
    left, right = (transform(info["R"], (0, 0, 0), "R") for info in infos)
    cameras = [
        Camera(info["K"], size, info["D"], str(info["distortion_model"]))
        for info, size in zip(infos, sizes, strict=True)
    ]
    return make_rig(cameras[0], cameras[1], np.linalg.inv(left) @ rig.E @ right)


def _orb_camera(entries: Entries, name: str, kind: str) -> Camera:
    """The camera of a name; a pinhole may leave coefficients out, which are 0 then."""
    keys, default = ("fx", "fy", "cx", "cy", *ORB_LENSES.get(kind, ())), 0.0 if kind == "PinHole" else None
    given = {key: entries.get(f"{name}.{key}".lower(), default if key[0] in "kp" else None) for key in keys}
    numbers = [array_of(value, (), f"{name}.{key}") for key, value in given.items()]
    size = [entries.get(f"camera.{side}", [None])[0] for side in ("width", "height")]
    return Camera(intrinsics(*numbers[:4]), size, numbers[4:], kind)


def read_orb_slam(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The images as taken, by ``Stereo.T_c1_c2`` (or ``Tlr``), else rectified images of one K, in metres."""
    entries = _storage(texts[0])
    kind = entries.get("camera.type", "PinHole")
    left = "Camera1" if "camera1.fx" in entries else "Camera"
    pose = next((name for name in ORB_POSES if name.lower() in entries), None)
    if pose is not None:
        first, second = (_orb_camera(entries, name, kind) for name in (left, "Camera2"))
        return make_rig(first, second, rigid(entries[pose.lower()], pose))
    baseline, types = ORB_RECTIFIED[left]
    # Of a single camera with a depth sensor, the baseline is made up.
    depth_sensor = any(key.endswith("depthmapfactor") for key in entries)
    if depth_sensor or baseline.lower() not in entries or kind not in types:
        expected = f"of a stereo camera, with {ORB_POSES[0]}, or {baseline} of rectified images"
        got = f"of a camera of type {kind} {'with a depth sensor' if depth_sensor else 'without them'}"
        bad_value("the settings", expected, got, "Give the settings that ORB-SLAM runs in stereo with.")
    camera = _orb_camera(entries, left, "PinHole")
    if np.any(camera.coefficients):
        expected = f"zero for rectified images, which have no {ORB_POSES[0]}"
        bad_value(f"Lens distortion of {left}", expected, "another", "Is it of a single camera?")
    length = array_of(entries[baseline.lower()], (), baseline)
    return make_rig(camera, camera, length / (1.0 if left == "Camera1" else camera.K[0, 0]), rectified=True)


def _of(words: str, number: str, side: str) -> str:
    """Names of a matrix of one camera: its number, letter or side behind a word, or the side before it."""
    return f"(?:{words})(?:{number}|{side[0]}|{side})|{side}(?:{words})"


WORDS = {
    "M": "m|k|mtx|cameramatrix|intrinsics?|intrinsicmatrix",
    "D": "d|dis|dist|distcoeffs?|distcoefs?|distort|distortion|distortioncoefficients|distortioncoeffs",
    "P": "p|projection|projectionmatrix|projmat|projmatrix",
}
#: Name in OpenCV's samples -> names in use for the same thing, in small letters without "_" and ".": the
#: arguments of stereoCalibrate, what tutorials call them, ORB-SLAM's ``LEFT.P``.
NAMES = {
    **{f"{name}1": _of(words, "1", "left") for name, words in WORDS.items()},
    **{f"{name}2": _of(words, "2", "right") for name, words in WORDS.items()},
    "R": "r|rot|rotation|rotationmatrix",
    "T": "t|trans|translation|translationmatrix|translationvector",
    "image_size": "imagesize|imgres|imgsize|size",
    "image_width": "imagewidth|leftwidth",
    "image_height": "imageheight|leftheight",
}
#: Those that are one number; what else is a number, such as a coefficient ``k1``, is none of the matrices.
NUMBERS = ("image_width", "image_height")
Arrays = list[tuple[str, np.ndarray]]


def _named(arrays: Arrays) -> Entries:
    """What ``NAMES`` has of the arrays, by its names; those that differ under one name are refused."""
    named: Entries = {}
    for name, words in NAMES.items():
        fits = [(key, v) for key, v in arrays if (v.size == 1) == (name in NUMBERS)]
        fits = [(key, v) for key, v in fits if re.fullmatch(words, re.sub("[_.]", "", key))]
        if any(not np.array_equal(v, fits[0][1]) for _, v in fits[1:]):
            cure = "Keep those that belong to R and T; files of single cameras have no baseline."
            bad_value(name, "there once", f"{', '.join(key for key, _ in fits)}, which differ", cure)
        if fits:
            named[name] = fits[0][1]
    return named


def _lenses(arrays: Arrays, named: Entries) -> list[Any]:
    """``D1`` and ``D2``, or none; without one that has another name, images would pass for a pinhole's."""
    given = [named[name] for name in ("D1", "D2") if name in named]
    others = [key for key, v in arrays if "dist" in key and v.size > 1 and not any(v is d for d in given)]
    if len(given) < 2 and (others or np.any(given)):
        cure = "Rename what is lens distortion to D1 and D2, and what is not; a lens without any has zeros."
        bad_value("the lens distortion", "of both cameras (D1, D2)", ", ".join(others) or "one of them", cure)
    return given if len(given) == 2 else [(), ()]


def read_opencv(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P1, P2`` of rectified images, else ``M1, M2, R, T`` and ``D1, D2``; lengths are taken as metres."""
    arrays = [item for text in texts for item in _storage(text).items() if isinstance(item[1], np.ndarray)]
    named = _named(arrays)
    sides = np.array([named[name].item() for name in NUMBERS if name in named])
    size = next((pair for pair in (named.get("image_size", sides), sides) if pair.size == 2), None)
    if named.keys() >= {"P1", "P2"}:
        return projected(named["P1"], named["P2"], size, size)
    missing = [name for name in ("M1", "M2", "R", "T") if name not in named]
    if missing:
        expected = "an OpenCV calibration with P1, P2, or with M1, M2, R, T"
        cure = "Where intrinsics and extrinsics are two files, give both; rename what has other names."
        bad_value("the file", expected, f"no {', '.join(missing)}", cure)
    lenses = zip(("M1", "M2"), _lenses(arrays, named), strict=True)
    left, right = (Camera(named[name], size, lens) for name, lens in lenses)
    return make_rig(left, right, np.linalg.inv(transform(named["R"], named["T"], "R, T")))


def read_booster(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """For the images at full resolution, which are rectified; lengths are millimetres."""
    entries = _storage(texts[0])
    left, right = (Camera(array_of(entries[key], (3, -1), key)[:, :3]) for key in ("proj_matl", "proj_matr"))
    return make_rig(left, right, entries["baselinelr"].item() / MM_PER_METRE, rectified=True)
