"""Reads inputs and results of programs for radiance fields and splats; none has a unit.

Source: ``utils/camera_utils.py`` (``camera_to_JSON``) of graphdeco-inria/gaussian-splatting;
``llff/poses/pose_utils.py`` of Fyusion/LLFF; ``models/dataset.py`` of Totoro97/NeuS;
``sdfstudio_dataparser.py`` of nerfstudio-project/nerfstudio; ``nerfies/camera.py`` of google/nerfies;
``README.md``, ``fairnr/data/data_utils.py`` of facebookresearch/NSVF; ``README.md`` of Kai-46/nerfplusplus.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import read_matrix, read_npy, read_text
from geodiff_plugin.formats.image_files import IMAGE_FOLDERS, files_of, image_folders, images_in
from geodiff_plugin.formats.layouts import (
    CameraPerImage,
    Candidate,
    CaptureFrame,
    Images,
    Layout,
    paired,
    posed,
)
from geodiff_plugin.formats.rigs import RawCamera, array_of, central_camera, intrinsics, rigid, transform
from geodiff_plugin.formats.storage import text_of_npz

#: Keys of every camera in 3D Gaussian splatting's ``cameras.json``.
OF_SPLATS = {"img_name", "position", "rotation", "fx", "fy", "width", "height"}
POSES_BOUNDS = "poses_bounds.npy"
#: Number of values per row of LLFF: a 3x4 pose with height, width and focal length, and depth bounds.
LLFF_ROW = 17
#: Names of the camera file of NeuS, IDR and their successors, and of the image folder.
NEUS_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
NEUS_IMAGES = ("image", "images", "rgb")
#: Nerfies' image folders, the largest first.
NERFIES_IMAGES = ("rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb/16x")
OF_NERFIES = {"orientation", "position", "focal_length", "principal_point", "image_size"}
Entries = dict[str, Any]


def read_splat_cameras(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read ``cameras.json`` of a 3D Gaussian splatting result: camera-to-world, central cameras."""
    for file in files_of(path, "cameras*.json"):
        data = json.loads(read_text(file, "PATH"))
        if isinstance(data, list) and data and all(set(each) >= OF_SPLATS for each in data):
            return _splat_cameras(file, data, images_at)
    return None


def _splat_cameras(file: Path, data: list[Entries], images_at: Path | None) -> Layout:
    folders = image_folders(file.parent, file.parent.parent)
    images = Images.find([str(each["img_name"]) for each in data], folders, file, images_at)

    def build(frame: CaptureFrame, entries: Entries) -> Candidate:
        R = array_of(entries["rotation"], (3, 3), "rotation")
        E = transform(R, array_of(entries["position"], (3,), "position"), "a pose")
        size = entries["width"], entries["height"]
        return posed(frame, E, central_camera(entries["fx"], entries["fy"], size))

    return images.layout("3D Gaussian splatting", data, build)


def read_llff(path: Path) -> Layout | None:
    """Read LLFF's ``poses_bounds.npy`` and its images in order of their names; central cameras."""
    file = path if path.name == POSES_BOUNDS else path / POSES_BOUNDS
    if not file.is_file():
        return None
    rows = read_npy(file, "PATH", f"{POSES_BOUNDS} of LLFF").astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != LLFF_ROW:
        bad_value(POSES_BOUNDS, f"an array with rows of {LLFF_ROW} numbers", f"shape {rows.shape} in {file}")
    places = [images_in(file.parent / name) for name in IMAGE_FOLDERS]
    images = next((images for images in places if len(images) == len(rows)), None)
    if images is None:
        counts = ", ".join(str(len(images)) for images in places if images) or "none"
        hint = f"Its poses have no names, so {IMAGE_FOLDERS[0]}/ must contain exactly those images."
        bad_value(POSES_BOUNDS, f"an array with one row per image ({counts})", f"{len(rows)}", hint)

    def build(frame: CaptureFrame, row: np.ndarray) -> Candidate:
        down, right, back, place, (height, width, focal) = row[:15].reshape(3, 5).T
        E = transform(np.column_stack([right, down, -back]), place, "a pose")
        return posed(frame, E, central_camera(focal, focal, (int(width), int(height))))

    # numpy's order of the names as text
    return Layout("LLFF", None, paired(sorted(images, key=_name), rows, build))


def read_neus(path: Path) -> Layout | None:
    """Read cameras of NeuS and IDR: a projection ``world_mat_I`` for image I of ``image/``."""
    file = next((at for name in NEUS_FILES if (at := path / name).is_file()), None)
    file = path if path.name in NEUS_FILES else file
    places = [] if file is None else [*(file.parent / name for name in NEUS_IMAGES), file.parent]
    images = next(filter(None, map(images_in, places)), [])
    if file is None or not images:
        return None
    matrices = json.loads(text_of_npz(file))

    def build(frame: CaptureFrame, number: int) -> Candidate:
        P = array_of(matrices[f"world_mat_{number}"], (4, 4), f"world_mat_{number}")[:3]
        K, R, centre = cv2.decomposeProjectionMatrix(P * np.sign(np.linalg.det(P[:, :3])))[:3]
        E = transform(R.T, centre[:3] / centre[3], "a pose")
        return posed(frame, E, RawCamera(K / K[2, 2]))

    return Layout("NeuS", None, paired(sorted(images, key=_name), range(len(images)), build))


def read_sdfstudio(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read SDFStudio's ``meta_data.json``: camera-to-world poses in OpenCV's axes, of a scaled scene."""
    for file in files_of(path, "meta_data.json"):
        data = json.loads(read_text(file, "PATH"))
        frames = data.get("frames") if isinstance(data, dict) else None
        if frames and all({"rgb_path", "camtoworld", "intrinsics"} <= set(each) for each in frames):
            return _sdfstudio(file, data, images_at)
    return None


def _sdfstudio(file: Path, data: Entries, images_at: Path | None) -> Layout:
    frames = data["frames"]
    images = Images.find([str(each["rgb_path"]) for each in frames], [file.parent], file, images_at)

    def build(frame: CaptureFrame, entries: Entries) -> Candidate:
        K = array_of([row[:3] for row in entries["intrinsics"][:3]], (3, 3), "intrinsics")
        K[:2, 2] -= 0.5  # nerfstudio's first pixel has its centre at (0.5, 0.5)
        E = rigid(np.ravel(entries["camtoworld"]), "camtoworld")
        return posed(frame, E, RawCamera(K, (data["width"], data["height"])))

    return images.layout("SDFStudio", frames, build)


def nerfies_camera(text: str, name: str) -> tuple[np.ndarray, RawCamera]:
    """Read a JSON of Nerfies, HyperNeRF or DyCheck, with a world-to-camera rotation."""
    entries = json.loads(text)
    missing = OF_NERFIES - set(entries)
    if missing:
        bad_value(name, "a camera of Nerfies", f"no {', '.join(sorted(missing))}")
    R = array_of(entries["orientation"], (3, 3), "orientation")
    E = transform(R.T, array_of(entries["position"], (3,), "position"), "a pose")
    fx = float(entries["focal_length"])
    # The corner of the first pixel is at (0, 0).
    centre = array_of(entries["principal_point"], (2,), "principal_point") - 0.5
    K = intrinsics(fx, fx * float(entries.get("pixel_aspect_ratio", 1.0)), *centre)
    K[0, 1] = float(entries.get("skew", 0.0))
    radial = entries.get("radial_distortion") or (0.0, 0.0, 0.0)
    tangential = entries.get("tangential_distortion", entries.get("tangential")) or (0.0, 0.0)
    lens = (radial[0], radial[1], tangential[0], tangential[1], radial[2])
    return E, RawCamera(K, entries["image_size"], lens)


#: ``camera/NAME.json`` for ``rgb/1x/NAME.png``, or a smaller copy.
NERFIES = CameraPerImage(
    "Nerfies", None, tuple((f"{folder}/*", "camera/{}.json") for folder in NERFIES_IMAGES), nerfies_camera
)


def read_nsvf(path: Path) -> Layout | None:
    """Read NSVF and NeRF++: ``rgb/``, ``pose/`` (camera-to-world), ``intrinsics.txt`` or a folder."""
    images = sorted(images_in(path / "rgb"), key=_name)
    poses, each = _texts(path / "pose"), _texts(path / "intrinsics")
    one = path / "intrinsics.txt"
    if not (images and poses and (each or one.is_file())):
        return None
    same = [image.stem for image in images] == [pose.stem for pose in poses]
    if len(images) != len(poses):
        hint = "NSVF matches images and poses in order of their names."
        bad_value("pose/", f"a folder of {len(images)} files, one per image in rgb/", f"{len(poses)}", hint)
    lenses = {file.stem: file for file in each}

    def build(frame: CaptureFrame, pose: Path) -> Candidate:
        lens = lenses.get(frame.name, one) if same else one
        E = rigid(read_matrix(pose, pose.name), pose.name)
        return posed(frame, E, RawCamera(read_matrix(lens, lens.name)[:3, :3]))

    return Layout("NSVF", None, paired(images, poses, build))


def _name(image: Path) -> str:
    return image.name


def _texts(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.txt"))
