"""Structure from motion: COLMAP's models, which are written too, and ``transforms.json`` (S5.1)."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.files import PathLike, check_file, read_text
from geodiff_plugin.formats.out import atomic_path
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
from geodiff_plugin.types import Rig

#: Of a model, in the order of its numbers in binary files: how many focal lengths stand before cx cy, its
#: lens as ``Camera.model``, how many coefficients stand behind. Those that OpenCV has more are 0.
MODELS = {
    **{"SIMPLE_PINHOLE": (1, "opencv", 0), "PINHOLE": (2, "opencv", 0), "SIMPLE_RADIAL": (1, "opencv", 1)},
    **{"RADIAL": (1, "opencv", 2), "OPENCV": (2, "opencv", 4), "OPENCV_FISHEYE": (2, "fisheye", 4)},
    **{"FULL_OPENCV": (2, "opencv", 8), "FOV": (2, "FOV", 1), "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", 1)},
    **{"RADIAL_FISHEYE": (1, "fisheye", 2), "THIN_PRISM_FISHEYE": (2, "THIN_PRISM_FISHEYE", 8)},
}
CAMERA = re.compile(r"^(\d+) ([A-Z_]+) (\d+) (\d+) (.+)$", re.MULTILINE)
IMAGE = re.compile(r"^(\d+)((?: [-+.\deE]+){7}) (\d+) (\S.*)$", re.MULTILINE)
CAMERAS_MARK, IMAGES_MARK = "# Camera list with", "# Image list with"
MARK = rf"{CAMERAS_MARK}|{IMAGES_MARK}|^\d+ (?:{'|'.join(MODELS)}) \d+ \d+ .|{IMAGE.pattern}"
LONGEST_HEAD = 200
#: Of an image: its number, ``(4, 4)`` T_camera_from_world, its camera's number.
Posed = tuple[int, np.ndarray, int]
#: A start for other programs: text of a million points is 50 MB.
MOST_POINTS = 100_000
#: Points that fewer images see, or that lie further off in pixels, are no known depths.
FEWEST_VIEWS, MOST_ERROR_PX = 3, 1.5


def model_files(folder: Path) -> tuple[Path, Path] | None:
    """The files of a model's cameras and images, text before binary; ``None`` where a folder has none."""
    for suffix in (".txt", ".bin"):
        files = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if all(file.exists() for file in files):
            return files
    return None


def calibration_text(path: PathLike) -> str:
    """The text of a calibration file, of a COLMAP model without its points."""
    path = check_file(path, "calibration", "a calibration file")
    if path.name == "cameras.bin":
        return "\n".join([CAMERAS_MARK, *_binary_cameras(path)])
    if path.name == "images.bin":
        return "\n".join([IMAGES_MARK, *_binary_images(path)])
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(LONGEST_HEAD)
        if head.startswith(IMAGES_MARK):
            return head + "".join(line for line in file if line.startswith("#") or IMAGE.match(line))
    return read_text(path, "calibration", "a calibration file")


class _Bytes:
    """Reads little-endian numbers of a file, one group after the other; ``"z"`` is a text up to a zero."""

    def __init__(self, path: Path) -> None:
        self._data, self._at, self._path = path.read_bytes(), 0, path

    def __call__(self, layout: str) -> tuple[Any, ...]:
        if layout == "z":
            layout = f"{self._data.find(0, self._at) - self._at}sx"
        try:
            numbers = struct.unpack_from(f"<{layout}", self._data, self._at)
        except struct.error:
            bad_value(f"{self._path}", "a binary COLMAP file", "less than it says it holds", "Is it cut off?")
        self._at += struct.calcsize(f"<{layout}")
        return numbers


def _binary_cameras(path: Path) -> Iterator[str]:
    take = _Bytes(path)
    for _ in range(*take("Q")):
        number, model, width, height = take("IiQQ")
        if not 0 <= model < len(MODELS):
            bad_value(f"{path}", "with camera models 0 to 10 of COLMAP", model)
        name, (focals, _, behind) = list(MODELS.items())[model]
        numbers = " ".join(map(repr, take(f"{focals + 2 + behind}d")))
        yield f"{number} {name} {width} {height} {numbers}"


def _binary_images(path: Path) -> Iterator[str]:
    take = _Bytes(path)
    for _ in range(*take("Q")):
        number, *pose, camera = take("I7dI")
        (name,), (points,) = take("z"), take("Q")
        take(f"{24 * points}x")
        yield f"{number} {' '.join(map(repr, pose))} {camera} {name.decode(errors='replace')}"


def _cameras(text: str) -> dict[int, Camera]:
    cameras = {}
    for number, model, width, height, words in CAMERA.findall(text):
        if model not in MODELS:
            cure = "Undistort the images first (colmap image_undistorter) and give the model that it writes."
            bad_value(f"the model of camera {number}", f"one of {', '.join(MODELS)}", model, cure)
        focals, lens, behind = MODELS[model]
        numbers = array_of(words.split(), (focals + 2 + behind,), f"parameters of camera {number}")
        # COLMAP puts the centre of the first pixel at (0.5, 0.5).
        cx, cy = numbers[focals : focals + 2] - 0.5
        coefficients = np.pad(numbers[focals + 2 :], (0, max(4 - behind, 0)))
        K = intrinsics(numbers[0], numbers[focals - 1], cx, cy)
        cameras[int(number)] = Camera(K, (int(width), int(height)), coefficients, lens)
    return cameras


def _images(text: str) -> dict[str, Posed]:
    images = {}
    for number, words, camera, name in IMAGE.findall(text):
        qw, qx, qy, qz, *translation = array_of(words.split(), (7,), f"image {number}")
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()  # refuses zeros
        T[:3, 3] = translation
        images[name.strip()] = (int(number), T, int(camera))
    return images


def read_colmap_model(files: tuple[Path, Path]) -> tuple[dict[int, Camera], dict[str, Posed]]:
    """The cameras of a model by number, and its images by name, of its files of both."""
    return _cameras(calibration_text(files[0])), _images(calibration_text(files[1]))


def read_colmap_points(folder: Path) -> dict[int, np.ndarray]:
    """The reliable points ``(n, 3)`` that an image of a model sees, by its number, in the model's world."""
    path = folder / "points3D.txt"
    rows = _text_points(path) if path.exists() else _binary_points(path.with_suffix(".bin"))
    seen: dict[int, list[Sequence[Any]]] = {}
    for xyz, error_px, images in rows:
        if len(images) >= FEWEST_VIEWS and float(error_px) <= MOST_ERROR_PX:
            for image in set(images):
                seen.setdefault(int(image), []).append(xyz)
    return {image: array_of(points, (-1, 3), f"points of {path}") for image, points in seen.items()}


def _text_points(path: Path) -> Iterator[tuple[Sequence[Any], Any, Sequence[Any]]]:
    with path.open(encoding="utf-8") as file:
        for line in file:
            words = line.split()
            if words and not line.startswith("#"):
                yield words[1:4], words[7], words[8::2]


def _binary_points(path: Path) -> Iterator[tuple[Sequence[Any], Any, Sequence[Any]]]:
    take = _Bytes(check_file(path, "the model", "points3D.txt or points3D.bin"))
    for _ in range(*take("Q")):
        *xyz, error_px, seen = take("8x3d3xdQ")
        yield xyz, error_px, take(f"{2 * seen}I")[::2]


def read_colmap(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The two images of ``choice.image_names``, both files in any order, in the model's unit."""
    by_kind = {CAMERA.search(text) is not None and IMAGES_MARK not in text: text for text in texts}
    if len(by_kind) != 2:
        bad_value("the files", "cameras.txt and images.txt", "two of one kind")
    cameras, images = _cameras(by_kind[True]), _images(by_kind[False])
    (_, T_left, left), (_, T_right, right) = (images[name] for name in names_of_pair(images, choice))
    if not {left, right} <= cameras.keys():
        bad_value("the cameras", f"with cameras {left} and {right}", f"only {', '.join(map(str, cameras))}")
    return make_rig(cameras[left], cameras[right], T_left @ np.linalg.inv(T_right))


#: Of a transforms.json, by OpenCV's model: coefficients in its order, and those that it does not have.
NERF_LENSES = {
    "opencv": (("k1", "k2", "p1", "p2", "k3"), ("k4",)),
    "fisheye": (("k1", "k2", "k3", "k4"), ("p1", "p2")),
}
NERF_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")
Frame = dict[str, Any]


def nerf_frames(text: str) -> dict[str, Frame]:
    """Frames by ``file_path``, each with the entries of the whole file that it does not have itself."""
    data = json.loads(text)
    shared = {key: value for key, value in data.items() if key not in ("frames", "transform_matrix")}
    return {str(frame["file_path"]): shared | frame for frame in data["frames"]}


def nerf_camera(frame: Frame, image_size: tuple[int, int] | None = None) -> Camera:
    """The camera of a frame; ``image_size`` is that of its image, for files without ``w`` and ``h``."""
    size = (frame["w"], frame["h"]) if "w" in frame else image_size
    if size is None:
        cure = "Give image_size, the (width, height) of the images."
        bad_value("the file", "one with entries 'w' and 'h'", "none", cure)
    focals = []
    for axis, side in zip("xy", size, strict=True):
        angle = frame.get(f"camera_angle_{axis}")
        if f"fl_{axis}" in frame:
            focals.append(frame[f"fl_{axis}"])
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


def nerf_pose(frame: Frame) -> np.ndarray:
    """``(4, 4)`` camera-to-world in OpenCV's axes, lengths as before nerfstudio's ``applied_scale``."""
    pose = rigid(frame["transform_matrix"], "transform_matrix") @ OPENGL_FROM_OPENCV
    pose[:3, 3] /= float(frame.get("applied_scale", 1.0))
    return pose


def read_nerf(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """The two images of ``choice.image_names``, in the unit of the poses."""
    frames = nerf_frames(texts[0])
    left, right = (frames[name] for name in names_of_pair(frames, choice))
    E = np.linalg.inv(nerf_pose(left)) @ nerf_pose(right)
    return make_rig(nerf_camera(left, choice.image_size), nerf_camera(right, choice.image_size), E)


def check_colmap_names(names: Sequence[str]) -> None:
    """Refuse names of images that a model cannot hold: those with a blank."""
    for name in names:
        if any(letter.isspace() for letter in name):
            bad_value("the name of an image in a COLMAP model", "without blanks", repr(name), "Rename it.")


def write_colmap(
    folder: PathLike,
    views: Sequence[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]],
    cloud: Cloud,
    seen: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
) -> None:
    """Write a text model into an existing folder, for splatting and MVS; poses are world-to-camera there.

    ``views`` has ``(name, K, E, (width, height))`` of every image: no blanks in names, E camera-to-world, the
    first pixel's centre at (0, 0), which is (0.5, 0.5) in the file. ``seen`` has of every image the pixels
    ``(n, 2)`` at which it sees points, and their rows ``(n,)`` in the cloud; without it at most 100 000
    points are written, without tracks. Raises ``ValueError`` for a name with a blank.
    """
    check_colmap_names([name for name, *_ in views])
    cloud = cloud.thinned(MOST_POINTS) if seen is None else cloud
    seen = [(np.zeros((0, 2)), np.zeros(0, int))] * len(views) if seen is None else seen
    cameras = [f"{CAMERAS_MARK} CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = [f"{IMAGES_MARK} IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[]"]
    points = ["# 3D point list with POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    tracks = [""] * len(cloud.points_m)
    for number, ((name, K, E, (width, height)), (px, rows)) in enumerate(zip(views, seen, strict=True), 1):
        numbers = " ".join(f"{v:.9g}" for v in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
        cameras.append(f"{number} PINHOLE {width} {height} {numbers}")
        T = np.linalg.inv(E)
        qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat()
        numbers = " ".join(f"{v:.12g}" for v in (qw, qx, qy, qz, *T[:3, 3]))
        images.append(f"{number} {numbers} {number} {name}")
        each = zip(px + 0.5, rows, strict=True)
        images.append(" ".join(f"{x:.3f} {y:.3f} {row + 1}" for (x, y), row in each))
        for index, row in enumerate(rows):
            tracks[row] += f" {number} {index}"
    rows_of = zip(cloud.points_m, cloud.colours, tracks, strict=True)
    for number, ((x, y, z), (r, g, b), track) in enumerate(rows_of, 1):
        points.append(f"{number} {x:.5f} {y:.5f} {z:.5f} {r} {g} {b} 0{track}")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        with atomic_path(Path(folder) / f"{name}.txt") as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
