"""Intel RealSense: what ``rs-enumerate-devices -c`` prints, or rs2's structures as JSON.

Data flow: intrinsics of both infrared cameras and the extrinsics between them -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.lenses import NO_MODEL, FactoryCamera, lens_of, rig_of_cameras
from geodiff_plugin.formats.rigs import check_rigid, intrinsics, is_distorted, positive, whole_pixels
from geodiff_plugin.formats.structured import array_of, entry, parse_json
from geodiff_plugin.types import Distortion, Rig

__all__ = ["REALSENSE", "matches", "read"]

PRINTED = re.compile(r'^\s*Intrinsic of "', re.MULTILINE)
INTRINSIC = re.compile(
    r'^\s*Intrinsic of "Infrared ([12])" */ *(\d+)x(\d+)[^\n]*\n(.*?)(?=\n\s*\n|\Z)', re.M | re.S
)
EXTRINSIC = re.compile(
    r'^\s*Extrinsic from "Infrared 1"\s+To\s+"Infrared 2"[^\n]*\n(.*?)(?=\n\s*Extrinsic|\Z)', re.M | re.S
)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
LINES = {
    "Fx": "fx",
    "Fy": "fy",
    "PPX": "ppx",
    "PPY": "ppy",
    "Width": "width",
    "Height": "height",
    "Distortion": "model",
}
#: rs2_distortion by its number.
MODELS = (
    "none",
    "modified brown conrady",
    "inverse brown conrady",
    "ftheta",
    "brown conrady",
    "kannala brandt4",
)


def matches(text: str, path: Path) -> bool:
    """Whether it is JSON with ``"ppx"`` in it, or has a line ``Intrinsic of "..."``."""
    return (text.lstrip().startswith(("{", "[")) and '"ppx"' in text) or PRINTED.search(text) is not None


def _lens(values: dict[str, Any], where: str) -> Distortion | None:
    coefficients = array_of(values.get("coeffs", ()), (-1,), f"coeffs of {where}")
    said = values.get("model", "none")
    known = isinstance(said, int) and 0 <= said < len(MODELS)
    text = re.sub(r"[\s_]+", " ", str(MODELS[said] if known else said).lower()).strip()
    model = text.removeprefix("distortion.").removeprefix("rs2 distortion ")
    if model == "kannala brandt4":
        return lens_of(coefficients[:4], f"coeffs of {where}", "fisheye")
    if model != "brown conrady" and is_distorted(Distortion("opencv", coefficients)):
        bad_value(
            f"the distortion model of {where}",
            "brown conrady or kannala brandt4, unless its coefficients are zero",
            repr(model),
            NO_MODEL,
        )
    return lens_of(coefficients, f"coeffs of {where}")


def _camera(values: dict[str, Any], where: str) -> FactoryCamera:
    fx, fy = (positive(entry(values, key, where), f"{key} of {where}") for key in ("fx", "fy"))
    cx, cy = array_of([entry(values, key, where) for key in ("ppx", "ppy")], (2,), f"ppx, ppy of {where}")
    width, height = (
        whole_pixels(entry(values, key, where), f"{key} of {where}") for key in ("width", "height")
    )
    return FactoryCamera(intrinsics(fx, fy, cx, cy), (width, height), _lens(values, where))


def _of_size(cameras: list[FactoryCamera], choice: CameraChoice, path: Path) -> FactoryCamera:
    sizes = sorted({camera.size for camera in cameras if camera.size is not None})
    if choice.image_size is None and len(sizes) == 1:
        return cameras[0]
    fitting = [camera for camera in cameras if camera.size == choice.image_size]
    if not fitting:
        there = ", ".join("{}x{}".format(*size) for size in sizes)
        got = "no image" if choice.image_size is None else "{}x{}".format(*choice.image_size)
        bad_value("the left image", f"of one of the sizes in {path} ({there})", got)
    return fitting[0]


def _printed(file: CalibrationFile, choice: CameraChoice) -> tuple[FactoryCamera, FactoryCamera, np.ndarray]:
    cameras: dict[str, list[FactoryCamera]] = {"1": [], "2": []}
    for number, width, height, block in INTRINSIC.findall(file.text):
        where = f'Intrinsic of "Infrared {number}" / {width}x{height} in {file.path}'
        pairs = (line.partition(":") for line in block.splitlines())
        values = {LINES[key.strip()]: value for key, _, value in pairs if key.strip() in LINES}
        lens = next((line for line in block.splitlines() if line.strip().startswith("Coeffs")), "")
        cameras[number].append(_camera(values | {"coeffs": NUMBER.findall(lens)}, where))
    between = EXTRINSIC.search(file.text)
    if not (cameras["1"] and cameras["2"] and between):
        bad_value(
            f"{file.path}",
            'rs-enumerate-devices -c with "Infrared 1", "Infrared 2" and the extrinsics from 1 to 2',
            "less",
            "Is the file cut off?",
        )
    rotation, _, translation = between.group(1).partition("Translation")
    where = f'Extrinsic from "Infrared 1" To "Infrared 2" in {file.path}'
    T = np.eye(4)
    T[:3, :3] = array_of(NUMBER.findall(rotation)[:9], (3, 3), where)
    T[:3, 3] = array_of(NUMBER.findall(translation)[:3], (3,), where)
    left, right = (_of_size(cameras[number], choice, file.path) for number in "12")
    return left, right, check_rigid(T, where)


def _objects(value: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every object of a JSON value with the keys that lead to it, in the order of the file."""
    if isinstance(value, dict):
        yield name.lower(), value
        for key, inner in value.items():
            yield from _objects(inner, f"{name}/{key}")
    elif isinstance(value, list):
        for inner in value:
            yield from _objects(inner, name)


def _json(file: CalibrationFile, choice: CameraChoice) -> tuple[FactoryCamera, FactoryCamera, np.ndarray]:
    found = list(_objects(parse_json(file.text, file.path)))
    views = [(name, values) for name, values in found if "ppx" in values]
    # A file of the whole device has colour and depth too; the pair is the two infrared ones.
    infrared = [view for view in views if re.search(r"infra|left|right|\bir", view[0])]
    views = infrared if len(infrared) >= 2 else views
    between = [
        (name, values)
        for name, values in found
        if "translation" in values and not re.search(r"color|depth|imu|gyro|accel", name)
    ]
    if len(views) != 2 or len(between) != 1:
        bad_value(
            f"{file.path}",
            "two rs2 intrinsics (fx, fy, ppx, ppy) of the infrared pair and their extrinsics",
            f"{len(views)} and {len(between)}",
            "Is the file cut off?",
        )
    (where, extrinsics), pose = between[0], np.eye(4)
    where = f"{where.strip('/') or 'extrinsics'} in {file.path}"
    rotation = array_of(entry(extrinsics, "rotation", where), (9,), f"rotation of {where}")
    pose[:3, :3] = rotation.reshape(3, 3).T  # rs2 keeps it column by column
    pose[:3, 3] = array_of(extrinsics["translation"], (3,), f"translation of {where}")
    T = check_rigid(pose, where)
    # From the left to the right one x becomes smaller; a file that says it the other way round is inverted.
    T = T if T[0, 3] <= 0 else np.linalg.inv(T)
    left, right = (_camera(values, f"{name.strip('/')} in {file.path}") for name, values in views)
    return left, right, T


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the infrared pair, whose images the camera rectifies itself, or of the T265's fisheyes.

    The printed text holds every resolution: ``choice.image_size`` chooses. JSON holds ``rs2_intrinsics`` of
    the left camera, then of the right one, and ``rs2_extrinsics`` between them, under any names.

    Raises:
        ValueError: an entry is missing or malformed, no such resolution, a lens that OpenCV has no model of.
    """
    printed = PRINTED.search(files[0].text) is not None
    left, right, T_right_from_left = (_printed if printed else _json)(files[0], choice)
    rectified = left.lens is None and right.lens is None
    E = np.linalg.inv(T_right_from_left)
    return rig_of_cameras(left, right, E, str(files[0].path), rectified=rectified)


REALSENSE = CalibrationFormat(
    "RealSense intrinsics and extrinsics (rs-enumerate-devices -c, or rs2 as JSON)", matches, read
)
