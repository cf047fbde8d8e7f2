"""Calibrations that MATLAB writes: ``stereoParameters`` of its Computer Vision Toolbox, as JSON.

Source: its documentation.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.named import UNITS
from geodiff_plugin.formats.rigs import Camera, CameraChoice, array_of, make_rig, transform
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: The unit of a file that names none, as in MATLAB itself.
DEFAULT_UNIT = "mm"


def _matlab_camera(entries: Entries) -> Camera:
    """A camera of ``cameraParameters``: pixels count from 1, and ``IntrinsicMatrix`` is transposed."""
    K = array_of(entries.get("K") or entries["IntrinsicMatrix"], (3, 3), "IntrinsicMatrix")
    K = K.T if K[2, :2].any() else K
    K[:2, 2] -= 1
    radial = [*np.ravel(entries["RadialDistortion"]), 0.0][:3]
    p1, p2 = np.ravel(entries.get("TangentialDistortion") or (0.0, 0.0))
    size = entries.get("ImageSize") or (None, None)  # rows, columns
    return Camera(K, (size[1], size[0]), (radial[0], radial[1], p1, p2, radial[2]))


def read_matlab(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """MATLAB's ``stereoParameters`` by ``jsonencode``, its rotation transposed as it multiplies rows.

    ``RotationOfCamera2`` is ``PoseCamera2.R`` transposed, which newer files have.
    """
    data = json.loads(texts[0])
    left, right = (_matlab_camera(data[f"CameraParameters{n}"]) for n in (1, 2))
    if "PoseCamera2" in data:
        R, t = np.array(data["PoseCamera2"]["R"], float), data["PoseCamera2"]["Translation"]
    else:
        R, t = np.array(data["RotationOfCamera2"], float).T, data["TranslationOfCamera2"]
    unit = str(data["CameraParameters1"].get("WorldUnits") or DEFAULT_UNIT).lower()
    if unit not in UNITS:
        bad_value("WorldUnits", f"one of {', '.join(UNITS)}", unit)
    shift_m = array_of(t, (3,), "TranslationOfCamera2") / UNITS[unit]
    return make_rig(left, right, np.linalg.inv(transform(R, shift_m, "RotationOfCamera2")))
