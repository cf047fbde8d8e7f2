"""COLMAP's models, text and binary: cameras, poses and points; a pair of images as a rig; writing (S5.1)."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.files import check_file
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.formats.rigs import (
    CalibrationFormat,
    Camera,
    CameraChoice,
    RawRig,
    array_of,
    intrinsics,
    names_of_pair,
)

__all__ = [
    "COLMAP",
    "COLMAP_FILES",
    "check_colmap_names",
    "model_files",
    "model_text",
    "read_colmap_cameras",
    "read_colmap_images",
    "read_colmap_points",
    "write_colmap",
]

COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")
#: Of a model, in the order of its numbers in binary files: how many focal lengths stand before cx cy, what
#: ``Camera.model`` calls its lens, how many coefficients stand behind. Those that OpenCV has more are 0.
MODELS = {
    "SIMPLE_PINHOLE": (1, "opencv", 0),
    "PINHOLE": (2, "opencv", 0),
    "SIMPLE_RADIAL": (1, "opencv", 1),
    "RADIAL": (1, "opencv", 2),
    "OPENCV": (2, "opencv", 4),
    "OPENCV_FISHEYE": (2, "fisheye", 4),
    "FULL_OPENCV": (2, "opencv", 8),
    "FOV": (2, "FOV", 1),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", 1),
    "RADIAL_FISHEYE": (1, "fisheye", 2),
    "THIN_PRISM_FISHEYE": (2, "THIN_PRISM_FISHEYE", 8),
}
CAMERA = re.compile(r"^(\d+) ([A-Z_]+) (\d+) (\d+) (.+)$", re.MULTILINE)
IMAGE = re.compile(r"^(\d+)((?: [-+.\deE]+){7}) (\d+) (\S.*)$", re.MULTILINE)
CAMERAS_MARK, IMAGES_MARK = "# Camera list with", "# Image list with"
LONGEST_HEAD = 200
#: A start for other programs, not a copy of the cloud: text of a million points is 50 MB.
MOST_POINTS = 100_000
BINARY = "a binary COLMAP file"


def model_files(folder: Path) -> tuple[Path, Path] | None:
    """The files of a model's cameras and images, text before binary; ``None`` where a folder has none."""
    for suffix in (".txt", ".bin"):
        files = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if all(file.exists() for file in files):
            return files
    return None


def model_text(path: Path) -> str | None:
    """The text of a model's cameras or images without its points, which may be hundreds of megabytes.

    Binary files are read as the text that they stand for. A file that did not change since it was
    read last is not read again: every pair of a run asks for it.

    Args:
        path: an existing file.

    Returns:
        Comments and a line a camera or image; ``None`` for a text file without the head of ``images.txt``.
    """
    state = path.stat()
    return _model_text(path.absolute(), state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=4)
def _model_text(path: Path, size: int, changed_ns: int) -> str | None:
    if path.name == "cameras.bin":
        return "\n".join([CAMERAS_MARK, *_binary_cameras(path)])
    if path.name == "images.bin":
        return "\n".join([IMAGES_MARK, *_binary_images(path)])
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(LONGEST_HEAD)
        if not head.startswith(IMAGES_MARK):
            return None
        return head + "".join(line for line in file if line.startswith("#") or IMAGE.match(line))


class _Bytes:
    """Reads little-endian numbers of a file, one group after the other."""

    def __init__(self, path: Path) -> None:
        self._data, self._at, self._path = path.read_bytes(), 0, path

    def __call__(self, layout: str) -> tuple[Any, ...]:
        try:
            numbers = struct.unpack_from(f"<{layout}", self._data, self._at)
        except struct.error:
            bad_value(f"{self._path}", BINARY, "less than it says that it holds", "Is it cut off?")
        self._at += struct.calcsize(f"<{layout}")
        return numbers

    def name(self) -> str:
        """The text up to the next zero."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            bad_value(f"{self._path}", BINARY, "a name without an end", "Is it cut off?")
        text, self._at = self._data[self._at : end].decode("utf-8", errors="replace"), end + 1
        return text


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
        name, (points,) = take.name(), take("Q")
        take(f"{24 * points}x")
        yield f"{number} {' '.join(map(repr, pose))} {camera} {name}"


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


def _images(text: str) -> dict[str, tuple[int, np.ndarray, int]]:
    images = {}
    for number, words, camera, name in IMAGE.findall(text):
        qw, qx, qy, qz, *translation = array_of(words.split(), (7,), f"image {number}")
        if not any((qw, qx, qy, qz)):
            bad_value(f"the rotation of {name}", "a quaternion", "zeros")
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
        T[:3, 3] = translation
        images[name.strip()] = (int(number), T, int(camera))
    return images


def _text_of(folder: Path, which: int) -> str:
    files = model_files(folder)
    if files is None:
        bad_value("the model", "a folder with cameras and images as .txt or .bin", f"{folder}")
    text = model_text(check_file(files[which], "the model"))
    return files[which].read_text(encoding="utf-8-sig", errors="replace") if text is None else text


def read_colmap_cameras(folder: Path) -> dict[int, Camera]:
    """Every camera of a model by its number, with K as this package has it (first pixel's centre at 0).

    Raises:
        OSError, ValueError: no model, or a damaged one.
    """
    return _cameras(_text_of(folder, 0))


def read_colmap_images(folder: Path) -> dict[str, tuple[int, np.ndarray, int]]:
    """Every image of a model by name: its number, ``(4, 4)`` T_camera_from_world, its camera's number.

    Raises:
        OSError, ValueError: no model, or a damaged one.
    """
    return _images(_text_of(folder, 1))


def read_colmap_points(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """The points of a model, in its frame and unit.

    Returns:
        ``(N, 3)`` float64 points, ``(N, 3)`` uint8 colours, ``(N,)`` reprojection errors in pixels, and
        of every point the numbers of the images that see it.

    Raises:
        OSError, ValueError: no points3D.txt or .bin, or a damaged one.
    """
    path = folder / "points3D.txt"
    text = path.exists()
    rows = list((_text_points if text else _binary_points)(path if text else path.with_suffix(".bin")))
    columns = array_of([row for row, _ in rows], (-1,), f"{path}").reshape(-1, 7)
    tracks = [np.asarray(track, np.int64) for _, track in rows]
    return columns[:, :3], columns[:, 3:6].astype(np.uint8), columns[:, 6], tracks


def _text_points(path: Path) -> Iterator[tuple[Sequence[Any], Sequence[Any]]]:
    with path.open(encoding="utf-8") as file:
        for line in file:
            words = line.split()
            if words and not line.startswith("#"):
                if len(words) < 8:
                    bad_value(f"{path}", "a COLMAP points3D.txt", repr(line[:80]), "Is it cut off?")
                yield words[1:8], words[8::2]


def _binary_points(path: Path) -> Iterator[tuple[Sequence[Any], Sequence[Any]]]:
    take = _Bytes(check_file(path, "the model", "points3D.txt or points3D.bin"))
    for _ in range(*take("Q")):
        row = take("Q3d3Bd")[1:]
        (seen,) = take("Q")
        yield row, take(f"{2 * seen}I")[::2]


def _matches(text: str) -> bool:
    if CAMERAS_MARK in text or IMAGES_MARK in text:
        return True
    camera = CAMERA.search(text)
    return (camera is not None and camera[2] in MODELS) or IMAGE.search(text) is not None


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """The two images of ``choice.image_names``; both files in any order.

    Lengths keep the model's unit, which is no metre: one measured distance gives it (``baseline_m``).
    """
    by_kind = {CAMERA.search(text) is not None and IMAGES_MARK not in text: text for text in texts}
    if len(by_kind) != 2:
        bad_value("the files", "cameras.txt and images.txt", "two of one kind")
    cameras, images = _cameras(by_kind[True]), _images(by_kind[False])
    left, right = (images[name] for name in names_of_pair(images, choice))
    missing = [camera for _, _, camera in (left, right) if camera not in cameras]
    if missing:
        bad_value(
            "the cameras", f"with camera {missing[0]}", f"only {', '.join(map(str, cameras))}", "Cut off?"
        )
    return RawRig(cameras[left[2]], cameras[right[2]], left[1] @ np.linalg.inv(right[1]))


COLMAP = CalibrationFormat(
    "a COLMAP model (cameras.txt and images.txt)",
    _matches,
    _read,
    file_counts=(2,),
    has_unit=False,
    by_image=True,
)


def check_colmap_names(names: Sequence[str]) -> None:
    """Refuse names of images that a model cannot hold.

    Raises:
        ValueError: a name with a blank.
    """
    for name in names:
        if any(letter.isspace() for letter in name):
            bad_value("the name of an image in a COLMAP model", "without blanks", repr(name), "Rename it.")


def write_colmap(
    folder: str | os.PathLike[str],
    views: Sequence[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]],
    cloud: Cloud,
    seen: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
) -> None:
    """Write a text model, for splatting and MVS.

    Args:
        folder: an existing one.
        views: ``(name, K, E, (width, height))`` of every image; K in pixels, E its camera-to-world pose.
            Names have no blanks, as COLMAP's text allows none.
        cloud: the points in the same world; without ``seen`` at most 100 000 of them are written.
        seen: of every image the pixels ``(n, 2)`` at which it sees points, and their rows ``(n,)`` in the
            cloud; ``None`` for points without tracks. Programs choose pairs of images by them.

    Raises:
        ValueError: a name with a blank.
        OSError: the folder does not exist or is not writable.

    Convention:
        World-to-camera, and the centre of the first pixel at (0.5, 0.5), as COLMAP has it: cx and cy are
        half a pixel more than in K.
    """
    check_colmap_names([name for name, *_ in views])
    cloud = cloud.thinned(MOST_POINTS) if seen is None else cloud
    seen = [(np.zeros((0, 2)), np.zeros(0, int))] * len(views) if seen is None else seen
    cameras = [f"{CAMERAS_MARK} one line of data each:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = [
        f"{IMAGES_MARK} two lines of data each:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    tracks = [""] * len(cloud.points_m)
    for number, ((name, K, E, (width, height)), (px, rows)) in enumerate(zip(views, seen, strict=True), 1):
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
        cameras.append(f"{number} PINHOLE {width} {height} {fx:.9g} {fy:.9g} {cx:.9g} {cy:.9g}")
        T = np.linalg.inv(E)
        qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.12g}" for value in (qw, qx, qy, qz, *T[:3, 3]))
        images.append(f"{number} {numbers} {number} {name}")
        each = zip(px + 0.5, rows, strict=True)
        images.append(" ".join(f"{x:.3f} {y:.3f} {row + 1}" for (x, y), row in each))
        for index, row in enumerate(rows):
            tracks[row] += f" {number} {index}"
    points = [
        "# 3D point list with one line of data each:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    points += [
        f"{number} {x:.5f} {y:.5f} {z:.5f} {r} {g} {b} 0{track}"
        for number, ((x, y, z), (r, g, b), track) in enumerate(
            zip(cloud.points_m, cloud.colours, tracks, strict=True), 1
        )
    ]
    for name, lines in zip(COLMAP_FILES, (cameras, images, points), strict=True):
        with atomic_path(Path(folder) / name) as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
