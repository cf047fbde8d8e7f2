"""Reads COLMAP models as captures and calibrations, and writes them (S5.1).

pycolmap reads a whole model or nothing; here an invalid camera or image only excludes its frames. pycolmap is
used for lens models that OpenCV lacks (``lenses``).

Source: ``scene/reconstruction_io_text.cc``, ``scene/reconstruction_io_binary.cc`` and ``sensor/models.h`` of
colmap/colmap.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError, MissingFileError, bad_value
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.files import PathLike, check_file, read_text
from geodiff_plugin.formats.image_files import image_folders
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images, Layout, posed
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.formats.rigs import (
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    names_of_pair,
    pose_of,
)
from geodiff_plugin.types import Rig


@dataclass(frozen=True)
class CameraModel:
    """A camera model: focal lengths before cx cy, its lens as ``RawCamera.model``, then coefficients.

    Coefficients that only OpenCV's model has are 0. A panorama has no focal length.
    """

    focals: int
    lens: str
    behind: int


#: Camera models in the order of their numbers in binary files, 0 to 17.
MODELS = {
    "SIMPLE_PINHOLE": CameraModel(1, "opencv", 0),
    "PINHOLE": CameraModel(2, "opencv", 0),
    "SIMPLE_RADIAL": CameraModel(1, "opencv", 1),
    "RADIAL": CameraModel(1, "opencv", 2),
    "OPENCV": CameraModel(2, "opencv", 4),
    "OPENCV_FISHEYE": CameraModel(2, "fisheye", 4),
    "FULL_OPENCV": CameraModel(2, "opencv", 8),
    "FOV": CameraModel(2, "FOV", 1),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(1, "fisheye", 1),
    "RADIAL_FISHEYE": CameraModel(1, "fisheye", 2),
    "THIN_PRISM_FISHEYE": CameraModel(2, "THIN_PRISM_FISHEYE", 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": CameraModel(2, "RAD_TAN_THIN_PRISM_FISHEYE", 12),
    "SIMPLE_DIVISION": CameraModel(1, "SIMPLE_DIVISION", 1),
    "DIVISION": CameraModel(2, "DIVISION", 1),
    "SIMPLE_FISHEYE": CameraModel(1, "fisheye", 0),
    "FISHEYE": CameraModel(2, "fisheye", 0),
    "EUCM": CameraModel(2, "EUCM", 2),
    "EQUIRECTANGULAR": CameraModel(0, "", 0),
}
UNDISTORT = "Undistort the images first (colmap image_undistorter) and pass the resulting model."
CUT_PANORAMA = "Convert its panoramas to pinhole views first (panorama_sfm.py in pycolmap's examples)."
CAMERA = re.compile(r"^[ \t]*(\d+)[ \t]+([A-Z_]+)[ \t]+(\d+)[ \t]+(\d+)[ \t]+(\S.*)$", re.MULTILINE)
#: Matches number, quaternion, translation, camera, name. Lines of keypoints have further numbers instead of
#: the name.
IMAGE = re.compile(
    r"^[ \t]*(\d+)((?:[ \t,]+[-+.\deE]+){7})[ \t,]+(\d+)[ \t,]+(?![-+.\deE]+[ \t,]+\S)(\S.*)$", re.MULTILINE
)
#: First line of a COLMAP file of cameras.
CAMERAS_MARK = "# Camera list with"
#: First line of a COLMAP file of images.
IMAGES_MARK = "# Image list with"
_ANY_CAMERA = rf"^[ \t]*\d+[ \t]+(?:{'|'.join(MODELS)})[ \t]+\d+[ \t]+\d+[ \t]+\S"
MARK = rf"{CAMERAS_MARK}|{IMAGES_MARK}|{_ANY_CAMERA}|{IMAGE.pattern}"
MAX_HEADER_CHARS = 200
#: Subfolders of a project with models; among several in one folder the largest is used.
PLACES = (
    ("",),
    ("sparse/*", "sparse"),
    ("[0-9]*",),
    ("colmap/sparse/*", "colmap/sparse", "colmap"),
    ("colmap_text", "colmap_sparse/*"),
    ("dense/sparse", "dense/*/sparse"),
    ("distorted/sparse/*",),
)
#: Files with a model's cameras and images, text before binary.
Files = tuple[Path, Path]
#: Maximum number of points, as initialisation for other programs: text of a million points is 50 MB.
MAX_POINTS = 100_000
#: Minimum number of images that observe a point used as known depth.
MIN_VIEWS = 3
#: Maximum reprojection error in pixels of a point used as known depth.
MAX_ERROR_PX = 1.5


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of a model: number, quaternion and translation as text, and number of its camera."""

    number: int
    words: str
    camera: int

    @property
    def T(self) -> np.ndarray:
        """Return ``(4, 4)`` T_camera_from_world; raise if the numbers are not a pose."""
        qw, qx, qy, qz, *place = array_of(self.words.replace(",", " ").split(), (7,), f"image {self.number}")
        return pose_of(Rotation.from_quat([qx, qy, qz, qw]), place)  # raises for zeros


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras of a model by number (unusable ones with the reason), and images by name."""

    cameras: dict[int, RawCamera]
    unusable: dict[int, str]
    images: dict[str, PosedImage]

    def camera(self, number: int) -> RawCamera:
        """Return a camera by number; raise ``InputError`` with the reason if it is unusable."""
        if number in self.unusable:
            raise InputError(self.unusable[number])
        if number not in self.cameras:
            have = ", ".join(map(str, self.cameras)) or "none"
            bad_value("the cameras", f"with camera {number}", f"only {have}")
        return self.cameras[number]


def model_files(folder: Path) -> Files | None:
    """Return the files of a model's cameras and images, text before binary; ``None`` if there are none."""
    for suffix in (".txt", ".bin"):
        files = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if all(file.is_file() for file in files):
            return files
    return None


def calibration_text(path: PathLike) -> str:
    """Read a calibration file; for a COLMAP model without its points."""
    path = check_file(path, "calibration", "a calibration file")
    if path.name == "cameras.bin":
        return "\n".join([CAMERAS_MARK, *_binary_cameras(path)])
    if path.name == "images.bin":
        return "\n".join([IMAGES_MARK, *_binary_images(path)])
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(MAX_HEADER_CHARS)
        if head.startswith(IMAGES_MARK) or path.name == "images.txt":  # may exceed the size limit of texts
            lines = [line for line in (head, *file) if IMAGE.match(line)]
            if not lines:
                bad_value("calibration", "images.txt of a COLMAP model", f"{path} without images")
            return "\n".join([IMAGES_MARK, *lines])
    return read_text(path, "calibration", "a calibration file")


class _Bytes:
    """Reads groups of little-endian numbers of a file; ``"z"`` is a zero-terminated text."""

    def __init__(self, path: Path) -> None:
        self._data = path.read_bytes()
        self._at = 0
        self._path = path

    def __call__(self, layout: str) -> tuple[Any, ...]:
        if layout == "z":
            layout = f"{self._data.find(0, self._at) - self._at}sx"
        try:
            numbers = struct.unpack_from(f"<{layout}", self._data, self._at)
        except struct.error:
            bad_value(f"{self._path}", "a binary COLMAP file", "too few bytes", "It may be truncated.")
        self._at += struct.calcsize(f"<{layout}")
        return numbers


def _binary_cameras(path: Path) -> Iterator[str]:
    take = _Bytes(path)
    for _ in range(*take("Q")):
        number, model, width, height = take("IiQQ")
        if not 0 <= model < len(MODELS):  # the number of parameters that follow is unknown
            expected = f"with camera models 0 to {len(MODELS) - 1} of COLMAP"
            bad_value(f"{path}", expected, model, "Convert it to text: colmap model_converter.")
        name, form = list(MODELS.items())[model]
        count = form.focals + 2 + form.behind
        yield f"{number} {name} {width} {height} {' '.join(map(repr, take(f'{count}d')))}"


def _binary_images(path: Path) -> Iterator[str]:
    take = _Bytes(path)
    for _ in range(*take("Q")):
        number, *pose, camera = take("I7dI")
        (name,), (points,) = take("z"), take("Q")
        take(f"{24 * points}x")
        yield f"{number} {' '.join(map(repr, pose))} {camera} {name.decode(errors='replace')}"


def model_camera(number: str, name: str, size: tuple[int, int], words: str) -> RawCamera:
    """Return the camera of a model name, ``(width, height)``, and parameters as text."""
    if name not in MODELS:
        bad_value(f"the model of camera {number}", f"one of {', '.join(MODELS)}", name, UNDISTORT)
    form = MODELS[name]
    if not form.focals:
        bad_value(f"the model of camera {number}", "a model with a focal length", name, CUT_PANORAMA)
    expected = (form.focals + 2 + form.behind,)
    numbers = array_of(words.split(), expected, f"parameters of camera {number}")
    # COLMAP's first pixel has its centre at (0.5, 0.5).
    cx, cy = numbers[form.focals : form.focals + 2] - 0.5
    coefficients = numbers[form.focals + 2 :]
    if form.lens in ("opencv", "fisheye"):
        coefficients = np.pad(coefficients, (0, max(4 - form.behind, 0)))
    return RawCamera(intrinsics(numbers[0], numbers[form.focals - 1], cx, cy), size, coefficients, form.lens)


def _images(text: str) -> dict[str, PosedImage]:
    return {
        name.strip(): PosedImage(int(number), words, int(camera))
        for number, words, camera, name in IMAGE.findall(text)
    }


def _model(cameras_text: str, images_text: str) -> Model:
    cameras, unusable = dict[int, RawCamera](), dict[int, str]()
    for number, name, width, height, words in CAMERA.findall(cameras_text):
        try:
            cameras[int(number)] = model_camera(number, name, (int(width), int(height)), words)
        except InputError as error:
            unusable[int(number)] = str(error)
    return Model(cameras, unusable, _images(images_text))


def read_model(files: Files) -> Model:
    """Read the model of these files of cameras and images."""
    return _model(*map(calibration_text, files))


class _SeenPoint(NamedTuple):
    """A point of a model as in its file."""

    xyz: Sequence[Any]
    error_px: Any
    images: Sequence[Any]  # numbers of the images that observe it


def read_points(folder: Path) -> dict[int, np.ndarray]:
    """Return the reliable points ``(n, 3)`` observed by each image, by number, in the model's world frame."""
    path = folder / "points3D.txt"
    rows = _text_points(path) if path.exists() else _binary_points(path.with_suffix(".bin"))
    seen: dict[int, list[Sequence[Any]]] = {}
    for point in rows:
        if len(point.images) >= MIN_VIEWS and float(point.error_px) <= MAX_ERROR_PX:
            for image in set(point.images):
                seen.setdefault(int(image), []).append(point.xyz)
    return {image: array_of(points, (-1, 3), f"points of {path}") for image, points in seen.items()}


def _text_points(path: Path) -> Iterator[_SeenPoint]:
    with path.open(encoding="utf-8") as file:
        for line in file:
            words = line.split()
            if words and not line.startswith("#"):
                yield _SeenPoint(words[1:4], words[7], words[8::2])


def _binary_points(path: Path) -> Iterator[_SeenPoint]:
    take = _Bytes(check_file(path, "the model", "points3D.txt or points3D.bin"))
    for _ in range(*take("Q")):
        *xyz, error_px, seen = take("8x3d3xdQ")
        yield _SeenPoint(xyz, error_px, take(f"{2 * seen}I")[::2])


def read_colmap(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Return the rig of ``choice.image_names``; files in any order, lengths in the model's unit."""
    by_kind = {CAMERA.search(text) is not None and IMAGES_MARK not in text: text for text in texts}
    if len(by_kind) != 2:
        bad_value("the files", "cameras.txt and images.txt", "two of one kind")
    model = _model(by_kind[True], by_kind[False])
    left, right = (model.images[name] for name in names_of_pair(model.images, choice))
    cameras = [model.camera(image.camera) for image in (left, right)]
    return make_rig(cameras[0], cameras[1], left.T @ np.linalg.inv(right.T))


def _models_below(path: Path) -> Iterator[list[Files]]:
    """Yield the models of each of ``PLACES`` that has any."""
    if path.is_file():
        if path.stem in ("cameras", "images") and (files := model_files(path.parent)):
            yield [files]
        return
    for place in PLACES:
        folders: list[Path] = []
        for pattern in place:
            folders += path.glob(pattern) if pattern else [path]
        folders.sort()
        if models := [files for files in map(model_files, folders) if files]:
            yield models


class _Chosen(NamedTuple):
    """The selected model, among those in one folder."""

    files: Files
    model: Model
    findings: tuple[Finding, ...] = ()  # about the other models


def _largest(models: Iterable[Files], project: Path) -> _Chosen:
    """Return the model with most images, the first if equal."""
    read = [(files, read_model(files)) for files in models]
    files, model = max(read, key=lambda each: len(each[1].images))
    others = [
        f"{each[0].parent.relative_to(project)} with {len(other.images)}"
        for each, other in read
        if other is not model
    ]
    if not others:
        return _Chosen(files, model)
    text = f"{files[0].parent.relative_to(project)}, with {len(model.images)} images, is used"
    finding = f"{text}, the largest of {len(read)} models; ignored: {', '.join(others)}."
    findings = (Finding("capture.part", f"{finding} To use a different one, pass its folder."),)
    return _Chosen(files, model, findings)


def _around(folder: Path, project: Path) -> list[Path]:
    """Return the folder of a model and its parents up to the project, which may contain images."""
    folder, project = folder.absolute(), project.absolute()
    above = [folder, *folder.parents][:4]
    inside = folder != project and folder.is_relative_to(project)
    return [at for at in above if at.is_relative_to(project)] if inside else above


def read_colmap_capture(path: Path, images_at: Path | None = None) -> Layout | None:
    """Read a model (text or binary), or a project that contains one; its image folder may be given.

    Uses the model of the first folder whose images exist, which may be undistorted ones only.
    """
    passed_over: list[Layout] = []
    for models in _models_below(path):
        layout = _capture_of(models, path, images_at)
        if any(os.path.isfile(each.frame.image) for each in layout.candidates):
            return layout
        passed_over.append(layout)
    return passed_over[0] if passed_over else None


def _capture_of(models: Iterable[Files], path: Path, images_at: Path | None) -> Layout:
    """Read the largest of the models in one folder."""
    files, model, findings = _largest(models, path)
    folder = files[0].parent
    try:
        seen = read_points(folder)
    except MissingFileError:
        seen = {}
    images = Images.find(sorted(model.images), image_folders(*_around(folder, path)), path, images_at)

    def build(frame: CaptureFrame, image: PosedImage) -> Candidate:
        points = seen.get(image.number)
        return posed(frame, np.linalg.inv(image.T), model.camera(image.camera), points=points)

    entries = (model.images[name] for name in images.names)
    return images.layout("COLMAP model", entries, build, findings=findings)


def check_colmap_names(names: Sequence[str]) -> None:
    """Raise an error for image names that a model cannot represent because they contain blanks."""
    for name in names:
        if any(letter.isspace() for letter in name):
            bad_value("the name of an image in a COLMAP model", "without blanks", repr(name), "Rename it.")


def write_colmap(
    folder: PathLike,
    views: Sequence[tuple[str, np.ndarray, np.ndarray, tuple[int, int]]],
    cloud: Cloud,
    seen: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
) -> None:
    """Write a text model into an existing folder, for splatting and MVS; its poses are world-to-camera.

    ``views`` has ``(name, K, E, (width, height))`` of every image: no blanks in names, E camera-to-world, the
    first pixel's centre at (0, 0), which is (0.5, 0.5) in the file. ``seen`` has, for every image, the pixels
    ``(n, 2)`` of observed points, and their rows ``(n,)`` in the cloud. Without it at most 100 000 points are
    written, without tracks. Raises ``ValueError`` for a name with a blank.
    """
    check_colmap_names([name for name, *_ in views])
    cloud = cloud.thinned(MAX_POINTS) if seen is None else cloud
    seen = [(np.zeros((0, 2)), np.zeros(0, int))] * len(views) if seen is None else seen
    cameras = [f"{CAMERAS_MARK} CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = [f"{IMAGES_MARK} IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[]"]
    for number, ((name, K, E, (width, height)), (px, rows)) in enumerate(zip(views, seen, strict=True), 1):
        numbers = " ".join(f"{v:.9g}" for v in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
        cameras.append(f"{number} PINHOLE {width} {height} {numbers}")
        images += _image_lines(number, name, np.linalg.inv(E), px, rows)
    points = _point_lines(cloud, [rows for _, rows in seen])
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        with atomic_path(Path(folder) / f"{name}.txt") as temporary:
            temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _image_lines(number: int, name: str, T: np.ndarray, px: np.ndarray, rows: np.ndarray) -> list[str]:
    """Return the two lines of an image: its world-to-camera pose ``T (4, 4)``, and its observed points."""
    qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat()
    numbers = " ".join(f"{v:.12g}" for v in (qw, qx, qy, qz, *T[:3, 3]))
    each = zip(px + 0.5, rows, strict=True)
    seen = " ".join(f"{x:.3f} {y:.3f} {row + 1}" for (x, y), row in each)
    return [f"{number} {numbers} {number} {name}", seen]


def _point_lines(cloud: Cloud, rows_of_images: Sequence[np.ndarray]) -> list[str]:
    """Return the lines of all points, each with the images that observe it and its index in them."""
    tracks = [""] * len(cloud.points_m)
    for number, rows in enumerate(rows_of_images, 1):
        for index, row in enumerate(rows):
            tracks[row] += f" {number} {index}"
    lines = ["# 3D point list with POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    every = zip(cloud.points_m, cloud.colours, tracks, strict=True)
    for number, ((x, y, z), (r, g, b), track) in enumerate(every, 1):
        lines.append(f"{number} {x:.5f} {y:.5f} {z:.5f} {r} {g} {b} 0{track}")
    return lines
