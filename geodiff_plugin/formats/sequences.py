"""Reads posed data sets and inputs without poses: 7-Scenes, ScanNet, TUM RGB-D, videos, images.

Source: ``src/utils/datasets.py`` of cvg/nice-slam; ``_info.txt`` of ScanNet's SensReader and 3RScan.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from geodiff_plugin._internal.checks import InputError, bad_value
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import read_matrix, read_rows, read_text
from geodiff_plugin.formats.image_files import images_in, images_of
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Layout, paired, posed
from geodiff_plugin.formats.recordings import VideoFacts, is_video, video_facts
from geodiff_plugin.formats.rigs import RawCamera, array_of, intrinsics, reading_file, rigid

#: Files of TUM's ``associate.py`` and similar programs, with one line per image and depth map.
TUM_ASSOCIATIONS = ("associations.txt", "associated.txt", "association.txt")
SEVEN_SCENES = RawCamera(intrinsics(525.0, 525.0, 320.0, 240.0), (640, 480))
TUM_RGBD = RawCamera(intrinsics(525.0, 525.0, 319.5, 239.5), (640, 480))
#: The three cameras of TUM RGB-D as calibrated by its authors; the third one's images are undistorted.
FREIBURG = {
    "1": RawCamera(
        intrinsics(517.3, 516.5, 318.6, 255.3), (640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "2": RawCamera(
        intrinsics(520.9, 521.0, 325.1, 249.7), (640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "3": RawCamera(intrinsics(535.4, 539.2, 320.1, 247.6), (640, 480)),
}
#: Matches the camera in names of folders and in headers of files.
FREIBURG_NAME = re.compile(r"freiburg([123])_", re.IGNORECASE)
#: Number of values of a pinhole in ETH3D's ``calibration.txt`` (fx, fy, cx, cy); lens coefficients may
#: follow.
FOCALS_AND_CENTRE = 4


@dataclass(frozen=True)
class OnePoseAFile:
    """A data set with one file per pose: patterns of images, poses and depth, and its published camera."""

    images: str
    pose: str
    depth: str
    camera: RawCamera | None = None


TRACKED = {
    "7-Scenes": OnePoseAFile("frame-*.color.*", "{}.pose.txt", "{}.depth.png", SEVEN_SCENES),
    "ScanNet": OnePoseAFile("color/*", "pose/{}.txt", "depth/{}.png"),
}
INTRINSICS = (
    *("calibration.txt", "intrinsics.txt", "camera-intrinsics.txt", "K.txt"),
    *("intrinsic/intrinsic_color.txt", "intrinsic_color.txt"),
)
#: Files with the cameras of frames in ScanNet, 12-Scenes and 3RScan.
INFOS = ("_info.txt", "info.txt")
#: Matches its lines ``name = value``.
INFO = re.compile(r"(?m)^\s*(m_\w+)\s*=\s*(.*)$")
#: Line that distinguishes it from other programs' files.
INFO_MARK = "m_calibrationColorIntrinsic"
#: Key of its depth camera, which is optional.
OF_DEPTH = "m_calibrationDepthIntrinsic"
#: Maximum difference of K, relative to the image sides, for depth maps aligned with images.
ALIGNED = 0.02
#: Replica as rendered by NICE-SLAM: the file of its camera, next to the scenes or in one.
REPLICA_CAMERA = "cam_params.json"
#: Units per metre of TUM's depth maps.
TUM_DEPTH = 5000.0
#: Maximum time difference in seconds between an image and its pose.
MAX_TIME_DIFFERENCE_S = 0.05
#: Matches a number at the start of a row.
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)
#: Number of characters of a file's header that may name its sequence.
HEAD = 300
VIDEO = "video"
#: Minimum fraction of a video's frames with a pose: trackers start late and stop early.
MIN_TIMED_FRACTION = 0.8
#: Lower bound of durations, seconds.
TINY_S = 1e-3


def _file_camera(folder: Path, published: RawCamera | None) -> RawCamera | None:
    """Return the intrinsics in a file of the data set, otherwise its published ones."""
    info = _info_of(folder)
    if info is not None:
        return info.camera
    files = [parent / name for parent in (folder, folder.parent) for name in INTRINSICS]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return published
    rows = read_rows(file, f"{file}", "a camera")
    if len(rows) == 1 and len(rows[0]) == FOCALS_AND_CENTRE:
        return RawCamera(intrinsics(*rows[0]))
    return RawCamera(read_matrix(file, f"{file}")[:3, :3])


def _assumed(kind: str, camera: RawCamera | None) -> tuple[Finding, ...]:
    """Return a finding on a published camera, which may differ from the actual one."""
    if camera is not SEVEN_SCENES and camera is not TUM_RGBD:
        return ()
    sentence = f"K of {kind} is assumed (525 px at 640x480). Pass --K for a different camera."
    return (Finding("capture.assumed-k", sentence),)


def read_tracked(folder: Path) -> Layout | None:
    """Read 7-Scenes and ScanNet; frames with lost tracking (infinity, NaN) have no pose."""
    for kind, of in TRACKED.items():
        paths = images_of(folder.glob(of.images)) if folder.is_dir() else []
        if not (paths and (folder / of.pose).parent.is_dir()):
            continue
        camera = _file_camera(folder, of.camera)
        info = _info_of(folder)
        candidates = []
        per_m = None if info is None else info.depth_per_m
        for path in paths:
            name = path.name.partition(".")[0]
            E = None
            file = folder / of.pose.format(name)
            with suppress(InputError):
                E = rigid(read_matrix(file, f"{file}"), f"the pose in {file}")
            depth = None if info is not None and not info.aligned else folder / of.depth.format(name)
            candidates.append(Candidate(CaptureFrame(name, path, E, depth, per_m), camera))
        return Layout(kind, "m", candidates, findings=_assumed(kind, camera))
    return None


@dataclass(frozen=True, eq=False)
class RecorderInfo:
    """Colour camera of an ``_info.txt``, units per metre of its depth maps, and whether they are aligned.

    3RScan's depth maps are in the view of another camera than its images.
    """

    camera: RawCamera
    depth_per_m: float | None
    aligned: bool


def _info_of(folder: Path) -> RecorderInfo | None:
    """Read the cameras in the recorder's file in a folder or its parent."""
    for file in (parent / name for parent in (folder, folder.parent) for name in INFOS):
        entries = dict(INFO.findall(read_text(file, f"{file}"))) if file.is_file() else {}
        if INFO_MARK in entries:
            with reading_file(file, "_info.txt of ScanNet's recorder or 3RScan"):
                colour = _camera_of_info(entries, "Color")
                depth = _camera_of_info(entries, "Depth") if OF_DEPTH in entries else colour
                per_m = float(entries["m_depthShift"]) if "m_depthShift" in entries else None
                views = [camera.K[:2] / np.array(camera.size)[:, None] for camera in (colour, depth)]
                return RecorderInfo(colour, per_m, bool(np.allclose(views[0], views[1], atol=ALIGNED)))
    return None


def _camera_of_info(entries: dict[str, str], which: str) -> RawCamera:
    """Return the ``Color`` or ``Depth`` camera, whose matrix is written with 16 numbers."""
    name = f"m_calibration{which}Intrinsic"
    width, height = (int(entries[f"m_{which.lower()}{side}"]) for side in ("Width", "Height"))
    return RawCamera(array_of(entries[name].split(), (4, 4), name)[:3, :3], (width, height))


def read_replica(folder: Path) -> Layout | None:
    """Read Replica as rendered by NICE-SLAM: ``results/frame*.jpg``, one pose per line, in metres."""
    images = images_of(folder.glob("results/frame*"))
    file = folder / "traj.txt"
    if not (images and file.is_file()):
        return None
    params = next((at for at in (folder, folder.parent) if (at / REPLICA_CAMERA).is_file()), None)
    camera, per_m = None, None
    if params is not None:
        with reading_file(params / REPLICA_CAMERA, "cam_params.json of Replica"):
            entries = json.loads(read_text(params / REPLICA_CAMERA, REPLICA_CAMERA))["camera"]
            K = intrinsics(*(entries[key] for key in ("fx", "fy", "cx", "cy")))
            camera = RawCamera(K, (entries["w"], entries["h"]))
            per_m = float(entries["scale"])
    rows = read_rows(file, f"{file}", "poses, one per line")
    if len(rows) < len(images):
        bad_value(f"{file}", f"a file with {len(images)} lines, one per image", f"{len(rows)}")

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        depth = frame.image.with_name(f"{frame.name.replace('frame', 'depth')}.png")
        return posed(frame, rigid(row, "a pose"), camera, depth=depth, depth_per_m=per_m)

    # NICE-SLAM ignores further lines.
    return Layout("Replica", "m", paired(images, rows[: len(images)], build))


def read_tum(folder: Path) -> Layout | None:
    """Read TUM RGB-D: poses and depth maps matched to images by time."""
    associations = next((file for name in TUM_ASSOCIATIONS if (file := folder / name).is_file()), None)
    if not ((folder / "rgb.txt").is_file() or associations) or not (folder / "groundtruth.txt").is_file():
        return None
    camera = _file_camera(folder, _freiburg(folder))
    candidates = list[Candidate]()
    pose_at = read_trajectory(folder / "groundtruth.txt")
    if associations is not None and not (folder / "rgb.txt").is_file():
        images, depths = _associated_names(associations)
    else:
        images = _timed_names(folder / "rgb.txt")
        depths = _timed_names(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    for t, name in images:
        near, depth_name = min(depths, key=lambda depth: abs(depth[0] - t), default=(np.inf, ""))
        depth = folder / depth_name if abs(near - t) < MAX_TIME_DIFFERENCE_S else None
        frame = CaptureFrame(Path(name).stem, folder / name, pose_at(t), depth, TUM_DEPTH)
        candidates.append(Candidate(frame, camera))
    return Layout("TUM RGB-D", "m", candidates, findings=_assumed("TUM RGB-D", camera))


def _freiburg(folder: Path) -> RawCamera:
    """Return the camera named by a TUM RGB-D sequence, or by the header of one of its files."""
    heads = [folder / "rgb.txt", folder / "groundtruth.txt"]
    texts = [folder.resolve().name, *(read_text(file, f"{file}")[:HEAD] for file in heads if file.is_file())]
    found = next(filter(None, map(FREIBURG_NAME.search, texts)), None)
    return TUM_RGBD if found is None else FREIBURG[found[1]]


def _below_heading(rows: list[list[str]]) -> list[list[str]]:
    """Return the rows from the first one that starts with a number: headings may lack their ``#``."""
    return list(dropwhile(lambda row: NUMBER.fullmatch(row[0]) is None, rows))


def _timed_names(file: Path) -> list[tuple[float, str]]:
    with reading_file(file, "list of seconds and file names"):
        rows = _below_heading(read_rows(file, f"{file}", "seconds and file names"))
        return [(float(t), name.replace("\\", "/")) for t, name, *_ in rows]


def _associated_names(file: Path) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Return images and depth maps with their times from lines with one of each, in either order."""
    first, second = list[tuple[float, str]](), list[tuple[float, str]]()
    with reading_file(file, "list of seconds and file names, twice per line"):
        for row in _below_heading(read_rows(file, f"{file}", "seconds and file names")):
            t, name, other_t, other_name = (word.replace("\\", "/") for word in row[:4])
            first.append((float(t), name))
            second.append((float(other_t), other_name))
    depth_first = _depth_mentions(first) > _depth_mentions(second)
    return (second, first) if depth_first else (first, second)


def _depth_mentions(files: Sequence[tuple[float, str]]) -> int:
    """Count the word "depth" in paths: paths of depth maps have it more often than paths of images."""
    return sum(name.lower().count("depth") for _, name in files)


def read_trajectory(file: Path) -> TimedPoses:
    """Read a trajectory in TUM format, lines ``seconds tx ty tz qx qy qz qw``, camera-to-world."""
    with reading_file(file, "trajectory of lines seconds tx ty tz qx qy qz qw"):
        lines = [words[:8] for words in _below_heading(read_rows(file, f"{file}", "a trajectory"))]
        rows = array_of(lines, (-1, 8), "lines of 8")
        return TimedPoses(rows[:, 0], rows[:, 1:4], rows[:, 4:])


class TimedPoses:
    """Poses interpolated between increasing times in seconds; ``None`` at times without a pose nearby.

    Quaternions are x, y, z, w. ``times (N,)`` are the times of the given poses.
    """

    def __init__(self, times: np.ndarray, places: np.ndarray, quaternions: np.ndarray) -> None:
        self.times, first = np.unique(times, return_index=True)
        self._turns = Slerp(self.times, Rotation.from_quat(quaternions[first]))
        self._places = places[first]

    def __call__(self, t: float) -> np.ndarray | None:
        """Return the camera-to-world pose ``(4, 4)`` at a time."""
        if np.abs(self.times - t).min() > MAX_TIME_DIFFERENCE_S:
            return None
        t = float(np.clip(t, self.times[0], self.times[-1]))
        E = np.eye(4)
        E[:3, :3] = self._turns(t).as_matrix()
        E[:3, 3] = [np.interp(t, self.times, along) for along in self._places.T]
        return E


def read_video(path: Path, trajectory: Path | None = None) -> Layout | None:
    """Read the frames of a video, with poses if there is a trajectory."""
    if not (path.is_file() and is_video(path)):
        return None
    facts = video_facts(path, "PATH")
    poses: list[np.ndarray | None] = [None] * facts.frames
    sentence = "Without --trajectory, poses are estimated, without a unit."
    findings: tuple[Finding, ...] = (Finding("capture.no-trajectory", sentence),)
    if trajectory is not None:
        at = read_trajectory(trajectory)
        poses = [at(t) for t in facts.times]
        findings = _unmatched_times(facts, at.times, poses, trajectory)
    frames = (CaptureFrame(f"{n:06d}", path, E, index=n) for n, E in enumerate(poses))
    camera = RawCamera(None, facts.size)
    return Layout(VIDEO, "m", [Candidate(frame, camera) for frame in frames], findings=findings)


def _unmatched_times(
    facts: VideoFacts, times: np.ndarray, poses: Sequence[np.ndarray | None], trajectory: Path
) -> tuple[Finding, ...]:
    """Report a trajectory without poses at the times of many frames; an error if it has none at all.

    ``times`` are the trajectory's, in seconds; ``poses`` has the pose of every frame.
    """
    found = sum(E is not None for E in poses)
    last = facts.times[-1]
    span = f"{times[0]:g} to {times[-1]:g} s"
    if found == 0:
        hint = _hint_for_times(times, last)
        expected = f"a trajectory with times in the video, 0 to {last:g} s after its first frame"
        bad_value("trajectory (--trajectory)", expected, f"{span} in {trajectory}", hint)
    if found >= MIN_TIMED_FRACTION * len(poses):
        return ()
    sentence = (
        f"Only {found} of {len(poses)} frames have a pose within {MAX_TIME_DIFFERENCE_S:g} s. The frames are "
        f"at 0 to {last:g} s, the poses of {trajectory} at {span}. Check that both start together, and that "
        "its times are the frames' times."
    )
    return (Finding("capture.trajectory-times", sentence),)


def _hint_for_times(times: np.ndarray, last: float) -> str:
    """Return a hint for a trajectory of which no time is in a video that ends at ``last`` seconds."""
    for unit, per_second in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if 0.5 < (times[-1] - times[0]) / per_second / max(last, TINY_S) < 2.0:
            return f"Its times seem to be in {unit}. Divide them by {per_second:g}."
    return "If it starts with the video, subtract its first time from all of them."


def read_unposed_images(path: Path) -> Layout | None:
    """Read upright images without cameras: K comes from options or EXIF."""
    folders = (images_in(folder) for folder in (path, path / "images", path / "input"))
    candidates = [Candidate(CaptureFrame(image.stem, image)) for image in next(filter(None, folders), [])]
    return Layout("images without poses", None, candidates, as_stored=False) if candidates else None
