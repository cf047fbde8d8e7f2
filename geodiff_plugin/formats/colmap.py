"""A COLMAP model in text: ``cameras.txt`` and ``images.txt``, and the names of two images in it.

Data flow: lines of two images and of their cameras -> ``Rig``, in the model's unit.
Paper: S5.1 (Tanks and Temples).
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.image_names import names_of_pair
from geodiff_plugin.formats.lenses import FactoryCamera, lens_of, rig_of_cameras
from geodiff_plugin.formats.rigs import intrinsics, pose_from_world_to_camera
from geodiff_plugin.formats.structured import array_of
from geodiff_plugin.types import Rig

__all__ = ["COLMAP", "image_list", "matches", "read"]

#: Of a model: how many focal lengths stand before cx cy, OpenCV's name of its lens, how many of its
#: coefficients stand behind. Where OpenCV has more, those that are not there are zero.
MODELS = {
    "SIMPLE_PINHOLE": (1, "opencv", 0),
    "PINHOLE": (2, "opencv", 0),
    "SIMPLE_RADIAL": (1, "opencv", 1),
    "RADIAL": (1, "opencv", 2),
    "OPENCV": (2, "opencv", 4),
    "FULL_OPENCV": (2, "opencv", 8),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", 1),
    "RADIAL_FISHEYE": (1, "fisheye", 2),
    "OPENCV_FISHEYE": (2, "fisheye", 4),
}
#: COLMAP's models that OpenCV does not have.
FOREIGN = ("FOV", "THIN_PRISM_FISHEYE")
CAMERA = re.compile(r"^(\d+) ([A-Z_]+) (\d+) (\d+) (.+)$", re.MULTILINE)
IMAGE = re.compile(r"^(\d+)((?: [-+.\deE]+){7}) (\d+) (\S.*)$", re.MULTILINE)
CAMERAS_MARK, IMAGES_MARK = "# Camera list with", "# Image list with"
LONGEST_HEAD = 200
UNDISTORT = "Undistort the images first (colmap image_undistorter) and give the model that it writes."


def image_list(path: Path) -> str | None:
    """The text of an ``images.txt`` without its points, which of many photographs are hundreds of megabytes.

    A file that did not change since it was read last is not read again: every pair of a run asks for it.

    Args:
        path: an existing file.

    Returns:
        Comments and a line an image; ``None`` for a file without COLMAP's head.
    """
    found = path.stat()
    return _image_list(path.absolute(), found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=2)
def _image_list(path: Path, size: int, changed_ns: int) -> str | None:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(LONGEST_HEAD)
        if not head.startswith(IMAGES_MARK):
            return None
        return head + "".join(line for line in file if line.startswith("#") or IMAGE.match(line))


def matches(text: str, path: Path) -> bool:
    """Whether it opens with COLMAP's head of ``cameras.txt`` or ``images.txt``, or has lines of either."""
    if CAMERAS_MARK in text or IMAGES_MARK in text:
        return True
    found = CAMERA.search(text)
    return (found is not None and found.group(2) in (*MODELS, *FOREIGN)) or IMAGE.search(text) is not None


def _cameras(file: CalibrationFile) -> dict[str, FactoryCamera]:
    cameras = {}
    for number, model, width, height, words in CAMERA.findall(file.text):
        where = f"camera {number} in {file.path}"
        if model not in MODELS:
            bad_value(f"the model of {where}", f"one of {', '.join(MODELS)}", model, UNDISTORT)
        count, kind, behind = MODELS[model]
        numbers = array_of(words.split(), (count + 2 + behind,), f"parameters of {where}")
        fx, fy = numbers[0], numbers[count - 1]
        # COLMAP puts the centre of the first pixel at (0.5, 0.5).
        cx, cy = numbers[count : count + 2] - 0.5
        coefficients = np.pad(numbers[count + 2 :], (0, max(4 - behind, 0)))
        lens = lens_of(coefficients, f"the lens of {where}", kind)
        cameras[number] = FactoryCamera(intrinsics(fx, fy, cx, cy), (int(width), int(height)), lens)
    return cameras


def _images(file: CalibrationFile) -> dict[str, tuple[np.ndarray, str]]:
    """World-to-camera transform and number of the camera, by the image's name."""
    images = {}
    for number, words, camera, name in IMAGE.findall(file.text):
        qw, qx, qy, qz, *translation = array_of(words.split(), (7,), f"image {number} in {file.path}")
        if not (qw, qx, qy, qz) != (0.0, 0.0, 0.0, 0.0):
            bad_value(f"the rotation of {name} in {file.path}", "a quaternion", "zeros")
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
        T[:3, 3] = translation
        images[name.strip()] = (T, camera)
    return images


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of the two images of ``choice.image_names``; both files in any order.

    Lengths keep the model's unit, which is no metre: one measured distance gives it (``baseline_m``).

    Raises:
        ValueError: no such images, no names, a model that OpenCV does not have, or two files of one
            kind.
    """
    by_kind = {bool(CAMERA.search(file.text)) and IMAGES_MARK not in file.text: file for file in files}
    if len(by_kind) != 2:
        bad_value("calibration", "cameras.txt and images.txt", " and ".join(str(file.path) for file in files))
    cameras, images = _cameras(by_kind[True]), _images(by_kind[False])
    names = names_of_pair(images, choice, by_kind[False].path, "a COLMAP model")
    (T_left, left), (T_right, right) = (images[name] for name in names)
    for camera in (left, right):
        if camera not in cameras:
            bad_value(
                f"{by_kind[True].path}", f"with camera {camera}", f"only {', '.join(cameras)}", "Cut off?"
            )
    source = " and ".join(str(file.path) for file in files)
    E = pose_from_world_to_camera(T_left, T_right)
    return rig_of_cameras(cameras[left], cameras[right], E, source)


COLMAP = CalibrationFormat(
    "a COLMAP model (cameras.txt and images.txt)",
    matches,
    read,
    file_counts=(2,),
    has_unit=False,
    by_image=True,
)
