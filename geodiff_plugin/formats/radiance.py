"""Inputs and results of programs for radiance fields and splats; none has a unit.

Source: ``utils/camera_utils.py`` (``camera_to_JSON``) of graphdeco-inria/gaussian-splatting;
``llff/poses/pose_utils.py`` of Fyusion/LLFF; ``models/dataset.py`` of Totoro97/NeuS;
``sdfstudio_dataparser.py`` of nerfstudio-project/nerfstudio; ``nerfies/camera.py`` of google/nerfies;
``README.md``, ``fairnr/data/data_utils.py`` of facebookresearch/NSVF; ``README.md`` of Kai-46/nerfplusplus.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import read_matrix, read_npy, read_text
from geodiff_plugin.formats.image_files import IMAGE_FOLDERS, files_of, image_folders, images_in
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images, Layout, build_frame
from geodiff_plugin.formats.rigs import Camera, array_of, central_camera, intrinsics, rigid, transform
from geodiff_plugin.formats.storage import text_of_npz

#: Entries of every camera of 3D Gaussian splatting's ``cameras.json``.
OF_SPLATS = {"img_name", "position", "rotation", "fx", "fy", "width", "height"}
POSES_BOUNDS = "poses_bounds.npy"
#: Numbers of LLFF's rows: a 3x4 pose beside height, width and focal length, and the bounds of the depth.
LLFF_ROW = 17
#: What NeuS, IDR and their successors call the file of cameras, and the folder of images.
NEUS_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
NEUS_IMAGES = ("image", "images", "rgb")
#: Nerfies' folders of images, the largest first.
NERFIES_IMAGES = ("rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb/16x")
OF_NERFIES = {"orientation", "position", "focal_length", "principal_point", "image_size"}
Entries = dict[str, Any]


def read_splat_cameras(path: Path, images_at: Path | None = None) -> Layout | None:
    """``cameras.json`` beside a result of 3D Gaussian splatting: camera-to-world, central cameras."""
    for file in files_of(path, "cameras*.json"):
        data = json.loads(read_text(file, "PATH"))
        if isinstance(data, list) and data and all(set(each) >= OF_SPLATS for each in data):
            return _splat_cameras(file, data, images_at)
    return None


def _splat_cameras(file: Path, data: list[Entries], images_at: Path | None) -> Layout:
    folders = image_folders(file.parent, file.parent.parent)
    images = Images([str(each["img_name"]) for each in data], folders, file, images_at)

    def build(frame: CaptureFrame, entries: Entries) -> Candidate:
        R = array_of(entries["rotation"], (3, 3), "rotation")
        E = transform(R, array_of(entries["position"], (3,), "position"), "a pose")
        size = entries["width"], entries["height"]
        return Candidate(replace(frame, E=E), central_camera(entries["fx"], entries["fy"], size))

    return Layout("3D Gaussian splatting", None, images.candidates(build, data), notes=images.notes)


def read_llff(path: Path) -> Layout | None:
    """LLFF's ``poses_bounds.npy`` and its images, in the order of their names; central cameras."""
    file = path if path.name == POSES_BOUNDS else path / POSES_BOUNDS
    if not file.is_file():
        return None
    rows = read_npy(file, "PATH", f"{POSES_BOUNDS} of LLFF").astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != LLFF_ROW:
        bad_value(POSES_BOUNDS, f"of rows of {LLFF_ROW} numbers", f"shape {rows.shape} in {file}")
    places = [images_in(file.parent / name) for name in IMAGE_FOLDERS]
    images = next((images for images in places if len(images) == len(rows)), None)
    if images is None:
        counts = ", ".join(str(len(images)) for images in places if images) or "none"
        cure = f"Its poses have no names: {IMAGE_FOLDERS[0]}/ must hold those images, and no other."
        bad_value(POSES_BOUNDS, f"of as many rows as there are images ({counts})", f"{len(rows)}", cure)

    def build(frame: CaptureFrame, row: np.ndarray) -> Candidate:
        down, right, back, place, (height, width, focal) = row[:15].reshape(3, 5).T
        E = transform(np.column_stack([right, down, -back]), place, "a pose")
        return Candidate(replace(frame, E=E), central_camera(focal, focal, (int(width), int(height))))

    # In the order in which numpy sorted the names, as text.
    pairs = zip(sorted(images, key=lambda image: image.name), rows, strict=True)
    candidates = [
        build_frame(CaptureFrame(image.stem, image), partial(build, row=row)) for image, row in pairs
    ]
    return Layout("LLFF", None, candidates)


def read_neus(path: Path) -> Layout | None:
    """Cameras of NeuS and IDR: a projection ``world_mat_I`` for image I of ``image/``."""
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
        return Candidate(replace(frame, E=E), Camera(K / K[2, 2]))

    candidates = [
        build_frame(CaptureFrame(image.stem, image), partial(build, number=number))
        for number, image in enumerate(sorted(images, key=lambda image: image.name))
    ]
    return Layout("NeuS", None, candidates)


def read_sdfstudio(path: Path, images_at: Path | None = None) -> Layout | None:
    """SDFStudio's ``meta_data.json``: camera-to-world poses in OpenCV's axes, of a scene that was scaled."""
    for file in files_of(path, "meta_data.json"):
        data = json.loads(read_text(file, "PATH"))
        frames = data.get("frames") if isinstance(data, dict) else None
        if frames and all({"rgb_path", "camtoworld", "intrinsics"} <= set(each) for each in frames):
            return _sdfstudio(file, data, images_at)
    return None


def _sdfstudio(file: Path, data: Entries, images_at: Path | None) -> Layout:
    frames = data["frames"]
    images = Images([str(each["rgb_path"]) for each in frames], [file.parent], file, images_at)

    def build(frame: CaptureFrame, entries: Entries) -> Candidate:
        K = array_of([row[:3] for row in entries["intrinsics"][:3]], (3, 3), "intrinsics")
        K[:2, 2] -= 0.5  # nerfstudio has the centre of the first pixel at (0.5, 0.5)
        E = rigid(np.ravel(entries["camtoworld"]), "camtoworld")
        return Candidate(replace(frame, E=E), Camera(K, (data["width"], data["height"])))

    return Layout("SDFStudio", None, images.candidates(build, frames), notes=images.notes)


def read_nerfies(path: Path) -> Layout | None:
    """Folders of Nerfies, HyperNeRF and DyCheck: ``camera/NAME.json`` of ``rgb/1x/NAME.png``."""
    images = next(filter(None, (images_in(path / name) for name in NERFIES_IMAGES)), [])
    files = [path / "camera" / f"{image.stem}.json" for image in images]
    if not any(file.is_file() for file in files):
        return None
    candidates = [
        build_frame(CaptureFrame(image.stem, image), partial(_nerfies_frame, file=file))
        for image, file in zip(images, files, strict=True)
    ]
    return Layout("Nerfies", None, candidates)


def _nerfies_frame(frame: CaptureFrame, file: Path) -> Candidate:
    entries = json.loads(read_text(file, f"the camera of {frame.name}"))
    missing = OF_NERFIES - set(entries)
    if missing:
        bad_value(f"the camera of {frame.name}", "one of Nerfies", f"no {', '.join(sorted(missing))}")
    R = array_of(entries["orientation"], (3, 3), "orientation")  # from the world to the camera
    E = transform(R.T, array_of(entries["position"], (3,), "position"), "a pose")
    fx = float(entries["focal_length"])
    # The corner of the first pixel is at (0, 0).
    centre = array_of(entries["principal_point"], (2,), "principal_point") - 0.5
    K = intrinsics(fx, fx * float(entries.get("pixel_aspect_ratio", 1.0)), *centre)
    K[0, 1] = float(entries.get("skew", 0.0))
    radial = entries.get("radial_distortion") or (0.0, 0.0, 0.0)
    tangential = entries.get("tangential_distortion", entries.get("tangential")) or (0.0, 0.0)
    lens = (radial[0], radial[1], tangential[0], tangential[1], radial[2])
    return Candidate(replace(frame, E=E), Camera(K, entries["image_size"], lens))


def read_nsvf(path: Path) -> Layout | None:
    """NSVF's and NeRF++'s folders: ``rgb/``, ``pose/`` (camera-to-world), ``intrinsics.txt`` or a folder."""
    images = sorted(images_in(path / "rgb"), key=lambda image: image.name)
    poses, each = _texts(path / "pose"), _texts(path / "intrinsics")
    one = path / "intrinsics.txt"
    if not (images and poses and (each or one.is_file())):
        return None
    same = [image.stem for image in images] == [pose.stem for pose in poses]
    if len(images) != len(poses):
        cure = "Images and poses of NSVF belong together in the order of their names."
        bad_value("pose/", f"of {len(images)} files, one for each image of rgb/", f"{len(poses)}", cure)
    lenses = {file.stem: file for file in each}

    def build(frame: CaptureFrame, pose: Path) -> Candidate:
        lens = lenses.get(frame.name, one) if same else one
        E = rigid(read_matrix(pose, pose.name), pose.name)
        return Candidate(replace(frame, E=E), Camera(read_matrix(lens, lens.name)[:3, :3]))

    pairs = zip(images, poses, strict=True)
    candidates = [build_frame(CaptureFrame(image.stem, image), partial(build, pose=p)) for image, p in pairs]
    return Layout("NSVF", None, candidates)


def _texts(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.txt"))
