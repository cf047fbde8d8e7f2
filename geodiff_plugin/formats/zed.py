"""Stereolabs' factory calibration ``SN<number>.conf`` of a ZED.

Data flow: sections ``[LEFT_CAM_HD]``, ``[RIGHT_CAM_HD]``, ``[STEREO]`` -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.lenses import FactoryCamera, lens_of, rig_of_cameras
from geodiff_plugin.formats.rigs import intrinsics, positive
from geodiff_plugin.types import Rig

__all__ = ["ZED", "matches", "read"]

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


def matches(text: str, path: Path) -> bool:
    """Whether a line opens a section ``[LEFT_CAM_...]`` or ``[RIGHT_CAM_...]``."""
    return MARK.search(text) is not None


def _sections(file: CalibrationFile) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(file.text)
    except configparser.Error as error:
        bad_value(f"{file.path}", "a ZED .conf", str(error).splitlines()[0], "Is the file cut off?")
    return parser


def _number(sections: configparser.ConfigParser, section: str, key: str, path: Path) -> float:
    text = sections.get(section, key, fallback=None)
    try:
        value = float(text or "nan")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        got = "none" if text is None else repr(text)
        bad_value(f"{key} of [{section}] in {path}", "a finite number", got, "Is the file cut off?")
    return value


def _resolution(sections: configparser.ConfigParser, choice: CameraChoice, path: Path) -> str:
    """Which of the resolutions the images have; their name in the sections."""
    there = [name for name in SIZES if f"LEFT_CAM_{name}" in sections and f"RIGHT_CAM_{name}" in sections]
    fitting = [name for name in there if choice.image_size in (None, SIZES[name])]
    if len(fitting) != 1:
        sizes = ", ".join("{}x{}".format(*SIZES[name]) for name in there) or "none"
        got = "no image" if choice.image_size is None else "{}x{}".format(*choice.image_size)
        bad_value(
            "the left image", f"of one of the sizes in {path} ({sizes})", got, "A side-by-side image is two."
        )
    return fitting[0]


def _camera(sections: configparser.ConfigParser, side: str, name: str, path: Path) -> FactoryCamera:
    section = f"{side}_CAM_{name}"
    fx, fy = (
        positive(_number(sections, section, key, path), f"{key} of [{section}]") for key in ("fx", "fy")
    )
    cx, cy = (_number(sections, section, key, path) for key in ("cx", "cy"))
    of_lens = section if any(sections.has_option(section, key) for key in LENS) else f"{side}_DISTO"
    there = {key: _number(sections, of_lens, key, path) for key in LENS if sections.has_option(of_lens, key)}
    keys = LENS if there.keys() & set(LENS[5:]) else LENS[:5]
    lens = lens_of(np.array([there.get(key, 0.0) for key in keys]), f"[{of_lens}] in {path}")
    return FactoryCamera(intrinsics(fx, fy, cx, cy), SIZES[name], lens)


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the raw images at the resolution of ``choice.image_size``.

    Lengths are millimetres. ``R = Rodrigues(RX, CV, RZ)`` takes left directions to right ones, and
    ``Baseline``, ``TY``, ``TZ`` point from the left camera to the right one: ``x_right = R x_left - T``.

    Raises:
        ValueError: no section of that resolution, or an entry is missing.

    Source: calibration.hpp of stereolabs/zed-opencv-native.
    """
    path = files[0].path
    sections = _sections(files[0])
    name = _resolution(sections, choice, path)
    baseline = positive(_number(sections, "STEREO", "Baseline", path), f"Baseline in {path}")
    # Per resolution in some files (TY_HD), once for all in others (TY).
    offsets = [
        _number(sections, "STEREO", key if sections.has_option("STEREO", key) else key[:2], path)
        for key in (f"TY_{name}", f"TZ_{name}")
    ]
    turns = [_number(sections, "STEREO", f"{axis}_{name}", path) for axis in ("RX", "CV", "RZ")]
    T_right_from_left = np.eye(4)
    T_right_from_left[:3, :3] = Rotation.from_rotvec(turns).as_matrix()
    T_right_from_left[:3, 3] = -np.array([baseline, *offsets]) / 1000.0
    left, right = (_camera(sections, side, name, path) for side in ("LEFT", "RIGHT"))
    return rig_of_cameras(left, right, np.linalg.inv(T_right_from_left), str(path))


ZED = CalibrationFormat("ZED factory calibration SN*.conf ([LEFT_CAM_HD], [STEREO])", matches, read)
