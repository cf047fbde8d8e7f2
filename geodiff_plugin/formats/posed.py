"""Reads calibrations in which every camera has a pose: one reader, and the keys of each format.

Source: ``config/euroc_mav/kalibr_imucam_chain.yaml`` of rpng/open_vins; ``data/euroc_ds_calib.json`` of
VladyslavUsenko/basalt; ``config/euroc`` and ``vins_estimator/src/estimator/parameters.cpp`` of
HKUST-Aerial-Robotics/VINS-Fusion; ``config/config_fpga_p2_euroc.yaml`` of ethz-asl/okvis and
``config/euroc.yaml`` of smartroboticslab/okvis2; ``svo_ros/param/calib/euroc_stereo.yaml`` of
uzh-rpg/rpg_svo_pro_open; ``configs/camera`` of sair-lab/AirSLAM; ``Pose2Sim/calibration.py`` of
perfanalytics/pose2sim, which keeps the format of lambdaloopy/aniposelib; ``cameras/camera_array.py`` of
mprib/caliscope; ``saveCamerasParams`` of rameau-fr/MC-Calib; ``FORMAT.md`` and ``io/import_calib.py`` of
oliver-batchelor/multical; ``mrcal/cameramodel.py`` of dkogan/mrcal; ``python/camera_model.py`` of
ori-mrg/robotcar-dataset-sdk; ``README.md`` of YoYo000/MVSNet.
"""

from __future__ import annotations

import ast
import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.rigs import (
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    pose_of,
    rigid,
    transform,
    two_cameras,
)
from geodiff_plugin.formats.storage import read_yaml, without_sizes
from geodiff_plugin.formats.units import in_stated_unit
from geodiff_plugin.types import Rig

#: Entries of one camera in a file, by key.
Entries = dict[str, Any]
#: Entries of each camera by number.
Cameras = dict[int, Entries]

#: VINS-Fusion's names of K for fisheye cameras -> names for other cameras.
VINS_KEYS = {"mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy"}
#: mrcal's lens models that OpenCV has, with their number of coefficients.
MRCAL_COUNTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}


class Pose(NamedTuple):
    """``(4, 4)`` transforms between a camera frame and the file's world frame."""

    world_from_camera: np.ndarray
    camera_from_world: np.ndarray


def _to_world(matrix: np.ndarray) -> Pose:
    return Pose(matrix, np.linalg.inv(matrix))


def _to_camera(matrix: np.ndarray) -> Pose:
    return Pose(np.linalg.inv(matrix), matrix)


@dataclass(frozen=True)
class PosedCameras:
    """Describes how a format stores its cameras; called with the texts of a file and a choice, reads the rig.

    Keys refer to one camera's entries; "camera.size" is an entry of an entry. The numbers of several keys,
    separated by blanks, are concatenated. A pose is a 4x4 or 3x4 matrix, or a rotation (9 numbers row-major,
    a rotation vector, or a quaternion x y z w) and a translation.

    Attributes:
        cameras: returns the entries of each camera by number, from the texts.
        K: keys of fx, fy, cx, cy, or of a 3x3 matrix.
        size: keys of width and height; empty if the file has none.
        lens: key of coefficients in OpenCV's order.
        model: key of the name of the lens model.
        lenses: OpenCV's model and the keys of its coefficients, by the file's name. Empty if names are as in
            ``LENS_MODELS``; ``lens`` then gives the coefficients.
        hint: hint for unsupported lens models.
        to_world: alternative keys of the camera-to-world pose.
        to_camera: alternative keys of the world-to-camera transform.
        pose: returns the pose of a camera by number, instead of keys.
        is_asked: whether the user must choose two of more than two cameras; otherwise the first two are used.
        has_unit: whether lengths are in metres; otherwise in the unit of the calibration board.
        rectified: whether the images are rectified.
    """

    cameras: Callable[[tuple[str, ...]], Cameras]
    K: str
    size: str = ""
    lens: str = ""
    model: str = ""
    lenses: Mapping[Any, tuple[str, str]] = field(default_factory=dict)
    hint: str = ""
    to_world: Sequence[str] = ()
    to_camera: Sequence[str] = ()
    pose: Callable[[Cameras, int], Pose] | None = None
    is_asked: bool = False
    has_unit: bool = True
    rectified: bool = False

    def __call__(self, texts: tuple[str, ...], choice: CameraChoice) -> Rig:
        """Return the rig of the chosen cameras, or of the first two."""
        cameras = self.cameras(texts)
        pair = self._pair(cameras, choice)
        left, right = (self.camera(cameras[n], f"camera {n}") for n in pair)
        of_left, of_right = (
            self.pose(cameras, n) if self.pose else self.pose_of(cameras[n], f"camera {n}") for n in pair
        )
        E = of_left.camera_from_world @ of_right.world_from_camera
        rig = make_rig(left, right, E, rectified=self.rectified)
        return rig if self.has_unit else in_stated_unit(rig, {}, (), choice)

    def _pair(self, cameras: Cameras, choice: CameraChoice) -> tuple[int, int]:
        if self.is_asked and len(cameras) > 2 and choice.cameras is None:
            numbered = ", ".join(f"{n} ({entries['name']})" for n, entries in cameras.items())
            bad_value("cameras", f"specified, two of {numbered}", "none", "Pass --cameras LEFT,RIGHT.")
        return two_cameras(choice, cameras, (0, 1))

    def camera(self, entries: Entries, name: str) -> RawCamera:
        """Return the camera of these entries; errors use ``name``."""
        numbers = _numbers(entries, self.K, name)
        square = array_of(numbers, (3, 3), f"{self.K} of {name}") if numbers.size != 4 else None
        size = [_entry(entries, key) for key in self.size.split()]
        model, lens = self._lens(entries)
        K = intrinsics(*numbers) if square is None else square
        return RawCamera(K, size[0] if len(size) == 1 else size or None, _numbers(entries, lens, name), model)

    def _lens(self, entries: Entries) -> tuple[str, str]:
        """Return the model and the keys of its coefficients; ``make_rig`` rejects unknown names."""
        kind = _entry(entries, self.model) if self.model else "opencv"
        if not self.lenses:
            return str(kind), self.lens
        if kind not in self.lenses:
            bad_value(self.model, f"one of {', '.join(map(str, self.lenses))}", kind, self.hint)
        return self.lenses[kind]

    def pose_of(self, entries: Entries, name: str) -> Pose:
        """Return the pose of these entries, from the first of the keys that exists."""
        for keys, of in ((self.to_world, _to_world), (self.to_camera, _to_camera)):
            for key in keys:
                with suppress(KeyError):
                    return of(_pose(entries, key, name))
        raise KeyError(" or ".join((*self.to_world, *self.to_camera)))


def _entry(entries: Entries, key: str) -> Any:
    """Return the value of a key such as ``camera.size``; for a matrix with rows and columns its numbers."""
    value: Any = entries
    for part in key.split("."):
        if not isinstance(value, dict) or part not in value:
            raise KeyError(key)
        value = value[part]
    return without_sizes(value)


def _numbers(entries: Entries, keys: str, name: str) -> np.ndarray:
    parts = [array_of(_entry(entries, key), (-1,), f"{key} of {name}") for key in keys.split()]
    return np.concatenate(parts) if parts else np.zeros(0)


def _pose(entries: Entries, keys: str, name: str) -> np.ndarray:
    """Return the ``(4, 4)`` matrix of a pose in any of the forms listed in ``PosedCameras``."""
    rotation, *further = [_numbers(entries, key, name) for key in keys.split()]
    numbers = np.concatenate([rotation, *further])
    source = f"{keys} of {name}"
    if rotation.size == 9:  # a rotation matrix under its own key; other matrices have their translation
        return transform(rotation, numbers[9:], source)
    if numbers.size == 6:  # a rotation vector and a translation
        return pose_of(Rotation.from_rotvec(numbers[:3]), numbers[3:])
    if numbers.size == 7:  # a quaternion and a translation
        return pose_of(Rotation.from_quat(numbers[:4]), numbers[4:])
    return rigid(numbers, source)


# Functions that return the cameras of each format. Entries keep the file's keys; added keys are documented.


def _pinhole(entries: Entries) -> Entries:
    """Return a camera's entries from Kalibr or EuRoC with its lens model and fx, fy, cx, cy only."""
    pinhole = dict(entries)
    if entries.get("camera_model", "pinhole") != "pinhole":  # MINS uses OpenVINS' chain without this key
        pinhole["distortion_model"] = entries["camera_model"]  # raises an error later
    if "intrinsics" in entries:
        pinhole["intrinsics"] = entries["intrinsics"][-4:]  # other models have their parameters before fx
    return pinhole


def kalibr_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read a Kalibr chain; D-Robotics' stereo cameras nest it under another name."""
    content = read_yaml(texts[0])
    below = (each for each in content.values() if isinstance(each, dict) and "cam0" in each)
    chain = content if "cam0" in content else next(below, content)
    return {int(key[3:]): _pinhole(each) for key, each in chain.items() if re.fullmatch(r"cam\d+", key)}


def kalibr_pose(cameras: Cameras, number: int) -> Pose:
    """Return the pose from transforms between consecutive cameras, or from each camera's pose to the IMU.

    OpenVINS writes ``T_imu_cam``, and Kalibr with an IMU ``T_cam_imu``.
    """
    if not all("T_cn_cnm1" in each for n, each in cameras.items() if n > 0):
        for key, of in (("T_imu_cam", _to_world), ("T_cam_imu", _to_camera)):
            if all(key in each for each in cameras.values()):
                return of(rigid(cameras[number][key], f"{key} of cam{number}"))
    pose = np.eye(4)
    for n in range(1, number + 1):
        pose = pose @ np.linalg.inv(rigid(cameras[n]["T_cn_cnm1"], f"T_cn_cnm1 of cam{n}"))
    return _to_world(pose)


def basalt_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read ``calibration.json``; merges its three lists of poses, intrinsics and sizes."""
    data = json.loads(texts[0])
    data = data.get("value0", data)
    lists = data["T_imu_cam"], data["intrinsics"], data["resolution"]
    return {
        n: {**pose, **each, "size": size} for n, (pose, each, size) in enumerate(zip(*lists, strict=False))
    }


def vins_files(text: str) -> list[str]:
    """Return the names of both cameras' files, which are next to a VINS-Fusion configuration."""
    return [str(read_yaml(text)[f"cam{n}_calib"]) for n in (0, 1)]


def vins_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read a configuration and the files in it; adds ``body_T_cam``, and flattens groups of parameters."""
    config, *files = (read_yaml(text) for text in texts)
    cameras = {}
    for number, entries in enumerate(files):
        lens = entries.get("distortion_parameters") or {}
        parameters = {**lens, **entries["projection_parameters"]}
        camera = dict(entries)
        camera |= {VINS_KEYS.get(key, key): value for key, value in parameters.items()}
        camera["model_type"] = str(entries["model_type"]).upper()
        camera["body_T_cam"] = config[f"body_T_cam{number}"]
        cameras[number] = camera
    return cameras


def euroc_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read one ``sensor.yaml`` per camera."""
    return {n: _pinhole(read_yaml(text)) for n, text in enumerate(texts)}


def okvis_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read the list of cameras in OKVIS settings."""
    return dict(enumerate(read_yaml(texts[0])["cameras"]))


def svo_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read a rig of SVO or maplab, possibly within a file of all sensors; adds ``lens_model``."""
    content = read_yaml(texts[0])
    rig = next((each for each in content.get("sensors", ()) if "cameras" in each), content)
    cameras = {}
    for n, each in enumerate(rig["cameras"]):
        kind = each["camera"]["type"]
        cameras[n] = each | {
            "lens_model": each["camera"]["distortion"]["type"] if kind == "pinhole" else kind
        }
    return cameras


def airslam_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read ``cam0`` and ``cam1`` of AirSLAM; adds ``T_body_cam`` or ``T_cam_body`` by ``T_type``."""
    content = read_yaml(texts[0])
    cameras = {}
    for n in (0, 1):
        each = content[f"cam{n}"]
        pose = {"T_body_cam" if each["T_type"] == 0 else "T_cam_body": each["T"]}
        cameras[n] = content | each | pose | {"fisheye_coeffs": each["distortion_coeffs"][:4]}
    return cameras


def anipose_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read the tables of a TOML file in order; caliscope nests them in ``cameras``."""
    content = tomllib.loads(texts[0])
    content = content["cameras"] if isinstance(content.get("cameras"), dict) else content
    tables = [(name, each) for name, each in content.items() if isinstance(each, dict) and "matrix" in each]
    return {n: {"name": name, "size": None, "fisheye": False} | each for n, (name, each) in enumerate(tables)}


def mc_calib_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read the cameras of ``calibrated_cameras_data.yml`` in order."""
    named = [(name, each) for name, each in read_yaml(texts[0]).items() if isinstance(each, dict)]
    named = [(name, each) for name, each in named if "camera_matrix" in each]
    return {n: {"name": name, "distortion_type": 0} | each for n, (name, each) in enumerate(named)}


def multical_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read the cameras of ``calibration.json`` in order; adds ``poses``, the poses of all cameras."""
    content = json.loads(texts[0])
    named = enumerate(content["cameras"].items())
    return {n: each | {"name": name, "poses": content["camera_poses"]} for n, (name, each) in named}


def multical_pose(cameras: Cameras, number: int) -> Pose:
    """Return the world-to-camera pose; ``LEFT_to_RIGHT`` is LEFT's pose with RIGHT as world."""
    name, poses = cameras[number]["name"], cameras[number]["poses"]
    T = np.eye(4)
    at = name
    for _ in poses:
        key = at if at in poses else next((key for key in poses if key.startswith(f"{at}_to_")), None)
        if key is None:
            break
        T = T @ _pose(poses[key], "R T", key)
        if key == at:
            return _to_camera(T)
        at = key.removeprefix(f"{at}_to_")
    bad_value("camera_poses", f"with a pose of {name}", ", ".join(poses) or "none", "Calibrate again.")


def mrcal_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read one ``.cameramodel`` per camera (Python literals, never evaluated); adds ``K`` and ``lens``."""
    return {n: _mrcal_camera(text) for n, text in enumerate(texts)}


def _mrcal_camera(text: str) -> Entries:
    try:
        model = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        model = None
    if not isinstance(model, dict):
        bad_value("the file", "a camera model of mrcal", "a different text", "The file may be truncated.")
    numbers = array_of(model["intrinsics"], (-1,), "intrinsics")
    kind = str(model["lensmodel"])
    if kind in MRCAL_COUNTS:
        array_of(numbers[4:], (MRCAL_COUNTS[kind],), "the coefficients in intrinsics")
    key = "rt_cam_ref" if "rt_cam_ref" in model else "extrinsics"  # current and older name
    pose = array_of(model[key], (6,), key)
    return model | {"lensmodel": kind, "K": numbers[:4], "lens": numbers[4:], "rt_cam_ref": pose}


def mvsnet_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read one ``cam.txt`` per camera: 16 numbers of the pose, 9 of K, and a line with the depth range."""
    cameras = {}
    for n, text in enumerate(texts):
        pose, _, K = text.partition("extrinsic")[2].partition("intrinsic")
        cameras[n] = {"extrinsic": pose.split()[:16], "intrinsic": K.split()[:9]}
    return cameras


def robotcar_cameras(texts: tuple[str, ...]) -> Cameras:
    """Read one model per camera: fx fy cx cy, and the pose of the image axes in the stereo camera's frame."""
    rows = [array_of(text.split(), (5, 4), "the model") for text in texts]
    return {n: {"K": each[0], "pose": each[1:]} for n, each in enumerate(rows)}


EUROC = PosedCameras(
    euroc_cameras,
    K="intrinsics",
    size="resolution",
    lens="distortion_coefficients",
    model="distortion_model",
    to_world=("T_BS",),
)
MVSNET = PosedCameras(mvsnet_cameras, K="intrinsic", to_camera=("extrinsic",))
