"""Reads ``transforms.json`` of nerfstudio, instant-ngp etc., as a capture and as a calibration.

Source: ``nerfstudio/data/dataparsers/nerfstudio_dataparser.py`` and ``scannetpp_dataparser.py`` of
nerfstudio-project/nerfstudio, ``src/nerf_loader.cu`` and ``scripts/colmap2nerf.py`` of NVlabs/instant-ngp,
``data/load_scene.py`` of barbararoessle/dense_depth_priors_nerf.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_value, check_positive
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import read_text, stored_size
from geodiff_plugin.formats.image_files import image_folders
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images, Layout, posed
from geodiff_plugin.formats.rigs import (
    LENS_MODELS,
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    names_of_pair,
    rigid,
)
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.types import Rig

#: Lens coefficients in a transforms.json by OpenCV's model: in its order, and those that it lacks.
NERF_LENSES = {
    "opencv": (("k1", "k2", "p1", "p2", "k3"), ("k4",)),
    "fisheye": (("k1", "k2", "k3", "k4"), ("p1", "p2")),
}
NERF_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Keys whose presence shows that the poses are from structure from motion.
OF_COLMAP = ("colmap_im_id", "sharpness")
#: Minimum deviation from 1 of the last element of a pose that indicates a scale factor.
SCALED = 1e-3
#: File names in a folder, in order of precedence: nerfstudio's, NeRF's synthetic scenes, ScanNet++'s.
FILES = (
    "transforms.json",
    "transforms_train.json",
    "dslr/nerfstudio/transforms_undistorted.json",
    "dslr/nerfstudio/transforms.json",
    "nerfstudio/transforms_undistorted.json",
    "nerfstudio/transforms.json",
)
#: Image folders of ScanNet++'s two files, which share image names but not lenses.
UNDISTORTED_FOLDERS = ("undistorted_images", "resized_undistorted_images")
DISTORTED_FOLDERS = ("resized_images", "original_images")
#: Keys of a frame's depth map.
DEPTHS = ("depth_file_path", "depth_path")
#: Key of the divisor in dense_depth_priors_nerf.
DIVISOR = "depth_scaling_factor"
DEPTH_SUFFIXES = (".png", ".npy", ".tiff", ".tif", ".exr")
#: Keys of a focal length.
FOCALS = ("fl_x", "fl_y", "fx", "fy", "camera_angle_x", "camera_angle_y")
#: Name of this kind of capture.
TRANSFORMS = "transforms.json"
#: Keys of a frame's camera as written: a pinhole in pixels, of OpenCV's model without distortion.
NERF_CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")
#: Further keys of cameras and lenses, which are replaced.
OTHERS_OF_CAMERA = (
    *("k3", "k4", "distortion_params", "camera_model"),
    *("camera_angle_x", "camera_angle_y", "fx", "fy"),
)
#: Finding if neither the file nor sensor depth maps state that lengths are in metres.
ASSUMED_METRES = Finding(
    "capture.assumed-metres",
    "The lengths of transforms.json are assumed to be metres. If its poses were solved from the images, "
    "pass a known length (--known-length).",
)
Frame = dict[str, Any]


@dataclass(frozen=True, eq=False)
class TransformsFile:
    """Entries of a file other than intrinsics: ``shared`` by all frames, and per frame by its image."""

    path: Path
    shared: dict[str, Any]
    frames: dict[Path, Frame]


def nerf_frames(text: str) -> Iterator[Frame]:
    """Yield every frame, completed with entries of the whole file."""
    data = json.loads(text)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        got = (
            f"with {', '.join(map(str, data)) or 'nothing'}"
            if isinstance(data, dict)
            else "a different value"
        )
        hint = "Names are lower case: frames, file_path, transform_matrix."
        bad_value("transforms.json", "an object with a list 'frames'", got, hint)
    shared = {key: value for key, value in data.items() if key not in ("frames", "transform_matrix")}
    for number, frame in enumerate(data["frames"]):
        yield shared | {"file_path": f"frame {number}"} | frame


def nerf_camera(frame: Frame, image_size: tuple[int, int] | None = None) -> RawCamera:
    """Return the camera of a frame; ``image_size`` is for files without ``w`` and ``h``."""
    size = (frame["w"], frame["h"]) if "w" in frame else image_size
    if size is None:
        hint = "Pass image_size, the (width, height) of the images."
        bad_value("the file", "a file with entries 'w' and 'h'", "none", hint)
    focals = []
    for axis, side in zip("xy", size, strict=True):
        angle = frame.get(f"camera_angle_{axis}")
        named = next((key for key in (f"fl_{axis}", f"f{axis}") if key in frame), None)
        if named is not None:
            focals.append(frame[named])
        elif angle is not None and not 0 < angle < math.pi:
            bad_value(f"camera_angle_{axis}", "in radians, between 0 and pi", angle, "It may be in degrees.")
        elif angle is not None:
            focals.append(0.5 * float(side) / math.tan(0.5 * angle))
    if not focals:
        bad_value("the file", "a file with an entry 'fl_x' or 'camera_angle_x'", "none")
    K = intrinsics(focals[0], focals[-1], frame.get("cx", size[0] / 2), frame.get("cy", size[1] / 2))
    K[:2, 2] -= (
        0.5  # COLMAP, nerfstudio (cameras.py) and instant-ngp have the first pixel's centre at (0.5, 0.5)
    )
    model = str(frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV"))
    # Other models raise an error later, with their name.
    coefficients, others = NERF_LENSES.get(LENS_MODELS.get(model.lower(), ""), ((), ()))
    lens = frame | dict(zip(NERF_PARAMS, frame.get("distortion_params", ()), strict=False))
    wrong = [lens[key] for key in others if lens.get(key)]
    if wrong:
        hint = "OpenCV lacks this model. Undistort or rectify both images first."
        bad_value(" and ".join(others), f"zero for {model}", wrong, hint)
    return RawCamera(K, size, [lens.get(key, 0.0) for key in coefficients], model)


def nerf_pose(frame: Frame) -> np.ndarray | None:
    """Return ``(4, 4)`` camera-to-world in OpenCV's axes, with lengths before ``applied_scale``.

    ``None`` for a frame without pose: null, or with null or NaN. A homogeneous matrix may be scaled.
    """
    matrix = frame.get("transform_matrix")
    if matrix is None or _unknown(matrix):
        return None
    numbers = array_of(matrix, (-1,), "transform_matrix")
    if numbers.size == 16 and numbers[15] > 0 and not numbers[12:15].any():
        numbers = numbers / numbers[15]
    pose = rigid(numbers, "transform_matrix") @ OPENGL_FROM_OPENCV
    pose[:3, 3] /= check_positive(frame.get("applied_scale", 1.0), "applied_scale", "units")
    return pose


def _is_scaled(frame: Frame) -> bool:
    """Whether a homogeneous matrix was multiplied by a factor, so that lengths have an unknown scale."""
    matrix = frame.get("transform_matrix")
    if matrix is None or _unknown(matrix):
        return False
    numbers = array_of(matrix, (-1,), "transform_matrix")
    return numbers.size == 16 and abs(numbers[15] - 1) > SCALED


def _unknown(matrix: Any) -> bool:
    """Whether a matrix contains null or NaN."""
    rows = matrix if isinstance(matrix, list) else [matrix]
    numbers = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    return any(number is None or (isinstance(number, float) and math.isnan(number)) for number in numbers)


def read_nerf(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read the two images of ``choice.image_names``, in the unit of the poses."""
    frames = {str(frame.get("file_path")): frame for frame in nerf_frames(texts[0])}
    left, right = (frames[name] for name in names_of_pair(frames, choice))
    poses = [pose for pose in map(nerf_pose, (left, right)) if pose is not None]
    if len(poses) < 2:
        bad_value("transform_matrix", "specified for both images", "none for one of them")
    E = np.linalg.inv(poses[0]) @ poses[1]
    return make_rig(nerf_camera(left, choice.image_size), nerf_camera(right, choice.image_size), E)


def read_transforms(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read the frames of a file, or of the file in a folder; depth maps by name or as ``depth/NAME``."""
    file = _file_of(path)
    if file is None:
        return None
    frames = list(nerf_frames(read_text(file, "PATH")))
    images = _images(frames, file, images_at)
    candidates = images.candidates(partial(_build, folder=file.parent), frames)
    solved = any(key in entries for entries in frames for key in OF_COLMAP) or any(map(_is_scaled, frames))
    findings = (*_findings(file), *images.findings)
    if not solved and all(each.frame.depth is None for each in candidates):
        findings = (*findings, ASSUMED_METRES)
    return Layout(TRANSFORMS, None if solved else "m", candidates, as_stored=True, findings=findings)


def _file_of(path: Path) -> Path | None:
    """Return the file at or in a path; ``None`` if there is none."""
    file = path if path.is_file() else next((path / name for name in FILES if (path / name).is_file()), path)
    if file.suffix != ".json" or not file.is_file():
        return None
    text = read_text(file, "PATH")
    return None if file == path and not ('"frames"' in text and '"file_path"' in text) else file


def transforms_of(path: Path, images_at: Path | None = None) -> TransformsFile | None:
    """Return the entries of the file that ``read_transforms`` reads; ``None`` for another capture."""
    file = _file_of(path)
    if file is None:
        return None
    data = json.loads(read_text(file, "PATH"))
    frames = [frame for frame in data["frames"] if "file_path" in frame]
    images = _images(frames, file, images_at)
    frame_of: dict[Path, Frame] = {}
    for name, frame in zip(images.names, frames, strict=True):
        if (image := images.file(name)) is not None:
            frame_of.setdefault(image, _without_intrinsics(frame))
    del data["frames"]
    return TransformsFile(file, _without_intrinsics(data), frame_of)


def _without_intrinsics(entries: Frame) -> Frame:
    return {key: value for key, value in entries.items() if key not in (*NERF_CAMERA, *OTHERS_OF_CAMERA)}


def _images(frames: Iterable[Frame], file: Path, images_at: Path | None) -> Images:
    """Find the images of a file's frames in its folder; ScanNet++'s are next to that."""
    folders = [UNDISTORTED_FOLDERS, DISTORTED_FOLDERS]
    of_scannetpp, of_other_lens = folders if "undistorted" in file.stem else folders[::-1]
    siblings = [file.parent.parent / name for name in of_scannetpp]
    places = [*image_folders(file.parent), *(folder for folder in siblings if folder.is_dir())]
    return Images.find([str(frame["file_path"]) for frame in frames], places, file, images_at, of_other_lens)


def _findings(file: Path) -> tuple[Finding, ...]:
    """Return a finding on unread files of other frames in the same folder."""
    others = sorted(other.name for other in file.parent.glob("transforms_*.json") if other != file)
    if not file.name.startswith("transforms_train") or not others:
        return ()
    verb = "are" if len(others) > 1 else "is"
    sentence = f"{file.name} is read; {', '.join(others)} in the same folder {verb} not."
    return (Finding("capture.part", sentence),)


def _build(frame: CaptureFrame, entries: Frame, folder: Path) -> Candidate:
    # Without a focal length, K comes from options or EXIF.
    known = any(entries.get(key) is not None for key in FOCALS)
    camera = nerf_camera(entries, stored_size(frame.image, f"{frame.image}")) if known else None
    named = next((entries[key] for key in DEPTHS if entries.get(key)), None)
    names = [f"depth/{frame.image.stem}{suffix}" for suffix in DEPTH_SUFFIXES] if named is None else [named]
    maps = (folder / str(name).replace("\\", "/") for name in names)
    depth = next((map_ for map_ in maps if os.path.isfile(map_)), None)
    mask = entries.get("mask_path")
    file = folder / mask.replace("\\", "/") if isinstance(mask, str) and "\0" not in mask else None
    found = {"depth": depth, "depth_per_m": _depth_per_m(entries), "mask": file}
    return posed(frame, nerf_pose(entries), camera, **found)


def _depth_per_m(entries: Frame) -> float | None:
    """Return units of the depth maps per metre, from a program's factor to metres or divisor."""
    for key in ("depth_unit_scale_factor", "integer_depth_scale"):
        if entries.get(key) is not None:
            return 1.0 / float(check_positive(entries[key], key, "metres per unit"))
    if entries.get(DIVISOR) is not None:
        return float(check_positive(entries[DIVISOR], DIVISOR, "units per metre"))
    return None
