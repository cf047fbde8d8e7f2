"""Data sets of posed frames, and what has no poses: 7-Scenes, ScanNet, TUM RGB-D, videos, photographs.

Source: ``src/utils/datasets.py`` of cvg/nice-slam; ``_info.txt`` of ScanNet's SensReader and 3RScan.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import dropwhile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.formats.files import read_matrix, read_rows, read_text
from geodiff_plugin.formats.image_files import images_in, images_of
from geodiff_plugin.formats.layouts import (
    Candidate,
    CaptureFrame,
    Layout,
    build_frame,
)
from geodiff_plugin.formats.recordings import is_video, video_facts
from geodiff_plugin.formats.rigs import Camera, array_of, intrinsics, reading_whole, rigid
from geodiff_plugin.messages import Message

#: TUM's ``associate.py`` and those that run on its files write a line an image and its depth map.
TUM_ASSOCIATIONS = ("associations.txt", "associated.txt", "association.txt")
SEVEN_SCENES = Camera(intrinsics(525.0, 525.0, 320.0, 240.0), (640, 480))
TUM_RGBD = Camera(intrinsics(525.0, 525.0, 319.5, 239.5), (640, 480))
#: The three cameras of TUM RGB-D as its authors calibrated them; the third one's images are straightened.
FREIBURG = {
    "1": Camera(
        intrinsics(517.3, 516.5, 318.6, 255.3), (640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "2": Camera(
        intrinsics(520.9, 521.0, 325.1, 249.7), (640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "3": Camera(intrinsics(535.4, 539.2, 320.1, 247.6), (640, 480)),
}
#: How folders and the heads of files name one of them.
FREIBURG_NAME = re.compile(r"freiburg([123])_", re.IGNORECASE)
#: Numbers of ETH3D's ``calibration.txt``: fx, fy, cx, cy; and lens coefficients where there are any.
FOCALS_AND_CENTRE = 4


@dataclass(frozen=True)
class OnePoseAFile:
    """A data set with a pose a file: patterns of images, poses and depth maps, and its published camera."""

    images: str
    pose: str
    depth: str
    camera: Camera | None = None


TRACKED = {
    "7-Scenes": OnePoseAFile("frame-*.color.*", "{}.pose.txt", "{}.depth.png", SEVEN_SCENES),
    "ScanNet": OnePoseAFile("color/*", "pose/{}.txt", "depth/{}.png"),
}
INTRINSICS = (
    *("calibration.txt", "intrinsics.txt", "camera-intrinsics.txt", "K.txt"),
    *("intrinsic/intrinsic_color.txt", "intrinsic_color.txt"),
)
#: Where ScanNet's and 12-Scenes' recorder, and 3RScan, write the cameras of their frames.
INFOS = ("_info.txt", "info.txt")
#: Its lines, ``name = value``.
INFO = re.compile(r"(?m)^\s*(m_\w+)\s*=\s*(.*)$")
#: The line by which it is told from another program's.
INFO_MARK = "m_calibrationColorIntrinsic"
#: The one of its depth camera, which may be left out.
OF_DEPTH = "m_calibrationDepthIntrinsic"
#: Depth maps show what images do where both cameras' K, in image sides, differ by less than this.
ALIGNED = 0.02
#: Replica as NICE-SLAM rendered it: the file of its camera beside the scenes, or in one.
REPLICA_CAMERA = "cam_params.json"
#: Values a metre of TUM's depth maps.
TUM_DEPTH = 5000.0
#: Poses of a trajectory further from an image than this, in seconds, are not its own.
FARTHEST_S = 0.05
#: A number, as a row of a list begins.
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)
#: Letters of a file's head, in which its sequence is named.
HEAD = 300
VIDEO = "video"
#: The camera-to-world pose at a time in seconds; ``None`` where none is near.
PoseAt = Callable[[float], np.ndarray | None]


def _file_camera(folder: Path, published: Camera | None) -> Camera | None:
    """The intrinsics that a data set has as a file, else its published ones."""
    info = _info_of(folder)
    if info is not None:
        return info.camera
    files = [parent / name for parent in (folder, folder.parent) for name in INTRINSICS]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return published
    rows = read_rows(file, f"{file}", "a camera")
    if len(rows) == 1 and len(rows[0]) == FOCALS_AND_CENTRE:
        return Camera(intrinsics(*rows[0]))
    return Camera(read_matrix(file, f"{file}")[:3, :3])


def _assumed(kind: str, camera: Camera | None) -> tuple[Message, ...]:
    """What to say of a published camera, which may be of other images."""
    if camera is not SEVEN_SCENES and camera is not TUM_RGBD:
        return ()
    sentence = f"Assumed: K of the cameras of {kind}, 525 px at 640x480. Give --K for another."
    return (Message("capture.assumed-k", sentence),)


def read_tracked(folder: Path) -> Layout | None:
    """7-Scenes and ScanNet: a frame whose tracker was lost (infinity, NaN) has no pose."""
    for kind, of in TRACKED.items():
        paths = images_of(folder.glob(of.images)) if folder.is_dir() else []
        if not (paths and (folder / of.pose).parent.is_dir()):
            continue
        camera, info, candidates = _file_camera(folder, of.camera), _info_of(folder), []
        per_m = None if info is None else info.depth_per_m
        for path in paths:
            name, E = path.name.partition(".")[0], None
            file = folder / of.pose.format(name)
            with suppress(InputError):
                E = rigid(read_matrix(file, f"{file}"), f"the pose in {file}")
            depth = None if info is not None and not info.aligned else folder / of.depth.format(name)
            candidates.append(Candidate(CaptureFrame(name, path, E, depth, per_m), camera))
        return Layout(kind, "m", candidates, notes=_assumed(kind, camera))
    return None


@dataclass(frozen=True, eq=False)
class RecorderInfo:
    """The colour camera of an ``_info.txt``, units of its depth maps in a metre, whether they show the same.

    Those of 3RScan have the view of another camera than its images.
    """

    camera: Camera
    depth_per_m: float | None
    aligned: bool


def _info_of(folder: Path) -> RecorderInfo | None:
    """What the recorder's file in a folder, or in that above, says of its cameras."""
    for file in (parent / name for parent in (folder, folder.parent) for name in INFOS):
        entries = dict(INFO.findall(read_text(file, f"{file}"))) if file.is_file() else {}
        if INFO_MARK in entries:
            with reading_whole(file, "_info.txt of ScanNet's recorder or 3RScan"):
                colour = _camera_of_info(entries, "Color")
                depth = _camera_of_info(entries, "Depth") if OF_DEPTH in entries else colour
                per_m = float(entries["m_depthShift"]) if "m_depthShift" in entries else None
                views = [camera.K[:2] / np.array(camera.size)[:, None] for camera in (colour, depth)]
                return RecorderInfo(colour, per_m, bool(np.allclose(views[0], views[1], atol=ALIGNED)))
    return None


def _camera_of_info(entries: dict[str, str], which: str) -> Camera:
    """The ``Color`` or the ``Depth`` camera, whose matrix is written in 16 numbers."""
    name = f"m_calibration{which}Intrinsic"
    width, height = (int(entries[f"m_{which.lower()}{side}"]) for side in ("Width", "Height"))
    return Camera(array_of(entries[name].split(), (4, 4), name)[:3, :3], (width, height))


def read_replica(folder: Path) -> Layout | None:
    """Replica as NICE-SLAM rendered it: ``results/frame*.jpg``, a pose a line in ``traj.txt``, in metres."""
    images, file = images_of(folder.glob("results/frame*")), folder / "traj.txt"
    if not (images and file.is_file()):
        return None
    params = next((at for at in (folder, folder.parent) if (at / REPLICA_CAMERA).is_file()), None)
    camera, per_m = None, None
    if params is not None:
        with reading_whole(params / REPLICA_CAMERA, "cam_params.json of Replica"):
            entries = json.loads(read_text(params / REPLICA_CAMERA, REPLICA_CAMERA))["camera"]
            K = intrinsics(*(entries[key] for key in ("fx", "fy", "cx", "cy")))
            camera, per_m = Camera(K, (entries["w"], entries["h"])), float(entries["scale"])
    rows = read_rows(file, f"{file}", "poses, one a line")
    if len(rows) < len(images):
        bad_value(f"{file}", f"of {len(images)} lines, one for each image", f"{len(rows)}")

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        depth = frame.image.with_name(f"{frame.name.replace('frame', 'depth')}.png")
        return Candidate(replace(frame, E=rigid(row, "a pose"), depth=depth, depth_per_m=per_m), camera)

    pairs = zip(images, rows, strict=False)  # NICE-SLAM leaves out what lies behind the last image
    candidates = [build_frame(CaptureFrame(i.stem, i), partial(build, row=row)) for i, row in pairs]
    return Layout("Replica", "m", candidates)


def read_tum(folder: Path) -> Layout | None:
    """TUM RGB-D: poses and depth maps by the time of each image."""
    associations = next((file for name in TUM_ASSOCIATIONS if (file := folder / name).is_file()), None)
    if not ((folder / "rgb.txt").is_file() or associations) or not (folder / "groundtruth.txt").is_file():
        return None
    camera, candidates = _file_camera(folder, _freiburg(folder)), list[Candidate]()
    pose_at = read_trajectory(folder / "groundtruth.txt")
    if associations is not None and not (folder / "rgb.txt").is_file():
        images, depths = _associated_names(associations)
    else:
        images = _timed_names(folder / "rgb.txt")
        depths = _timed_names(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    for t, name in images:
        near, depth_name = min(depths, key=lambda depth: abs(depth[0] - t), default=(np.inf, ""))
        depth = folder / depth_name if abs(near - t) < FARTHEST_S else None
        frame = CaptureFrame(Path(name).stem, folder / name, pose_at(t), depth, TUM_DEPTH)
        candidates.append(Candidate(frame, camera))
    return Layout("TUM RGB-D", "m", candidates, notes=_assumed("TUM RGB-D", camera))


def _freiburg(folder: Path) -> Camera:
    """The camera that the name of a sequence of TUM RGB-D says, or the head of one of its files."""
    heads = [folder / "rgb.txt", folder / "groundtruth.txt"]
    texts = [folder.resolve().name, *(read_text(file, f"{file}")[:HEAD] for file in heads if file.is_file())]
    found = next(filter(None, map(FREIBURG_NAME.search, texts)), None)
    return TUM_RGBD if found is None else FREIBURG[found[1]]


def _below_heading(rows: list[list[str]]) -> list[list[str]]:
    """The rows from the first one on that begins with a number: headings may lack their ``#``."""
    return list(dropwhile(lambda row: NUMBER.fullmatch(row[0]) is None, rows))


def _timed_names(file: Path) -> list[tuple[float, str]]:
    with reading_whole(file, "list of seconds and file names"):
        rows = _below_heading(read_rows(file, f"{file}", "seconds and file names"))
        return [(float(t), name) for t, name, *_ in rows]


def _associated_names(file: Path) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Images and depth maps with their seconds, of lines that have one of each, in either order."""
    with reading_whole(file, "list of seconds and file names, twice a line"):
        rows = [row[:4] for row in _below_heading(read_rows(file, f"{file}", "seconds and file names"))]
        pairs = [((float(t), name), (float(s), other)) for t, name, s, other in rows]
    depth_first = any(Path(name).parent.name.startswith("depth") for (_, name), _ in pairs)
    first, second = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    return (second, first) if depth_first else (first, second)


def read_trajectory(file: Path) -> PoseAt:
    """Poses of a trajectory in TUM's form, lines ``seconds tx ty tz qx qy qz qw``, camera-to-world."""
    with reading_whole(file, "trajectory of lines seconds tx ty tz qx qy qz qw"):
        lines = [words[:8] for words in _below_heading(read_rows(file, f"{file}", "a trajectory"))]
        rows = array_of(lines, (-1, 8), "lines of 8")
        return poses_by_time(rows[:, 0], rows[:, 1:4], rows[:, 4:])


def poses_by_time(times: np.ndarray, places: np.ndarray, quaternions: np.ndarray) -> PoseAt:
    """Poses interpolated between those of rising times, seconds; quaternions are x, y, z, w."""
    times, first = np.unique(times, return_index=True)
    turns, places = Slerp(times, Rotation.from_quat(quaternions[first])), places[first]

    def pose_at(t: float) -> np.ndarray | None:
        if np.abs(times - t).min() > FARTHEST_S:
            return None
        t, E = float(np.clip(t, times[0], times[-1])), np.eye(4)
        E[:3, :3] = turns(t).as_matrix()
        E[:3, 3] = [np.interp(t, times, along) for along in places.T]
        return E

    return pose_at


def read_video(path: Path, trajectory: Path | None = None) -> Layout | None:
    """The frames of a video, with poses where there is a trajectory."""
    if not (path.is_file() and is_video(path)):
        return None
    count, fps, size = video_facts(path, "PATH")
    pose_at = (lambda t: None) if trajectory is None else read_trajectory(trajectory)
    frames = (CaptureFrame(f"{n:06d}", path, pose_at(n / fps), index=n, size=size) for n in range(count))
    sentence = "No --trajectory: the poses are estimated, without a unit."
    notes = () if trajectory else (Message("capture.no-trajectory", sentence),)
    return Layout(VIDEO, "m", [Candidate(frame) for frame in frames], notes=notes)


def read_photographs(path: Path) -> Layout | None:
    """Images without cameras, as they are shown: K is typed, or by EXIF."""
    folders = (images_in(folder) for folder in (path, path / "images", path / "input"))
    candidates = [Candidate(CaptureFrame(image.stem, image)) for image in next(filter(None, folders), [])]
    return Layout("images without poses", None, candidates, as_stored=False) if candidates else None
