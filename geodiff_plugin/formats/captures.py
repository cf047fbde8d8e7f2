"""Captures: the posed frames of one moving camera, as phones, trackers, SLAM and COLMAP leave them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from geodiff_plugin._checks import MissingFileError, bad_value
from geodiff_plugin.formats.colmap import (
    model_files,
    read_colmap_cameras,
    read_colmap_images,
    read_colmap_points,
)
from geodiff_plugin.formats.exif import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.formats.files import read_text
from geodiff_plugin.formats.nerf import nerf_camera, nerf_frames, nerf_pose
from geodiff_plugin.formats.rigs import Camera, intrinsics, is_distorted, rigid
from geodiff_plugin.formats.video import count_frames, is_video
from geodiff_plugin.types import Distortion

__all__ = ["CaptureFiles", "CaptureFrame", "ModelPoints", "read_capture"]

IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
#: Factory intrinsics (fx, fy, cx, cy, width, height) that the data sets publish for files without their own.
SEVEN_SCENES = (525.0, 525.0, 320.0, 240.0, 640, 480)
TUM_RGBD = (525.0, 525.0, 319.5, 239.5, 640, 480)
#: Values a metre of TUM's depth maps; all others are in millimetres.
TUM_DEPTH = 5000.0
#: Entries of a frame by which a transforms.json says that its poses come from structure from motion.
OF_COLMAP = ("colmap_im_id", "sharpness")
#: Poses of a trajectory further from an image than this, in seconds, are not its own.
FARTHEST_S = 0.05
#: Ratios of sides of images and cameras that differ by more are of crops.
SAME_SHAPE = 0.01
NO_POSE_CURE = "Such frames are skipped; delete the others' poses as well to have all poses estimated."


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One frame of a capture.

    Attributes:
        name: stem of the image's file, or the number of a video's frame; unique in the capture.
        image: the image's file, or the video.
        K: ``(3, 3)`` pixels of the image as it is.
        size: ``(width, height)``.
        E: ``(4, 4)`` camera-to-world in OpenCV's axes, or ``None`` where no pose is given.
        lens: its distortion, ``None`` for none.
        depth: a 16-bit PNG with depth that the capture names for it, or ``None``.
        depth_per_m: its values a metre.
        index: number of the frame in a video, ``None`` for an image file.
    """

    name: str
    image: Path
    K: np.ndarray
    size: tuple[int, int]
    E: np.ndarray | None = None
    lens: Distortion | None = None
    depth: Path | None = None
    depth_per_m: float = 1000.0
    index: int | None = None


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """The points of a COLMAP model.

    Attributes:
        xyz: ``(M, 3)`` in the model's unit.
        error_px: ``(M,)`` mean reprojection errors.
        seen: for every frame's name the rows of the points that it sees.
        tracks: ``(M,)`` numbers of images that see a point.
    """

    xyz: np.ndarray
    error_px: np.ndarray
    seen: dict[str, np.ndarray]
    tracks: np.ndarray


@dataclass(frozen=True, eq=False)
class CaptureFiles:
    """What a capture's files say.

    Attributes:
        frames: in order of the capture.
        kind: what the files are, in words.
        unit: ``"m"``, or ``None`` where lengths are in no known unit.
        points: of a COLMAP model, or ``None``.
        notes: sentences for the user, such as frames without image.
    """

    frames: tuple[CaptureFrame, ...]
    kind: str
    unit: str | None = "m"
    points: ModelPoints | None = None
    notes: tuple[str, ...] = ()


def read_capture(
    path: str | os.PathLike[str],
    *,
    K: np.ndarray | None = None,
    fov: float | None = None,
    trajectory: str | os.PathLike[str] | None = None,
) -> CaptureFiles:
    """Read the frames of a capture; the layout is recognised.

    Args:
        path: COLMAP model or project, ``transforms.json`` or its folder, folder of 7-Scenes, ScanNet or TUM
            RGB-D, video (with ``trajectory``), or folder of images without poses.
        K: ``(3, 3)`` intrinsics in pixels, for layouts that have none; goes before those of the files.
        fov: horizontal field of view in degrees, likewise.
        trajectory: of a video: lines ``seconds tx ty tz qx qy qz qw``, camera-to-world, OpenCV's axes.

    Raises:
        FileNotFoundError: nothing there.
        ValueError: nothing that is a capture; fewer than two frames; damaged files, named.
    """
    source = Path(path)
    if not source.exists():
        raise MissingFileError(f"PATH must be a capture; there is no {source}.")
    typed: Typed = fov if K is None else np.asarray(K, dtype=np.float64)
    for recognised, read in READERS:
        found = recognised(source)
        if found is not None:
            return _checked(read(found, typed, trajectory), source)
    expected = "a COLMAP model, a transforms.json, 7-Scenes, ScanNet or TUM RGB-D, a video or images"
    bad_value("PATH", expected, f"{source}, which is none of these")


def _checked(files: CaptureFiles, source: Path) -> CaptureFiles:
    """The capture without frames whose images are missing; unique names."""
    there = [frame for frame in files.frames if frame.image.is_file()]
    notes = list(files.notes)
    missing = [frame.name for frame in files.frames if not frame.image.is_file()]
    if missing:
        notes.append(f"{_some(missing)}: no image file; skipped.")
    names = [frame.name for frame in there]
    if len(set(names)) < len(names):  # of two folders: the folder's name tells them apart
        there = [replace(frame, name=f"{frame.image.parent.name}-{frame.name}") for frame in there]
    if len(there) < 2:
        bad_value(
            "a capture",
            "at least two frames",
            f"{len(there)} in {source}",
            "One frame has no second view: use geodiff depth with known points, or record more.",
        )
    return replace(files, frames=tuple(there), notes=tuple(notes))


def _some(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _size(path: Path) -> tuple[int, int]:
    """Size of an image as it is read, turned by its EXIF orientation."""
    with Image.open(path) as image:
        width, height = image.size
        turned = image.getexif().get(0x0112, 1) >= 5
    return (height, width) if turned else (width, height)


#: Intrinsics, or the horizontal field of view in degrees.
Typed = np.ndarray | float | None


def _K_of(typed: Typed, size: tuple[int, int]) -> np.ndarray | None:
    return typed if typed is None or isinstance(typed, np.ndarray) else intrinsics_from_fov(typed, size)


def _framed(
    path: Path, camera: Camera, E: np.ndarray | None, typed: Typed, depth: Path | None = None
) -> CaptureFrame:
    """A frame of an image file, its camera scaled to the image's size."""
    depth = depth if depth is not None and depth.is_file() else None
    if not path.is_file():
        return CaptureFrame(path.stem, path, camera.K, (0, 0), E)
    size, K = _size(path), _K_of(typed, _size(path))
    if K is None:
        factors = np.array(size) / np.array(camera.size or size, float)
        if abs(factors[0] / factors[1] - 1) > SAME_SHAPE:
            got = f"{size[0]}x{size[1]} pixels where its camera has {camera.size[0]}x{camera.size[1]}"
            bad_value(f"{path}", "of the shape of its camera's images", got, "Is it a crop? Give --K.")
        to_image = np.diag([*factors, 1.0])
        to_image[:2, 2] = 0.5 * factors - 0.5
        K = to_image @ camera.K
    if camera.model not in ("opencv", "fisheye"):
        cure = "Undistort the images first (colmap image_undistorter)."
        bad_value(f"the lens of {path}", "one that OpenCV has", camera.model, cure)
    lens = Distortion(camera.model, np.asarray(camera.coefficients, np.float64).ravel())
    distorted = len(lens.coefficients) and is_distorted(lens)
    return CaptureFrame(path.stem, path, K, size, E, lens if distorted else None, depth)


# transforms.json


def _find_transforms(path: Path) -> Path | None:
    for file in (path, path / "transforms.json", path / "transforms_train.json"):
        if file.is_file() and file.suffix == ".json":
            return file
    return None


def _read_transforms(file: Path, typed: Typed, _: object) -> CaptureFiles:
    frames: list[CaptureFrame] = []
    unit: str | None = "m"
    for name, entries in nerf_frames(read_text(file, "PATH")).items():
        image = _named_image(file.parent, name)
        camera = nerf_camera(entries, _size(image) if image.is_file() else None)
        depth = file.parent / entries.get("depth_file_path", f"depth/{image.stem}.png")
        frames.append(_framed(image, camera, nerf_pose(entries), typed, depth))
        if any(key in entries for key in OF_COLMAP):
            unit = None
    return CaptureFiles(tuple(frames), "transforms.json", unit)


def _named_image(folder: Path, name: str) -> Path:
    """The image of ``file_path``; synthetic scenes leave its suffix out."""
    path = folder / name
    if path.is_file() or path.suffix.lower() in IMAGES:
        return path
    return next((folder / (name + suffix) for suffix in IMAGES if (folder / (name + suffix)).is_file()), path)


# COLMAP


def _find_colmap(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    folders = (path, path / "sparse" / "0", path / "sparse", path / "colmap" / "sparse" / "0")
    return next((folder for folder in folders if model_files(folder) is not None), None)


def _read_colmap(folder: Path, typed: Typed, _: object) -> CaptureFiles:
    cameras, images = read_colmap_cameras(folder), read_colmap_images(folder)
    parents = [folder / "images", *(parent / "images" for parent in list(folder.parents)[:3]), folder]
    frames, name_of = [], {}
    for name, (number, T, camera) in sorted(images.items()):
        path = next((parent / name for parent in parents if (parent / name).is_file()), parents[0] / name)
        frames.append(_framed(path, cameras[camera], np.linalg.inv(T), typed))
        name_of[number] = frames[-1].name
    try:
        xyz, _, error_px, tracks = read_colmap_points(folder)
    except OSError:
        return CaptureFiles(tuple(frames), "COLMAP model", None)
    rows: dict[str, list[int]] = {name: [] for name in name_of.values()}
    for row, track in enumerate(tracks):
        for number in np.unique(track):
            if int(number) in name_of:
                rows[name_of[int(number)]].append(row)
    seen = {name: np.array(own, int) for name, own in rows.items()}
    points = ModelPoints(xyz, error_px, seen, np.array([len(track) for track in tracks], int))
    return CaptureFiles(tuple(frames), "COLMAP model", None, points if len(xyz) else None)


# 7-Scenes and ScanNet


def _find_seven(path: Path) -> Path | None:
    return path if path.is_dir() and next(path.glob("frame-*.color.*"), None) is not None else None


def _read_seven(folder: Path, typed: Typed, _: object) -> CaptureFiles:
    names = ("intrinsics.txt", "camera-intrinsics.txt", "intrinsic_color.txt")
    camera, frames = _file_camera(folder, names, SEVEN_SCENES), []
    for image in sorted(folder.glob("frame-*.color.*")):
        name = image.name.partition(".")[0]
        E = _matrix_pose(folder / f"{name}.pose.txt")
        frames.append(replace(_framed(image, camera, E, typed, folder / f"{name}.depth.png"), name=name))
    return _with_poses(frames, "7-Scenes")


def _find_scannet(path: Path) -> Path | None:
    return path if (path / "color").is_dir() and (path / "pose").is_dir() else None


def _read_scannet(folder: Path, typed: Typed, _: object) -> CaptureFiles:
    camera = _file_camera(folder, ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt"), None)
    frames = []
    for image in _images_in(folder / "color"):
        E = _matrix_pose(folder / "pose" / f"{image.stem}.txt")
        frames.append(_framed(image, camera, E, typed, folder / "depth" / f"{image.stem}.png"))
    return _with_poses(frames, "ScanNet")


def _images_in(folder: Path) -> list[Path]:
    """Images of a folder, numbers in names in order."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
    return sorted(paths, key=lambda path: _natural(path.name))


def _natural(name: str) -> list[object]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", name) if part]


def _file_camera(
    folder: Path, names: Sequence[str], published: tuple[float, float, float, float, int, int] | None
) -> Camera:
    """Intrinsics of the first of some files in the folder or above it, else the data set's published ones."""
    for file in (parent / name for parent in (folder, folder.parent) for name in names):
        if file.is_file():
            numbers = np.array(file.read_text(encoding="utf-8-sig").replace(",", " ").split(), float)
            if numbers.size in (9, 16):
                side = int(np.sqrt(numbers.size))
                return Camera(numbers.reshape(side, side)[:3, :3])
            bad_value(f"{file}", "a 3x3 or 4x4 matrix", f"{numbers.size} numbers")
    if published is None:
        bad_value("K", "given by --K, --fov or a file", f"none of {', '.join(names)} in {folder}")
    fx, fy, cx, cy, width, height = published
    return Camera(intrinsics(fx, fy, cx, cy), (int(width), int(height)))


def _matrix_pose(file: Path) -> np.ndarray | None:
    """A camera-to-world matrix; ``None`` without a file, or where the tracker was lost (infinity, NaN)."""
    try:
        numbers = np.array(file.read_text(encoding="utf-8-sig").split(), float)
    except (OSError, ValueError):
        return None
    if numbers.size != 16 or not np.isfinite(numbers).all():
        return None
    return rigid(numbers, f"the pose in {file}")


def _with_poses(frames: Sequence[CaptureFrame], kind: str) -> CaptureFiles:
    """The frames that have a pose, and a sentence on the others; all of them where none has."""
    posed = [frame for frame in frames if frame.E is not None]
    lost = [frame.name for frame in frames if frame.E is None]
    if not posed:
        return CaptureFiles(tuple(frames), kind, None)
    notes = (f"{_some(lost)}: no pose; skipped. {NO_POSE_CURE}",) if lost else ()
    return CaptureFiles(tuple(posed), kind, notes=notes)


# TUM RGB-D, and videos with a trajectory


def _find_tum(path: Path) -> Path | None:
    return path if (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file() else None


def _read_tum(folder: Path, typed: Typed, _: object) -> CaptureFiles:
    camera = _file_camera(folder, ("intrinsics.txt", "K.txt"), TUM_RGBD)
    pose_at = _trajectory(folder / "groundtruth.txt")
    depths = _timed_names(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    times = np.array([t for t, _ in depths])
    frames = []
    for t, name in _timed_names(folder / "rgb.txt"):
        nearest = int(np.argmin(np.abs(times - t))) if len(times) else -1
        close = nearest >= 0 and abs(times[nearest] - t) < FARTHEST_S
        depth = folder / depths[nearest][1] if close else None
        frame = _framed(folder / name, camera, pose_at(t), typed, depth)
        frames.append(replace(frame, depth_per_m=TUM_DEPTH))
    return _with_poses(frames, "TUM RGB-D")


def _lines(file: Path) -> Iterator[list[str]]:
    for line in file.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            yield words


def _timed_names(file: Path) -> list[tuple[float, str]]:
    try:
        return [(float(words[0]), words[1]) for words in _lines(file)]
    except (ValueError, IndexError):
        bad_value(f"{file}", "lines of seconds and a file name", "another one")


def _trajectory(file: Path) -> Callable[[float], np.ndarray | None]:
    """Poses by time, interpolated between the lines of a trajectory in TUM's form."""
    try:
        rows = np.array([[float(word) for word in words[:8]] for words in _lines(file)])
    except ValueError:
        rows = np.zeros((0, 0))
    if rows.ndim != 2 or rows.shape[1:] != (8,) or not np.isfinite(rows).all():
        bad_value(f"{file}", "lines of seconds tx ty tz qx qy qz qw", "others", "Is it another format?")
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    turns = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:])) if len(rows) > 1 else None

    def pose_at(t: float) -> np.ndarray | None:
        gap = np.abs(rows[:, 0] - t).min()
        if turns is None or gap > FARTHEST_S:
            return None
        t = float(np.clip(t, rows[0, 0], rows[-1, 0]))
        E = np.eye(4)
        E[:3, :3] = turns(t).as_matrix()
        E[:3, 3] = [np.interp(t, rows[:, 0], rows[:, axis]) for axis in (1, 2, 3)]
        return E

    return pose_at


def _find_video(path: Path) -> Path | None:
    return path if path.is_file() and is_video(path) else None


def _read_video(path: Path, typed: Typed, trajectory: str | os.PathLike[str] | None) -> CaptureFiles:
    import cv2

    if typed is None:
        bad_value("K", "given by --K or --fov", "none", "A video does not say its focal length.")
    count, video = count_frames(path, "PATH"), cv2.VideoCapture(str(path))
    fps = video.get(cv2.CAP_PROP_FPS) or 30.0
    size = (int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    video.release()
    K = _K_of(typed, size)
    assert K is not None
    pose_at = _trajectory(Path(trajectory)) if trajectory is not None else lambda t: None
    frames = [CaptureFrame(f"{n:06d}", path, K, size, pose_at(n / fps), index=n) for n in range(count)]
    return _with_poses(frames, "video")


# Images without poses


def _find_images(path: Path) -> Path | None:
    for folder in (path, path / "images"):
        if folder.is_dir() and any(p.suffix.lower() in IMAGES for p in folder.iterdir()):
            return folder
    return None


def _read_images(folder: Path, typed: Typed, _: object) -> CaptureFiles:
    frames = []
    for path in _images_in(folder):
        size = _size(path)
        K = _K_of(typed, size)
        K = intrinsics_from_exif(path, path.name)[0] if K is None else K
        frames.append(CaptureFrame(path.stem, path, K, size))
    return CaptureFiles(tuple(frames), "images without poses", None)


READERS: tuple[tuple[Callable[[Path], Path | None], Callable[..., CaptureFiles]], ...] = (
    (_find_transforms, _read_transforms),
    (_find_colmap, _read_colmap),
    (_find_seven, _read_seven),
    (_find_scannet, _read_scannet),
    (_find_tum, _read_tum),
    (_find_video, _read_video),
    (_find_images, _read_images),
)
