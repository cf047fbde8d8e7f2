"""Calibrations that robotics and OpenCV use: Kalibr, EuRoC, ROS camera_info, ORB-SLAM, FileStorage, Booster.

OpenCV's own reader is not used: a damaged file can corrupt its memory, and calibrations come from strangers.
"""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    projected,
    rigid,
    transform,
    two_cameras,
)
from geodiff_plugin.types import Rig

MM_PER_METRE = 1000.0
#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")
CALIBRATE_PAIR = "Calibrate the pair (camera_calibration with two topics)."
#: Which coefficients a lens has, by ORB-SLAM's ``Camera.type``.
ORB_LENSES = {"PinHole": ("k1", "k2", "p1", "p2", "k3"), "KannalaBrandt8": ("k1", "k2", "k3", "k4")}
#: The right camera's pose in the left one's frame, in settings of version 1.0 and in older ones.
ORB_POSES = ("Stereo.T_c1_c2", "Tlr")
#: The baseline of rectified images and their types, by the left camera's name: settings of version 1.0 say
#: that they are rectified, older ones call them a pinhole's.
ORB_RECTIFIED = {"Camera1": ("Stereo.b", ("Rectified",)), "Camera": ("Camera.bf", ("Rectified", "PinHole"))}

Entries = dict[str, Any]


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
    if entries["camera_model"] != "pinhole":
        cure = "Calibrate with pinhole-radtan or pinhole-equi, or undistort the images to a pinhole first."
        bad_value("camera_model", "pinhole", repr(entries["camera_model"]), cure)
    K = intrinsics(*entries["intrinsics"])
    return Camera(K, entries["resolution"], entries[coefficients], str(entries["distortion_model"]))


def read_kalibr(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Two cameras of a chain, cam0 and cam1 unless chosen; ``T_cn_cnm1`` takes points to a camera."""
    chain = _yaml(texts[0])
    pair = two_cameras(choice, [n for n in range(len(chain)) if f"cam{n}" in chain], (0, 1))
    from_first = [np.eye(4)]
    for n in range(1, max(pair) + 1):
        step = rigid(chain[f"cam{n}"]["T_cn_cnm1"], f"T_cn_cnm1 of cam{n}")
        from_first.append(step @ from_first[-1])
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
    if matrix is None:
        bad_value("the file", "a camera_info with projection_matrix (or P)", "none", "Is the file cut off?")
    P = array_of(matrix.get("data") if isinstance(matrix, dict) else matrix, (3, 4), "projection_matrix")
    if not P.any():
        refuse(f"the camera is not calibrated: its projection_matrix (P) is all zeros. {CALIBRATE_PAIR}")
    return P


def read_ros(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Files of ``camera_calibration``, or the message as ``echo`` prints it: the rectified images, by ``P``.

    Those that say ``rectified: false`` (``recordings.stereo_calibration``) stand for the images as taken.
    """
    infos = [_yaml(text) for text in texts]
    sizes = [(i.get("image_width", i.get("width")), i.get("image_height", i.get("height"))) for i in infos]
    raw = projected(*map(_projection, infos), *sizes)
    if not raw.E[:3, 3].any():
        expected = "-fx * baseline in the right camera's file"
        cure = f"These are of single cameras. {CALIBRATE_PAIR}"
        bad_value("projection_matrix[0, 3]", expected, "the same in both", cure)
    if all(info.get("rectified", True) for info in infos):
        return raw
    turns, cameras = [], []
    for info, size in zip(infos, sizes, strict=True):
        turns.append(transform(info["R"], (0, 0, 0), "R"))
        model = str(info["distortion_model"])
        cameras.append(Camera(array_of(info["K"], (3, 3), "K"), size, info["D"], model))
    return make_rig(cameras[0], cameras[1], np.linalg.inv(turns[0]) @ raw.E @ turns[1])


def _orb_camera(entries: Entries, name: str, kind: str) -> Camera:
    """The camera of a name; a pinhole may leave its coefficients out, or the last one."""
    lens = ORB_LENSES[kind]
    there = [key for key in lens if f"{name}.{key}".lower() in entries]
    keys = ("fx", "fy", "cx", "cy", *(() if kind == "PinHole" and not there else lens[: max(4, len(there))]))
    numbers = [float(array_of(entries.get(f"{name}.{key}".lower()), (), f"{name}.{key}")) for key in keys]
    size = [entries.get(f"camera.{side}", [None])[0] for side in ("width", "height")]
    return Camera(intrinsics(*numbers[:4]), size, numbers[4:], kind)


def read_orb_slam(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The images as taken, by ``Stereo.T_c1_c2`` (or ``Tlr``), else rectified images of one K, in metres.

    ``Camera.newWidth`` is what ORB-SLAM shrinks images to, and is not read.
    """
    entries = _storage(texts[0])
    kind = entries.get("camera.type", "PinHole")
    left = "Camera1" if "camera1.fx" in entries else "Camera"
    pose = next((name for name in ORB_POSES if name.lower() in entries), None)
    if pose is not None:
        if kind not in ORB_LENSES:
            bad_value("Camera.type", f"{' or '.join(ORB_LENSES)} beside {pose}", repr(kind))
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
        bad_value(f"Lens distortion of {left}", expected, camera.coefficients, "Is it of a single camera?")
    length = array_of(entries[baseline.lower()], (), baseline)
    baseline_m = length if baseline == "Stereo.b" else length / camera.K[0, 0]
    return make_rig(camera, camera, baseline_m, rectified=True)


def _of(words: str, number: str, side: str) -> str:
    """Names of a matrix of one camera: its number, letter or side behind a word, or the side before it."""
    return f"(?:{words})(?:{number}|{side[0]}|{side})|{side}(?:{words})"


K = "m|k|mtx|cameramatrix|intrinsics?|intrinsicmatrix"
D = "d|dis|dist|distcoeffs?|distcoefs?|distort|distortion|distortioncoefficients|distortioncoeffs"
P = "p|projection|projectionmatrix|projmat|projmatrix"
#: Name in OpenCV's samples -> names in use for the same thing, in small letters without "_" and ".": the
#: arguments of stereoCalibrate, what tutorials call them, ORB-SLAM's ``LEFT.P``.
NAMES = {
    **{f"{name}1": _of(words, "1", "left") for name, words in (("M", K), ("D", D), ("P", P))},
    **{f"{name}2": _of(words, "2", "right") for name, words in (("M", K), ("D", D), ("P", P))},
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
    """``P1, P2`` of the rectified images, else ``M1, M2, R, T`` and ``D1, D2``; ``NAMES`` has other names.

    Lengths are taken as metres: OpenCV keeps the unit of the chessboard's squares, and no file says it.
    """
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
    Ks = (array_of(named[name], (3, 3), name) for name in ("M1", "M2"))
    left, right = (Camera(K, size, lens) for K, lens in zip(Ks, _lenses(arrays, named), strict=True))
    return make_rig(left, right, np.linalg.inv(transform(named["R"], named["T"], "R, T")))


def read_booster(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """For the images at full resolution, which are rectified; lengths are millimetres."""
    entries = _storage(texts[0])
    left, right = (Camera(array_of(entries[key], (3, -1), key)[:, :3]) for key in ("proj_matl", "proj_matr"))
    return make_rig(left, right, entries["baselinelr"].item() / MM_PER_METRE, rectified=True)
