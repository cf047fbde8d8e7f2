"""Stereolabs' factory calibration ``SN<number>.conf`` of a ZED."""

from __future__ import annotations

import configparser
import re

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import CalibrationFormat, Camera, CameraChoice, RawRig, intrinsics, number

__all__ = ["ZED"]

MARK = re.compile(r"^\s*\[(LEFT|RIGHT)_CAM_\w+\]", re.MULTILINE)
#: Width and height of the images that a section is for.
SIZES = {
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
LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
MM_PER_METRE = 1000.0

Sections = configparser.ConfigParser


def _sections(text: str) -> Sections:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(text)
    except configparser.Error as error:
        bad_value("the file", "a ZED .conf", str(error).splitlines()[0], "Is the file cut off?")
    return parser


def _number(sections: Sections, section: str, key: str) -> float:
    return number(sections.get(section, key, fallback=None), f"{key} of [{section}]")


def _resolution(sections: Sections, choice: CameraChoice) -> str:
    """Which of the resolutions the images have; their name in the sections."""
    there = [name for name in SIZES if f"LEFT_CAM_{name}" in sections and f"RIGHT_CAM_{name}" in sections]
    fitting = [name for name in there if choice.image_size in (None, SIZES[name])]
    if len(fitting) != 1:
        sizes = ", ".join("{}x{}".format(*SIZES[name]) for name in there) or "none"
        got = "no image" if choice.image_size is None else "{}x{}".format(*choice.image_size)
        cure = "A side-by-side image is two."
        bad_value("the left image", f"of one of the file's sizes ({sizes})", got, cure)
    return fitting[0]


def _camera(sections: Sections, side: str, name: str) -> Camera:
    section = f"{side}_CAM_{name}"
    K = intrinsics(*(_number(sections, section, key) for key in ("fx", "fy", "cx", "cy")))
    of_lens = section if any(sections.has_option(section, key) for key in LENS) else f"{side}_DISTO"
    there = {key: _number(sections, of_lens, key) for key in LENS if sections.has_option(of_lens, key)}
    keys = LENS if there.keys() & set(LENS[5:]) else LENS[:5]
    return Camera(K, SIZES[name], [there.get(key, 0.0) for key in keys])


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The raw images at the resolution of ``choice.image_size``.

    Lengths are millimetres. ``R = Rodrigues(RX, CV, RZ)`` takes left directions to right ones, and
    ``Baseline``, ``TY``, ``TZ`` point from the left camera to the right one: ``x_right = R x_left - T``.

    Source: calibration.hpp of stereolabs/zed-opencv-native.
    """
    sections = _sections(texts[0])
    name = _resolution(sections, choice)
    baseline = _number(sections, "STEREO", "Baseline")
    if baseline <= 0:
        bad_value("Baseline of [STEREO]", "above 0", baseline, "Check the calibration file.")
    # Per resolution in some files (TY_HD), once for all in others (TY).
    offsets = [
        _number(sections, "STEREO", key if sections.has_option("STEREO", key) else key[:2])
        for key in (f"TY_{name}", f"TZ_{name}")
    ]
    turns = [_number(sections, "STEREO", f"{axis}_{name}") for axis in ("RX", "CV", "RZ")]
    T_right_from_left = np.eye(4)
    T_right_from_left[:3, :3] = Rotation.from_rotvec(turns).as_matrix()
    T_right_from_left[:3, 3] = -np.array([baseline, *offsets]) / MM_PER_METRE
    left, right = (_camera(sections, side, name) for side in ("LEFT", "RIGHT"))
    return RawRig(left, right, np.linalg.inv(T_right_from_left))


ZED = CalibrationFormat(
    "ZED factory calibration SN*.conf ([LEFT_CAM_HD], [STEREO])",
    lambda text: MARK.search(text) is not None,
    _read,
)
