"""Reads MATLAB calibrations: ``stereoParameters`` as JSON, and Bouguet's toolbox.

Source: their documentation.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.rigs import CameraChoice, RawCamera, array_of, intrinsics, make_rig, transform
from geodiff_plugin.formats.units import UNITS
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: Default unit, as in MATLAB and Bouguet's toolbox.
DEFAULT_UNIT = "mm"
#: Matches values of Bouguet's toolbox as printed (after a label) and as assigned in scripts.
BOUGUET = re.compile(r"(?m)^[ \t]*(?:[A-Za-z ]+:)?[ \t]*(\w+)[ \t]*=[ \t]*\[([^\]]*)\]")


def _matlab_camera(entries: Entries) -> RawCamera:
    """Return a camera of ``cameraParameters``: pixels count from 1, and ``IntrinsicMatrix`` is transposed."""
    K = array_of(entries.get("K") or entries["IntrinsicMatrix"], (3, 3), "IntrinsicMatrix")
    K = K.T if K[2, :2].any() else K
    K[:2, 2] -= 1
    radial = [*np.ravel(entries["RadialDistortion"]), 0.0][:3]
    p1, p2 = np.ravel(entries.get("TangentialDistortion") or (0.0, 0.0))
    size = entries.get("ImageSize") or (None, None)  # rows, columns
    return RawCamera(K, (size[1], size[0]), (radial[0], radial[1], p1, p2, radial[2]))


def read_matlab(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read ``stereoParameters`` from ``jsonencode``, with transposed rotation (row-vector convention).

    ``RotationOfCamera2`` is the transpose of ``PoseCamera2.R`` in newer files.
    """
    data = json.loads(texts[0])
    left, right = (_matlab_camera(data[f"CameraParameters{n}"]) for n in (1, 2))
    if "PoseCamera2" in data:
        R = np.array(data["PoseCamera2"]["R"], float)
        t = data["PoseCamera2"]["Translation"]
    else:
        R = np.array(data["RotationOfCamera2"], float).T
        t = data["TranslationOfCamera2"]
    unit = str(data["CameraParameters1"].get("WorldUnits") or DEFAULT_UNIT).lower()
    if unit not in UNITS:
        bad_value("WorldUnits", f"one of {', '.join(UNITS)}", unit)
    shift_m = array_of(t, (3,), "TranslationOfCamera2") / UNITS[unit]
    return make_rig(left, right, np.linalg.inv(transform(R, shift_m, "RotationOfCamera2")))


def _bouguet_camera(values: Entries, side: str) -> RawCamera:
    fx, fy = array_of(values[f"fc_{side}"], (2,), f"fc_{side}")
    K = intrinsics(fx, fy, *array_of(values[f"cc_{side}"], (2,), f"cc_{side}"))
    K[0, 1] = array_of(values.get(f"alpha_c_{side}", 0.0), (), f"alpha_c_{side}") * fx
    return RawCamera(K, None, array_of(values[f"kc_{side}"], (5,), f"kc_{side}"))


def read_bouguet(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read Bouguet's toolbox, printed or as a script: ``x_right = rodrigues(om) x_left + T``, millimetres.

    Its pixels count from 0, and ``kc`` is in OpenCV's order.
    """
    values: Entries = {
        name: re.split(r"[\s;,]+", words.strip(" ;,\t\n")) for name, words in BOUGUET.findall(texts[0])
    }
    left, right = (_bouguet_camera(values, side) for side in ("left", "right"))
    if "R" in values:
        R = array_of(values["R"], (3, 3), "R")
    else:
        R = Rotation.from_rotvec(array_of(values["om"], (3,), "om")).as_matrix()
    shift_m = array_of(values["T"], (3,), "T") / UNITS[DEFAULT_UNIT]
    return make_rig(left, right, np.linalg.inv(transform(R, shift_m, "om, T")))
