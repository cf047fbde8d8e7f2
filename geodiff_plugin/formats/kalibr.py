"""Kalibr's ``camchain.yaml``.

Data flow: ``cam0``, ``cam1`` with ``intrinsics``, ``distortion_coeffs``, ``T_cn_cnm1`` -> ``Rig``.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.lenses import FactoryCamera, lens_of, rig_of_cameras
from geodiff_plugin.formats.rigs import check_rigid, intrinsics, pose_from_world_to_camera, whole_pixels
from geodiff_plugin.formats.structured import array_of, entry, parse_yaml
from geodiff_plugin.types import Distortion, Rig

__all__ = ["KALIBR", "matches", "pinhole_camera", "read"]

MARK = re.compile(r"^cam\d+:\s*(?:#.*)?$", re.MULTILINE)
#: OpenCV's name of a distortion model.
LENSES = {"radtan": "opencv", "equidistant": "fisheye"}
CURE = "Calibrate with pinhole-radtan or pinhole-equi, or undistort the images to a pinhole first."


def matches(text: str, path: Path) -> bool:
    """Whether a line is ``cam0:`` or of another number."""
    return MARK.search(text) is not None


def _lens(camera: dict[str, Any], key: str, models: dict[str, str], where: str) -> Distortion | None:
    name = f"{key} of {where}"
    coefficients = array_of(entry(camera, key, where), (-1,), name)
    model = entry(camera, "distortion_model", where)
    if model == "none":
        return None
    if model not in models:
        bad_value(f"distortion_model of {where}", f"one of {', '.join(models)}, none", repr(model), CURE)
    return lens_of(array_of(coefficients, (4,), name), name, models[model])


def pinhole_camera(
    camera: dict[str, Any], where: str, coefficients: str, models: dict[str, str]
) -> FactoryCamera:
    """A camera of ``camera_model``, ``intrinsics``, ``resolution`` and ``distortion_model``.

    Args:
        camera: its entries.
        where: for messages.
        coefficients: the name of the entry with those of its lens.
        models: OpenCV's name of each ``distortion_model``.

    Raises:
        ValueError: an entry is missing or malformed, or another model of a camera or a lens.
    """
    model = entry(camera, "camera_model", where)
    if model != "pinhole":
        bad_value(f"camera_model of {where}", "pinhole", repr(model), CURE)
    numbers = array_of(entry(camera, "intrinsics", where), (4,), f"intrinsics of {where}")
    name = f"resolution of {where}"
    width, height = (whole_pixels(n, name) for n in array_of(entry(camera, "resolution", where), (2,), name))
    return FactoryCamera(intrinsics(*numbers), (width, height), _lens(camera, coefficients, models, where))


def _camera(chain: dict[str, Any], name: str, path: Path) -> FactoryCamera:
    camera = entry(chain, name, f"{path}")
    return pinhole_camera(camera, f"{name} in {path}", "distortion_coeffs", LENSES)


def _from_first(chain: dict[str, Any], number: int, path: Path) -> np.ndarray:
    """Takes points of cam0 to those of camera ``number``, along the chain."""
    T = np.eye(4)
    for n in range(1, number + 1):
        where = f"cam{n} in {path}"
        link = array_of(
            entry(entry(chain, f"cam{n}", f"{path}"), "T_cn_cnm1", where), (4, 4), f"T_cn_cnm1 of {where}"
        )
        T = check_rigid(link, f"T_cn_cnm1 of {where}") @ T
    return T


def _numbers(chain: dict[str, Any], choice: CameraChoice, path: Path) -> tuple[int, int]:
    """Numbers of the left and the right camera, as they were chosen, or 0 and 1."""
    if choice.cameras is None:
        return 0, 1
    there = [number for number in range(len(chain)) if f"cam{number}" in chain]
    left, right = choice.cameras
    if left == right or not {left, right} <= set(there):
        have = ", ".join(map(str, there))
        bad_value("cameras", f"two different cameras of {path} ({have})", f"{left},{right}")
    return left, right


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of two cameras of a chain: ``choice.cameras``, or cam0 (left) and cam1 (right).

    ``T_cn_cnm1`` takes points of the camera before to this one, in metres.

    Raises:
        ValueError: an entry is missing or malformed, no such camera, another model of a camera or a lens
            than pinhole, radtan, equidistant.
    """
    path = files[0].path
    chain = parse_yaml(files[0].text, path)
    left, right = _numbers(chain, choice, path)
    first, second = (_camera(chain, f"cam{number}", path) for number in (left, right))
    E = pose_from_world_to_camera(*(_from_first(chain, number, path) for number in (left, right)))
    return rig_of_cameras(first, second, E, str(path))


KALIBR = CalibrationFormat("Kalibr camchain.yaml (cam0, cam1)", matches, read, uses_cameras=True)
