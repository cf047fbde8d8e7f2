"""Reads JSON of OpenMVG and AliceVision (Meshroom): views, cameras and poses, without a unit.

Source: ``sfm/sfm_view_io.hpp``, ``cameras/Camera_*_io.hpp`` and ``Camera_undistort_image.hpp`` of
openMVG/openMVG; ``sfmDataIO/jsonIO.cpp``, ``camera/cameraCommon.hpp`` and ``IntrinsicScaleOffset.cpp`` of
alicevision/AliceVision. Both count pixels from the centre of the first one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import read_text
from geodiff_plugin.formats.image_files import files_of, image_folders
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images, Layout, posed
from geodiff_plugin.formats.rigs import RawCamera, array_of, intrinsics, transform

#: OpenCV's models of OpenMVG's cameras, with the key of the coefficients.
OPENMVG_LENSES = {
    "pinhole": ("opencv", ""),
    "pinhole_radial_k1": ("opencv", "disto_k1"),
    "pinhole_radial_k3": ("opencv", "disto_k3"),
    "pinhole_brown_t2": ("opencv", "disto_t2"),
    "fisheye": ("fisheye", "fisheye"),
}
#: OpenCV's models of AliceVision's distortion types, older names first.
ALICEVISION_LENSES = {
    **dict.fromkeys(("pinhole", "none", "radial1", "radialk1", "radial3", "radialk3", "brown"), "opencv"),
    **dict.fromkeys(("fisheye4", "fisheye"), "fisheye"),
}
#: Bit set by cereal in the number of a class when it also writes its name.
FIRST_OF_CLASS = 0x80000000
UNDISTORT = "Undistort the images (openMVG_main_ExportUndistortedImages), or convert it to COLMAP's format."
EXPORT_COLMAP = "Run: aliceVision_exportColmap."
Entries = dict[str, Any]


def _opencv_order(numbers: Sequence[float]) -> list[float]:
    """Return OpenCV's ``k1 k2 p1 p2 k3`` from the leading coefficients of ``k1 k2 k3 p1 p2``."""
    k1, k2, k3, p1, p2 = [*numbers, *[0.0] * (5 - len(numbers))]
    return [k1, k2, p1, p2, k3]


def _pose(rotation: np.ndarray, centre: Any) -> np.ndarray:
    """Return the camera-to-world pose of a world-to-camera rotation and a camera position."""
    return transform(rotation.T, array_of(centre, (3,), "center"), "a pose")


def _with_most_poses(
    path: Path, patterns: Iterable[str], mark: str, poses: str
) -> tuple[Path, Entries] | None:
    """Return the file with most entries under ``poses`` among those with ``mark`` in a folder."""
    found = [(file, json.loads(read_text(file, "PATH"))) for file in files_of(path, *patterns)]
    ours = [
        (file, data) for file, data in found if isinstance(data, dict) and mark in data and "views" in data
    ]
    return max(ours, key=lambda each: len(each[1].get(poses) or ()), default=None)


def read_openmvg(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read OpenMVG's ``sfm_data.json``; in a folder with several, the one with most poses."""
    found = _with_most_poses(path, ("sfm_data*.json",), "sfm_data_version", "extrinsics")
    if found is None:
        return None
    file, data = found
    views = [_flat(each) for each in data["views"]]
    names = [f"{view['local_path']}/{view['filename']}".lstrip("/") for view in views]
    cameras = dict[int, tuple[str, Entries]]()
    classes = dict[int, str]()
    for each in data["intrinsics"]:
        number = int(each["value"]["polymorphic_id"])
        if number >= FIRST_OF_CLASS:
            classes[number - FIRST_OF_CLASS] = str(each["value"]["polymorphic_name"])
        cameras[each["key"]] = classes[number % FIRST_OF_CLASS], _flat(each)
    poses = {each["key"]: each["value"] for each in data["extrinsics"]}

    def build(frame: CaptureFrame, view: Entries) -> Candidate:
        pose, camera = poses.get(view["id_pose"]), cameras.get(view["id_intrinsic"])
        E = pose and _pose(array_of(pose["rotation"], (3, 3), "rotation"), pose["center"])
        return posed(frame, E, camera and _openmvg_camera(*camera))

    images = Images.find(names, image_folders(file.parent, file.parent.parent), file, images_at)
    return images.layout("OpenMVG", views, build)


def _flat(each: Entries) -> Entries:
    """Return the entries of a view or camera, merged with its base class's."""
    data = each["value"]["ptr_wrapper"]["data"]
    return data.get("value0", {}) | data


def _openmvg_camera(kind: str, data: Entries) -> RawCamera:
    if kind not in OPENMVG_LENSES:
        bad_value("the camera", f"one of {', '.join(OPENMVG_LENSES)}", kind, UNDISTORT)
    model, entry = OPENMVG_LENSES[kind]
    numbers = data[entry] if entry else ()
    f = data["focal_length"]
    size = (data["width"], data["height"])
    coefficients = numbers if model == "fisheye" else _opencv_order(numbers)
    return RawCamera(intrinsics(f, f, *data["principal_point"]), size, coefficients, model)


def read_alicevision(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read AliceVision's ``.sfm`` or ``sfm.json``; in a folder with several, the one with most poses."""
    found = _with_most_poses(path, ("*.sfm", "sfm*.json"), "version", "poses")
    if found is None:
        return None
    file, data = found
    version = tuple(int(part) for part in data["version"])
    cameras = {each["intrinsicId"]: each for each in data.get("intrinsics") or ()}
    poses = {each["poseId"]: each["pose"]["transform"] for each in data.get("poses") or ()}

    def build(frame: CaptureFrame, view: Entries) -> Candidate:
        pose, camera = poses.get(view["poseId"]), cameras.get(view["intrinsicId"])
        # Eigen's order is column-major.
        E = pose and _pose(array_of(pose["rotation"], (3, 3), "rotation").T, pose["center"])
        return posed(frame, E, camera and _alicevision_camera(camera, version))

    views = data["views"]
    folders = image_folders(file.parent, file.parent.parent)
    images = Images.find([str(view["path"]) for view in views], folders, file, images_at)
    return images.layout("AliceVision", views, build)


def _alicevision_camera(entries: Entries, version: tuple[int, ...]) -> RawCamera:
    kind = str(entries.get("distortionType", entries.get("type"))).lower()
    undistortion = entries.get("undistortionType", "none")
    if kind not in ALICEVISION_LENSES or undistortion != "none" or entries["type"] == "equidistant":
        got = kind if undistortion == "none" else undistortion
        bad_value("the lens", f"one of {', '.join(ALICEVISION_LENSES)}", got, EXPORT_COLMAP)
    width, height = (int(entries[side]) for side in ("width", "height"))
    offset = array_of(entries["principalPoint"], (2,), "principalPoint")
    middle = np.zeros(2) if version < (1, 2, 1) else np.array([width, height]) / 2
    numbers = array_of(entries.get("distortionParams") or (), (-1,), "distortionParams").tolist()
    model = ALICEVISION_LENSES[kind]
    coefficients = numbers if model == "fisheye" else _opencv_order(numbers)
    K = intrinsics(*_focals_px(entries, version, (width, height)), *(middle + offset))
    return RawCamera(K, (width, height), coefficients, model)


def _focals_px(entries: Entries, version: tuple[int, ...], size: tuple[int, int]) -> tuple[float, float]:
    """Return focal lengths in pixels; older files have pixels, newer ones millimetres on the sensor."""
    if version < (1, 2, 2):
        found = array_of(entries["pxFocalLength"], (-1,), "pxFocalLength")
        return float(found[0]), float(found[-1])
    if size[1] > size[0]:  # the program writes them by the longer side, but reads them by the width
        expected = "a landscape image, whose focal length is unambiguous"
        bad_value("a camera of AliceVision", expected, "{}x{}".format(*size), EXPORT_COLMAP)
    px = float(entries["focalLength"]) / float(entries.get("sensorWidth", 36.0)) * size[0]
    ratio = float(entries.get("pixelRatio", 1.0))
    if version < (1, 2, 5):
        return px, px / ratio
    return (px, px * ratio) if version < (1, 2, 11) else (px / ratio, px)
