"""Rectified pairs as Middlebury, Booster (S5.1), FoundationStereo and stereodemo describe them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import (
    CalibrationFormat,
    Camera,
    CameraChoice,
    RawRig,
    array_of,
    intrinsics,
    number,
    size_of,
)
from geodiff_plugin.formats.structured import is_storage, parse_json, parse_storage

__all__ = ["BOOSTER", "FOUNDATION_STEREO", "MIDDLEBURY", "STEREODEMO"]

MM_PER_METRE = 1000.0
CAM0 = re.compile(r"^\s*cam0\s*=\s*\[", re.MULTILINE)
ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Files are printed with three decimals, so an honest cam1 agrees with doffs better than this.
DOFFS_TOLERANCE_PX = 0.05
#: Marks of other programs' JSON that has an "fx" too.
OTHER_JSON = ("opencv-matrix", '"ppx"', '"transform_matrix"')


def _matrix(entries: dict[str, str], key: str) -> np.ndarray:
    value = entries[key]
    if not value.endswith("]"):
        bad_value(key, "[f 0 cx; 0 f cy; 0 0 1]", repr(value), "Is the file cut off?")
    return array_of([row.split() for row in value.strip("[]").split(";")], (3, 3), key)


def _read_middlebury(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """``doffs`` is what the ground truth was made with, so ``cx0 + doffs`` goes before ``cam1``.

    Convention:
        ``doffs = cx1 - cx0``, so that Z = baseline * f / (disparity + doffs); the baseline is in millimetres.
    """
    entries = dict(ENTRY.findall(texts[0]))
    K_left = _matrix(entries, "cam0")
    K_right, notes = _matrix(entries, "cam1") if "cam1" in entries else None, []
    if K_right is None or "doffs" in entries:
        expected = K_left[0, 2] + number(entries["doffs"], "doffs")
        if K_right is None or abs(K_right[0, 2] - expected) > DOFFS_TOLERANCE_PX:
            said = "is missing" if K_right is None else f"says cx = {K_right[0, 2]:g}"
            notes.append(f"cam1 {said}; using cx0 + doffs = {expected:g} px for the right image.")
            K_right = K_left.copy() if K_right is None else K_right
            K_right[0, 2] = expected
    size = size_of(entries) if {"width", "height"} <= entries.keys() else None
    baseline_m = number(entries["baseline"], "baseline") / MM_PER_METRE
    return RawRig(Camera(K_left, size), Camera(K_right, size), baseline_m, True, tuple(notes))


def _read_booster(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """For the images at full resolution, which are rectified."""
    entries = parse_storage(texts[0])
    left, right = (Camera(entries[key][:, :3]) for key in ("proj_matl", "proj_matr"))
    return RawRig(left, right, float(entries["baselinelr"].ravel()[0]) / MM_PER_METRE, rectified=True)


def _numbers(text: str) -> list[float] | None:
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return None


def _read_foundation_stereo(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    values = _numbers(texts[0]) or []
    if len(values) != 10:
        cure = "Add the baseline as a second line; a file that holds only K or E goes to K and E (--K, --E)."
        bad_value("the file", "9 numbers of K and the baseline in metres", f"{len(values)} numbers", cure)
    K = np.reshape(values[:9], (3, 3))
    return RawRig(Camera(K), Camera(K.copy()), values[9])


def _read_stereodemo(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    data: dict[str, Any] = parse_json(texts[0])
    if "cx" in data:  # older files: one principal point for both images
        data = {"cx0": data["cx"], "cx1": data["cx"], **data}
    size = size_of(data) if {"width", "height"} <= data.keys() else None
    left, right = (
        Camera(intrinsics(data["fx"], data["fy"], data[cx], data["cy"]), size) for cx in ("cx0", "cx1")
    )
    return RawRig(left, right, number(data["baseline_meters"], "baseline_meters"))


MIDDLEBURY = CalibrationFormat(
    "Middlebury, MiddEval3 or ETH3D calib.txt (cam0=[...])",
    lambda text: CAM0.search(text) is not None,
    _read_middlebury,
)
BOOSTER = CalibrationFormat(
    "Booster xml (proj_matL, proj_matR, baselineLR)",
    lambda text: is_storage(text) and "proj_matL" in text,
    _read_booster,
)
FOUNDATION_STEREO = CalibrationFormat(
    "K.txt of FoundationStereo (9 numbers, baseline in metres)",
    lambda text: _numbers(text) is not None,
    _read_foundation_stereo,
)
STEREODEMO = CalibrationFormat(
    "stereodemo JSON (fx, fy, cx0, cx1, cy, baseline_meters)",
    lambda text: text.lstrip().startswith("{") and '"fx"' in text and not any(m in text for m in OTHER_JSON),
    _read_stereodemo,
)
