"""Middlebury ``calib.txt``, version 2014; MiddEval3 and ETH3D two-view share it.

Data flow: ``cam0=[...]``, ``cam1=[...]``, ``doffs`` (px), ``baseline`` (mm) -> ``Rig``.
Paper: S5.1 (Middlebury); Z = baseline * f / (d + doffs).
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.rigs import make_rig, pose_to_the_right, positive, whole_pixels
from geodiff_plugin.types import Rig

__all__ = ["MIDDLEBURY", "matches", "read"]

MARK = re.compile(r"^\s*cam0\s*=\s*\[", re.MULTILINE)
ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Files are printed with three decimals, so an honest cam1 agrees with doffs better than this.
DOFFS_TOLERANCE_PX = 0.05


def matches(text: str, path: Path) -> bool:
    """Whether a line starts with ``cam0=[``."""
    return MARK.search(text) is not None


def _camera(entries: dict[str, str], key: str, path: Path) -> np.ndarray:
    value = entries[key]
    try:
        matrix = np.array([[float(v) for v in row.split()] for row in value.strip("[]").split(";")])
    except ValueError:
        matrix = np.empty(0)
    if matrix.shape != (3, 3) or not value.endswith("]"):
        bad_value(f"{key} in {path}", "[f 0 cx; 0 f cy; 0 0 1]", repr(value), "Is the file cut off?")
    return matrix


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one ``calib.txt``.

    ``doffs`` is what the ground truth was made with, so the right principal point is ``cx0 + doffs`` where
    ``cam1`` disagrees or is missing (with a warning).

    Raises:
        ValueError: an entry is missing or malformed.

    Convention:
        ``doffs = cx1 - cx0``: 52.3 px of it move cx of ``K_right`` 52.3 px to the right.
    """
    path = files[0].path
    entries = dict(ENTRY.findall(files[0].text))
    if "baseline" not in entries:
        bad_value(
            f"{path}", "a Middlebury calib.txt with a line baseline=<mm>", "none", "Is the file cut off?"
        )
    K_left = _camera(entries, "cam0", path)
    if "doffs" in entries:
        doffs = _number(entries["doffs"], f"doffs in {path}")
        K_right = _camera(entries, "cam1", path) if "cam1" in entries else K_left.copy()
        expected = K_left[0, 2] + doffs
        if "cam1" not in entries or abs(K_right[0, 2] - expected) > DOFFS_TOLERANCE_PX:
            said = f"says cx = {K_right[0, 2]:g}" if "cam1" in entries else "is missing"
            warnings.warn(
                f"{path}: cam1 {said}; using cx0 + doffs = {expected:g} px for the right image.", stacklevel=2
            )
            K_right[0, 2] = expected
    elif "cam1" in entries:
        K_right = _camera(entries, "cam1", path)
    else:
        bad_value(
            f"{path}",
            "a Middlebury calib.txt with cam1=[...] or doffs=<px>",
            "neither",
            "Is the file cut off?",
        )
    baseline_m = positive(entries["baseline"], f"baseline in {path}") / 1000.0
    return make_rig(
        K_left, K_right, pose_to_the_right(baseline_m), path, size=_size(entries, path), rectified=True
    )


def _number(value: str, name: str) -> float:
    try:
        return float(value)
    except ValueError:
        bad_value(name, "a number", repr(value), "Is the file cut off?")


def _size(entries: dict[str, str], path: Path) -> tuple[int, int] | None:
    if "width" not in entries or "height" not in entries:
        return None
    width, height = (whole_pixels(entries[key], f"{key} in {path}") for key in ("width", "height"))
    return width, height


MIDDLEBURY = CalibrationFormat("Middlebury, MiddEval3 or ETH3D calib.txt (cam0=[...])", matches, read)
