"""Intel RealSense: what ``rs-enumerate-devices -c`` prints, or rs2's structures as JSON."""

from __future__ import annotations

import re
from collections.abc import Iterator
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
    is_distorted,
    rigid,
)
from geodiff_plugin.formats.structured import parse_json
from geodiff_plugin.types import Distortion

__all__ = ["REALSENSE"]

PRINTED = re.compile(r'^\s*Intrinsic of "', re.MULTILINE)
INTRINSIC = re.compile(
    r'^\s*Intrinsic of "Infrared ([12])" */ *(\d+)x(\d+)[^\n]*\n(.*?)(?=\n\s*\n|\Z)', re.M | re.S
)
EXTRINSIC = re.compile(
    r'^\s*Extrinsic from "Infrared 1"\s+To\s+"Infrared 2"[^\n]*\n(.*?)(?=\n\s*Extrinsic|\Z)', re.M | re.S
)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
#: rs2_distortion by its number.
MODELS = (
    *("none", "modified brown conrady", "inverse brown conrady"),
    *("ftheta", "brown conrady", "kannala brandt4"),
)


def _camera(values: dict[str, Any]) -> Camera:
    """A camera of rs2's entries; a lens of coefficients 0 is none, whatever its model."""
    K = intrinsics(*(values[key] for key in ("fx", "fy", "ppx", "ppy")))
    coefficients = array_of(values.get("coeffs", ()), (-1,), "coeffs")
    said = values.get("model", "none")
    said = MODELS[said] if isinstance(said, int) and 0 <= said < len(MODELS) else said
    text = re.sub(r"[\s_]+", " ", str(said).lower()).strip()
    model = text.removeprefix("distortion.").removeprefix("rs2 distortion ")
    if model == "kannala brandt4":
        model, coefficients = "fisheye", coefficients[:4]
    elif model == "brown conrady" or not is_distorted(Distortion("opencv", coefficients)):
        model = "opencv"
    return Camera(K, (values["width"], values["height"]), coefficients, model)


def _of_size(cameras: list[Camera], choice: CameraChoice) -> Camera:
    by_size = {tuple(map(int, camera.size)): camera for camera in reversed(cameras)}
    if choice.image_size is None and len(by_size) == 1:
        return cameras[0]
    if choice.image_size not in by_size:
        there = ", ".join("{}x{}".format(*size) for size in sorted(by_size))
        got = "no image" if choice.image_size is None else "{}x{}".format(*choice.image_size)
        bad_value("the left image", f"of one of the file's sizes ({there})", got)
    return by_size[choice.image_size]


def _printed(text: str, choice: CameraChoice) -> tuple[Camera, Camera, np.ndarray]:
    cameras: dict[str, list[Camera]] = {"1": [], "2": []}
    for side, _, _, block in INTRINSIC.findall(text):
        pairs = (line.partition(":") for line in block.splitlines())
        values: dict[str, Any] = {key.strip().lower(): value.strip() for key, _, value in pairs}
        values |= {
            "coeffs": NUMBER.findall(values.get("coeffs", "")),
            "model": values.get("distortion", "none"),
        }
        cameras[side].append(_camera(values))
    between = EXTRINSIC.search(text)
    if not (cameras["1"] and cameras["2"] and between):
        expected = 'what rs-enumerate-devices -c prints, with "Infrared 1", "Infrared 2" and the extrinsics'
        bad_value("the file", expected, "less", "Is the file cut off?")
    rotation, _, translation = between[1].partition("Translation")
    left, right = (_of_size(cameras[side], choice) for side in "12")
    return left, right, _pose(NUMBER.findall(rotation)[:9], NUMBER.findall(translation)[:3], "C")


def _pose(rotation: Any, translation: Any, order: Any) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = array_of(rotation, (9,), "rotation").reshape(3, 3, order=order)
    T[:3, 3] = array_of(translation, (3,), "translation")
    return rigid(T, "the extrinsics")


def _objects(value: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every object of a JSON value with the keys that lead to it, in the order of the file."""
    if isinstance(value, dict):
        yield name.lower(), value
        for key, inner in value.items():
            yield from _objects(inner, f"{name}/{key}")
    elif isinstance(value, list):
        for inner in value:
            yield from _objects(inner, name)


def _json(text: str, choice: CameraChoice) -> tuple[Camera, Camera, np.ndarray]:
    objects = list(_objects(parse_json(text)))
    views = [(name, values) for name, values in objects if "ppx" in values]
    # A file of the whole device has colour and depth too; the pair is the two infrared ones.
    infrared = [view for view in views if re.search(r"infra|left|right|\bir", view[0])]
    views = infrared if len(infrared) >= 2 else views
    between = [
        values
        for name, values in objects
        if "translation" in values and not re.search(r"color|depth|imu|gyro|accel", name)
    ]
    if len(views) != 2 or len(between) != 1:
        expected = "two rs2 intrinsics (fx, fy, ppx, ppy) of the infrared pair and their extrinsics"
        bad_value("the file", expected, f"{len(views)} and {len(between)}", "Is the file cut off?")
    # rs2 keeps a rotation column by column.
    T = _pose(between[0]["rotation"], between[0]["translation"], "F")
    # From the left to the right one x becomes smaller; a file that says it the other way round is inverted.
    return _camera(views[0][1]), _camera(views[1][1]), T if T[0, 3] <= 0 else np.linalg.inv(T)


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The infrared pair, whose images the camera rectifies itself, or the T265's fisheyes.

    The printed text holds every resolution: ``choice.image_size`` chooses. JSON holds ``rs2_intrinsics`` of
    the left camera, then of the right one, and ``rs2_extrinsics`` between them, under any names.
    """
    printed = PRINTED.search(texts[0]) is not None
    left, right, T_right_from_left = (_printed if printed else _json)(texts[0], choice)
    lenses = [Distortion(camera.model, np.asarray(camera.coefficients)) for camera in (left, right)]
    return RawRig(left, right, np.linalg.inv(T_right_from_left), not any(map(is_distorted, lenses)))


REALSENSE = CalibrationFormat(
    "RealSense intrinsics and extrinsics (rs-enumerate-devices -c, or rs2 as JSON)",
    lambda text: (
        (text.lstrip().startswith(("{", "[")) and '"ppx"' in text) or PRINTED.search(text) is not None
    ),
    _read,
)
