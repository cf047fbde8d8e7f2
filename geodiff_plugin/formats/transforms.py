"""``transforms.json`` of nerfstudio, instant-ngp and their converters, as a capture and as a calibration.

Source: ``nerfstudio/data/dataparsers/nerfstudio_dataparser.py`` and ``scannetpp_dataparser.py`` of
nerfstudio-project/nerfstudio, ``src/nerf_loader.cu`` and ``scripts/colmap2nerf.py`` of NVlabs/instant-ngp,
``data/load_scene.py`` of barbararoessle/dense_depth_priors_nerf.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value, check_positive
from geodiff_plugin.formats.files import read_text, stored_size
from geodiff_plugin.formats.image_files import image_folders
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images, Layout
from geodiff_plugin.formats.rigs import (
    LENS_MODELS,
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    names_of_pair,
    rigid,
)
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

#: Of a transforms.json, by OpenCV's model: coefficients in its order, and those that it does not have.
NERF_LENSES = {
    "opencv": (("k1", "k2", "p1", "p2", "k3"), ("k4",)),
    "fisheye": (("k1", "k2", "k3", "k4"), ("p1", "p2")),
}
NERF_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: With these entries the poses come from structure from motion.
OF_COLMAP = ("colmap_im_id", "sharpness")
#: A last number of a pose further from 1 than this is a scale that was multiplied in.
SCALED = 1e-3
#: Files of a folder, the first that is there: nerfstudio's, NeRF's rendered scenes, ScanNet++'s.
FILES = (
    "transforms.json",
    "transforms_train.json",
    "dslr/nerfstudio/transforms_undistorted.json",
    "dslr/nerfstudio/transforms.json",
    "nerfstudio/transforms_undistorted.json",
    "nerfstudio/transforms.json",
)
#: Where ScanNet++ keeps the images of its two files: both have the same names, other lenses.
UNDISTORTED_FOLDERS = ("undistorted_images", "resized_undistorted_images")
DISTORTED_FOLDERS = ("resized_images", "original_images")
#: What files call the map of known depths of a frame.
DEPTHS = ("depth_file_path", "depth_path")
#: By what dense_depth_priors_nerf divides them.
DIVISOR = "depth_scaling_factor"
DEPTH_SUFFIXES = (".png", ".npy", ".tiff", ".tif", ".exr")
#: Entries that say a focal length.
FOCALS = ("fl_x", "fl_y", "fx", "fy", "camera_angle_x", "camera_angle_y")
#: The kind of these captures.
TRANSFORMS = "transforms.json"
#: Entries of a frame's camera as they are written: a pinhole in pixels, of OpenCV's model with no distortion.
NERF_CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")
#: Further entries of cameras and lenses, which those replace.
OTHERS_OF_CAMERA = (
    *("k3", "k4", "distortion_params", "camera_model"),
    *("camera_angle_x", "camera_angle_y", "fx", "fy"),
)
#: What to say where neither the file nor depth maps of a sensor tell that its lengths are metres.
ASSUMED_METRES = Message(
    "capture.assumed-metres",
    "The lengths of transforms.json are taken as metres, which it does not say. If its poses were solved "
    "from the images, give a length (--known-length).",
)
Frame = dict[str, Any]


@dataclass(frozen=True, eq=False)
class TransformsFile:
    """What a file says beside cameras: ``shared`` of all frames, and of each frame by its image."""

    path: Path
    shared: dict[str, Any]
    frames: dict[Path, Frame]


def nerf_frames(text: str) -> Iterator[Frame]:
    """Every frame, with the entries of the whole file that it does not have itself."""
    data = json.loads(text)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        got = f"with {', '.join(map(str, data)) or 'nothing'}" if isinstance(data, dict) else "another value"
        cure = "Names are in small letters: frames, file_path, transform_matrix."
        bad_value("transforms.json", "an object with a list 'frames'", got, cure)
    shared = {key: value for key, value in data.items() if key not in ("frames", "transform_matrix")}
    for number, frame in enumerate(data["frames"]):
        yield shared | {"file_path": f"frame {number}"} | frame


def nerf_camera(frame: Frame, image_size: tuple[int, int] | None = None) -> Camera:
    """The camera of a frame; ``image_size`` is that of its image, for files without ``w`` and ``h``."""
    size = (frame["w"], frame["h"]) if "w" in frame else image_size
    if size is None:
        cure = "Give image_size, the (width, height) of the images."
        bad_value("the file", "one with entries 'w' and 'h'", "none", cure)
    focals = []
    for axis, side in zip("xy", size, strict=True):
        angle = frame.get(f"camera_angle_{axis}")
        named = next((key for key in (f"fl_{axis}", f"f{axis}") if key in frame), None)
        if named is not None:
            focals.append(frame[named])
        elif angle is not None and not 0 < angle < math.pi:
            bad_value(f"camera_angle_{axis}", "in radians, between 0 and pi", angle, "Is it in degrees?")
        elif angle is not None:
            focals.append(0.5 * float(side) / math.tan(0.5 * angle))
    if not focals:
        bad_value("the file", "one with an entry 'fl_x' or 'camera_angle_x'", "none")
    K = intrinsics(focals[0], focals[-1], frame.get("cx", size[0] / 2), frame.get("cy", size[1] / 2))
    K[:2, 2] -= 0.5  # as COLMAP, nerfstudio (cameras.py) and instant-ngp have the first centre at (0.5, 0.5)
    model = str(frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV"))
    # Another model is refused with its name.
    coefficients, others = NERF_LENSES.get(LENS_MODELS.get(model.lower(), ""), ((), ()))
    lens = frame | dict(zip(NERF_PARAMS, frame.get("distortion_params", ()), strict=False))
    wrong = [lens[key] for key in others if lens.get(key)]
    if wrong:
        cure = "OpenCV does not have this model: undistort or rectify both images first."
        bad_value(" and ".join(others), f"zero for {model}", wrong, cure)
    return Camera(K, size, [lens.get(key, 0.0) for key in coefficients], model)


def nerf_pose(frame: Frame) -> np.ndarray | None:
    """``(4, 4)`` camera-to-world in OpenCV's axes, lengths as before nerfstudio's ``applied_scale``.

    ``None`` for a frame without pose: null, or with null or NaN in it. A homogeneous matrix may be scaled.
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
    """Whether a homogeneous matrix was multiplied by a factor: lengths were scaled, nobody says from what."""
    matrix = frame.get("transform_matrix")
    if matrix is None or _unknown(matrix):
        return False
    numbers = array_of(matrix, (-1,), "transform_matrix")
    return numbers.size == 16 and abs(numbers[15] - 1) > SCALED


def _unknown(matrix: Any) -> bool:
    """Whether a matrix holds null or NaN anywhere."""
    rows = matrix if isinstance(matrix, list) else [matrix]
    numbers = [number for row in rows for number in (row if isinstance(row, list) else [row])]
    return any(number is None or (isinstance(number, float) and math.isnan(number)) for number in numbers)


def read_nerf(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The two images of ``choice.image_names``, in the unit of the poses."""
    frames = {str(frame.get("file_path")): frame for frame in nerf_frames(texts[0])}
    left, right = (frames[name] for name in names_of_pair(frames, choice))
    poses = [pose for pose in map(nerf_pose, (left, right)) if pose is not None]
    if len(poses) < 2:
        bad_value("transform_matrix", "given for both images", "none for one of them")
    E = np.linalg.inv(poses[0]) @ poses[1]
    return make_rig(nerf_camera(left, choice.image_size), nerf_camera(right, choice.image_size), E)


def read_transforms(path: Path, images_at: Path | None = None) -> Layout | None:
    """The frames that a file names, or the file of a folder; depth maps by name or as ``depth/NAME``."""
    file = _file_of(path)
    if file is None:
        return None
    frames = list(nerf_frames(read_text(file, "PATH")))
    images = _images(frames, file, images_at)
    candidates = images.candidates(partial(_build, folder=file.parent), frames)
    solved = any(key in entries for entries in frames for key in OF_COLMAP) or any(map(_is_scaled, frames))
    notes = (*_notes(file), *images.notes)
    if not solved and all(each.frame.depth is None for each in candidates):
        notes = (*notes, ASSUMED_METRES)
    return Layout(TRANSFORMS, None if solved else "m", candidates, as_stored=True, notes=notes)


def _file_of(path: Path) -> Path | None:
    """The file that is, or lies in, a path; ``None`` where there is none of these."""
    file = path if path.is_file() else next((path / name for name in FILES if (path / name).is_file()), path)
    if file.suffix != ".json" or not file.is_file():
        return None
    text = read_text(file, "PATH")
    return None if file == path and not ('"frames"' in text and '"file_path"' in text) else file


def transforms_of(path: Path, images_at: Path | None = None) -> TransformsFile | None:
    """The entries of the file that ``read_transforms`` reads; ``None`` for another capture."""
    file = _file_of(path)
    if file is None:
        return None
    data = json.loads(read_text(file, "PATH"))
    frames = [frame for frame in data["frames"] if "file_path" in frame]
    images = _images(frames, file, images_at)
    of_image: dict[Path, Frame] = {}
    for name, frame in zip(images.names, frames, strict=True):
        if (image := images.file(name)) is not None:
            of_image.setdefault(image, frame)
    shared = {k: v for k, v in data.items() if k not in ("frames", *NERF_CAMERA, *OTHERS_OF_CAMERA)}
    without = ("file_path", *OTHERS_OF_CAMERA)
    of_image = {
        image: {"file_path": frame["file_path"]} | {k: v for k, v in frame.items() if k not in without}
        for image, frame in of_image.items()
    }
    return TransformsFile(file, shared, of_image)


def named_in_transforms(file: TransformsFile | None, name: Any) -> Path | None:
    """A file that an entry names, if it lies at or below the folder of the ``transforms.json``."""
    if file is None or not isinstance(name, str) or "\0" in name:
        return None
    folder = file.path.parent.resolve()
    path = (folder / name.replace("\\", "/")).resolve()
    return path if path.is_relative_to(folder) and os.path.isfile(path) else None


def _images(frames: Iterable[Frame], file: Path, images_at: Path | None) -> Images:
    """The images of the frames of a file, from its own folder on; ScanNet++'s are beside that."""
    folders = [UNDISTORTED_FOLDERS, DISTORTED_FOLDERS]
    of_scannetpp, of_other_lens = folders if "undistorted" in file.stem else folders[::-1]
    beside = [file.parent.parent / name for name in of_scannetpp]
    places = [*image_folders(file.parent), *(folder for folder in beside if folder.is_dir())]
    return Images([str(frame["file_path"]) for frame in frames], places, file, images_at, of_other_lens)


def _notes(file: Path) -> tuple[Message, ...]:
    """What to say of files of other frames beside the one that is read."""
    others = sorted(other.name for other in file.parent.glob("transforms_*.json") if other != file)
    if not file.name.startswith("transforms_train") or not others:
        return ()
    verb = "are" if len(others) > 1 else "is"
    sentence = f"{file.name} is read; {', '.join(others)} beside it {verb} not."
    return (Message("capture.part", sentence),)


def _build(frame: CaptureFrame, entries: Frame, folder: Path) -> Candidate:
    # Without a focal length K is typed, or of the photograph's EXIF.
    known = any(entries.get(key) is not None for key in FOCALS)
    camera = nerf_camera(entries, stored_size(frame.image, f"{frame.image}")) if known else None
    named = next((entries[key] for key in DEPTHS if entries.get(key)), None)
    names = [f"depth/{frame.image.stem}{suffix}" for suffix in DEPTH_SUFFIXES] if named is None else [named]
    maps = (folder / str(name).replace("\\", "/") for name in names)
    depth = next((map_ for map_ in maps if os.path.isfile(map_)), None)
    posed = replace(frame, E=nerf_pose(entries), depth=depth, depth_per_m=_depth_per_m(entries))
    return Candidate(posed, camera)


def _depth_per_m(entries: Frame) -> float | None:
    """Units of the depth maps in a metre, by a program's factor, which makes metres of them, or divisor."""
    for key in ("depth_unit_scale_factor", "integer_depth_scale"):
        if entries.get(key) is not None:
            return 1.0 / float(check_positive(entries[key], key, "metres a unit"))
    if entries.get(DIVISOR) is not None:
        return float(check_positive(entries[DIVISOR], DIVISOR, "units a metre"))
    return None
