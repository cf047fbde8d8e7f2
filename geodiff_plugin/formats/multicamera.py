"""Calibrations of many cameras in one world: anipose, Pose2Sim, caliscope, MC-Calib, multical, mrcal.

Source: ``Pose2Sim/calibration.py`` of perfanalytics/pose2sim, which keeps the form of lambdaloopy/aniposelib;
``cameras/camera_array.py`` of mprib/caliscope; ``saveCamerasParams`` of rameau-fr/MC-Calib; ``FORMAT.md`` and
``io/import_calib.py`` of oliver-batchelor/multical; ``mrcal/cameramodel.py`` of dkogan/mrcal.
"""

from __future__ import annotations

import ast
import json
import tomllib
from collections.abc import Sequence
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
    rigid,
    transform,
    two_cameras,
)
from geodiff_plugin.formats.storage import read_yaml, without_sizes
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
#: MC-Calib's ``distortion_type``, by OpenCV's model.
MC_CALIB_LENSES = {0: "opencv", 1: "fisheye"}
#: What stands between both names of a relative pose of multical's.
TO = "_to_"
#: What mrcal calls the transform of points from the world to a camera, in files of today and of before.
MRCAL_POSES = ("rt_cam_ref", "extrinsics")


def _world_to_camera(turn: Any, shift: Any, name: str) -> np.ndarray:
    """``(4, 4)`` of a rotation vector, or of the 9 numbers of a rotation, and a translation."""
    numbers = array_of(turn, (-1,), f"the rotation of {name}")
    if numbers.size == 9:
        return transform(numbers, shift, name)
    return pose_of(Rotation.from_rotvec(array_of(numbers, (3,), f"the rotation of {name}")), shift)


def _pair_of(names: Sequence[str], choice: CameraChoice) -> tuple[int, int]:
    """The numbers of both cameras among these; of more than two they must be given."""
    if len(names) > 2 and choice.cameras is None:
        numbered = ", ".join(f"{n} ({name})" for n, name in enumerate(names))
        bad_value("cameras", f"given, two of {numbered}", "none", "Give --cameras LEFT,RIGHT.")
    return two_cameras(choice, range(len(names)), (0, 1))


def read_anipose(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Two of the cameras of a TOML file, in the file's order; the unit is that of the calibration's board.

    caliscope has them in a table ``cameras``, with a rotation of 9 numbers.
    """
    content = tomllib.loads(texts[0])
    content = content["cameras"] if isinstance(content.get("cameras"), dict) else content
    tables = [
        (name, table) for name, table in content.items() if isinstance(table, dict) and "matrix" in table
    ]
    pair = _pair_of([str(table.get("name", name)) for name, table in tables], choice)
    worlds, cameras = [], []
    for name, table in (tables[n] for n in pair):
        worlds.append(_world_to_camera(table["rotation"], table["translation"], name))
        model = "fisheye" if table.get("fisheye") else "opencv"
        K = array_of(table["matrix"], (3, 3), f"matrix of {name}")
        cameras.append(Camera(K, table.get("size"), table["distortions"], model))
    rig = make_rig(cameras[0], cameras[1], worlds[0] @ np.linalg.inv(worlds[1]))
    return in_stated_unit(rig, {}, choice)


def read_mc_calib(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """MC-Calib's ``calibrated_cameras_data.yml``: camera-to-reference poses, in the unit of the board."""
    content = read_yaml(texts[0])
    names = [name for name, each in content.items() if isinstance(each, dict) and "camera_matrix" in each]
    poses, cameras = [], []
    for name in (names[n] for n in _pair_of(names, choice)):
        entries = content[name]
        kind = entries.get("distortion_type", 0)
        if kind not in MC_CALIB_LENSES:
            bad_value("distortion_type", f"one of {', '.join(map(str, MC_CALIB_LENSES))}", kind)
        K = array_of(without_sizes(entries["camera_matrix"]), (3, 3), f"camera_matrix of {name}")
        size = entries["img_width"], entries["img_height"]
        lens = without_sizes(entries["distortion_vector"])
        cameras.append(Camera(K, size, lens, MC_CALIB_LENSES[kind]))
        poses.append(rigid(without_sizes(entries["camera_pose_matrix"]), f"camera_pose_matrix of {name}"))
    rig = make_rig(cameras[0], cameras[1], np.linalg.inv(poses[0]) @ poses[1])
    return in_stated_unit(rig, {}, choice)


def read_multical(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Multical's ``calibration.json``: world-to-camera poses, or those beside another camera's."""
    content = json.loads(texts[0])
    found, poses = content["cameras"], content["camera_poses"]
    names = list(found)
    left, right = (names[n] for n in _pair_of(names, choice))
    cameras = []
    for name in (left, right):
        entries = found[name]
        lens = np.ravel(entries["dist"]).tolist()
        cameras.append(Camera(array_of(entries["K"], (3, 3), f"K of {name}"), entries["image_size"], lens))
    worlds = [_multical_world(name, poses) for name in (left, right)]
    return in_stated_unit(make_rig(cameras[0], cameras[1], worlds[0] @ np.linalg.inv(worlds[1])), {}, choice)


def _multical_world(name: str, poses: Entries) -> np.ndarray:
    """World-to-camera of a camera; ``LEFT_to_RIGHT`` is that of LEFT where RIGHT is the world."""
    T, at = np.eye(4), name
    for _ in poses:
        if at in poses:
            return T @ _world_to_camera(poses[at]["R"], np.ravel(poses[at]["T"]), at)
        key = next((key for key in poses if key.startswith(f"{at}{TO}")), "")
        if not key:
            break
        T = T @ _world_to_camera(poses[key]["R"], np.ravel(poses[key]["T"]), key)
        at = key.removeprefix(f"{at}{TO}")
    bad_value("camera_poses", f"with a pose of {name}", ", ".join(poses) or "none", "Calibrate again.")


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
