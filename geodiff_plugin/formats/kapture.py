"""Reads Kapture's sensors, records and trajectories as a capture; the format has no unit.

Source: ``kapture_format.adoc`` of naver/kapture: poses are world-to-device, camera models are COLMAP's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.colmap import model_camera
from geodiff_plugin.formats.files import read_text
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images, Layout, posed
from geodiff_plugin.formats.rigs import RawCamera, array_of, pose_of

#: Model of an uncalibrated sensor, whose K comes from options or EXIF.
UNKNOWN_CAMERA = "UNKNOWN_CAMERA"


def read_kapture(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read the images of ``sensors/records_camera.txt``, with their own pose or their rig's."""
    for folder in (path / "sensors", path):
        files = [folder / f"{name}.txt" for name in ("sensors", "records_camera")]
        if all(file.is_file() for file in files):
            return _kapture(folder, images_at)
    return None


def _rows(file: Path) -> list[list[str]]:
    """Return the comma-separated fields of each line."""
    lines = read_text(file, f"{file}").splitlines()
    rows = [[field.strip() for field in line.split(",")] for line in lines]
    return [row for row in rows if row != [""] and not row[0].startswith("#")]


def _poses(file: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return ``(4, 4)`` transforms by the first two fields, without incomplete ones."""
    if not file.is_file():
        return {}
    poses = {}
    for first, second, *numbers in _rows(file):
        if all(numbers[:7]) and len(numbers) >= 7:
            qw, qx, qy, qz, *place = array_of(numbers[:7], (7,), f"{file.name}: a pose")
            poses[first, second] = pose_of(Rotation.from_quat([qx, qy, qz, qw]), place)
    return poses


def _kapture(folder: Path, images_at: Path | None) -> Layout:
    cameras: dict[str, RawCamera | str | None] = {}
    for device, _, kind, *words in _rows(folder / "sensors.txt"):
        if kind == "camera":
            cameras[device] = _camera(device, words)
    trajectories, rigs = _poses(folder / "trajectories.txt"), _poses(folder / "rigs.txt")
    rig_of = {sensor: (rig, T_sensor_from_rig) for (rig, sensor), T_sensor_from_rig in rigs.items()}
    records = _rows(folder / "records_camera.txt")

    def build(frame: CaptureFrame, record: list[str]) -> Candidate:
        time, device, *_ = record
        camera = cameras.get(device, f"sensor {device} is not in sensors.txt")
        if isinstance(camera, str):
            raise InputError(camera)
        T_camera_from_world = trajectories.get((time, device))
        if T_camera_from_world is None and device in rig_of:
            rig, T_camera_from_rig = rig_of[device]
            T_rig_from_world = trajectories.get((time, rig))
            T_camera_from_world = None if T_rig_from_world is None else T_camera_from_rig @ T_rig_from_world
        E = None if T_camera_from_world is None else np.linalg.inv(T_camera_from_world)
        return posed(frame, E, camera)

    folders = [at for at in (folder / "records_data", folder) if at.is_dir()]
    images = Images.find([name for _, _, name, *_ in records], folders, folder, images_at)
    return images.layout("kapture", records, build)


def _camera(device: str, words: list[str]) -> RawCamera | str | None:
    """Return the camera of ``model, w, h, parameters``, a reason if unusable, or ``None`` if unknown."""
    model, width, height, *numbers = words
    if model == UNKNOWN_CAMERA:
        return None
    try:
        return model_camera(device, model, (int(float(width)), int(float(height))), " ".join(numbers))
    except InputError as error:
        return str(error)
