"""Calibrations of many cameras in one world: anipose's and Pose2Sim's TOML, mrcal's camera models.

Source: ``Pose2Sim/calibration.py`` of perfanalytics/pose2sim, which keeps the form of lambdaloopy/aniposelib;
``mrcal/cameramodel.py`` of dkogan/mrcal.
"""

from __future__ import annotations

import ast
import tomllib
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.named import in_stated_unit
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    pose_of,
    two_cameras,
)
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: mrcal's lens models that OpenCV has, and how many coefficients each has.
MRCAL_LENSES = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
#: What mrcal calls the transform of points from the world to a camera, in files of today and of before.
MRCAL_POSES = ("rt_cam_ref", "extrinsics")


def _world_to_camera(turn: Any, shift: Any, name: str) -> np.ndarray:
    """``(4, 4)`` of a rotation vector and a translation."""
    return pose_of(Rotation.from_rotvec(array_of(turn, (3,), f"the rotation of {name}")), shift)


def read_anipose(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Two of the cameras of a TOML file, in the file's order; the unit is that of the calibration's board."""
    content = tomllib.loads(texts[0])
    tables = [
        (name, table) for name, table in content.items() if isinstance(table, dict) and "matrix" in table
    ]
    if len(tables) > 2 and choice.cameras is None:
        numbered = ", ".join(f"{n} ({table.get('name', name)})" for n, (name, table) in enumerate(tables))
        bad_value("cameras", f"given, two of {numbered}", "none", "Give --cameras LEFT,RIGHT.")
    pair = two_cameras(choice, range(len(tables)), (0, 1))
    worlds, cameras = [], []
    for name, table in (tables[n] for n in pair):
        worlds.append(_world_to_camera(table["rotation"], table["translation"], name))
        model = "fisheye" if table.get("fisheye") else "opencv"
        K = array_of(table["matrix"], (3, 3), f"matrix of {name}")
        cameras.append(Camera(K, table.get("size"), table["distortions"], model))
    rig = make_rig(cameras[0], cameras[1], worlds[0] @ np.linalg.inv(worlds[1]))
    return in_stated_unit(rig, {}, choice)


def read_mrcal(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """One ``.cameramodel`` a view, left first, in metres: numbers and names, which nothing evaluates."""
    models = [_literal(text) for text in texts]
    worlds = [_mrcal_pose(model) for model in models]
    left, right = map(_mrcal_camera, models)
    return make_rig(left, right, worlds[0] @ np.linalg.inv(worlds[1]))


def _literal(text: str) -> Entries:
    try:
        model = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        model = None
    if not isinstance(model, dict):
        bad_value("the file", "a camera model of mrcal", "another text", "Is the file cut off?")
    return model


def _mrcal_pose(model: Entries) -> np.ndarray:
    name = next((name for name in MRCAL_POSES if name in model), MRCAL_POSES[0])
    turn_and_shift = array_of(model[name], (6,), name)
    return _world_to_camera(turn_and_shift[:3], turn_and_shift[3:], name)


def _mrcal_camera(model: Entries) -> Camera:
    kind, numbers = str(model["lensmodel"]), array_of(model["intrinsics"], (-1,), "intrinsics")
    if kind not in MRCAL_LENSES:
        cure = "Run: mrcal-convert-lensmodel LENSMODEL_OPENCV8 FILE."
        bad_value("lensmodel", f"one of {', '.join(MRCAL_LENSES)}", kind, cure)
    coefficients = array_of(numbers[4:], (MRCAL_LENSES[kind],), "the coefficients in intrinsics")
    return Camera(intrinsics(*numbers[:4]), model["imagersize"], coefficients)
