"""Data sets of posed frames, and what has no poses: 7-Scenes, ScanNet, TUM RGB-D, videos, photographs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats.files import read_matrix, read_rows
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Layout, images_in, images_of
from geodiff_plugin.formats.recordings import is_video, video_facts
from geodiff_plugin.formats.rigs import Camera, array_of, intrinsics, reading_whole, rigid
from geodiff_plugin.messages import Message

SEVEN_SCENES = Camera(intrinsics(525.0, 525.0, 320.0, 240.0), (640, 480))
TUM_RGBD = Camera(intrinsics(525.0, 525.0, 319.5, 239.5), (640, 480))


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
INTRINSICS = "intrinsics.txt camera-intrinsics.txt K.txt intrinsic/intrinsic_color.txt intrinsic_color.txt"
#: Values a metre of TUM's depth maps.
TUM_DEPTH = 5000.0
#: Poses of a trajectory further from an image than this, in seconds, are not its own.
FARTHEST_S = 0.05
VIDEO = "video"
#: The camera-to-world pose at a time in seconds; ``None`` where none is near.
PoseAt = Callable[[float], np.ndarray | None]


def _file_camera(folder: Path, published: Camera | None) -> Camera | None:
    """The intrinsics that a data set has as a file, else its published ones."""
    files = [parent / name for parent in (folder, folder.parent) for name in INTRINSICS.split()]
    file = next((file for file in files if file.is_file()), None)
    return published if file is None else Camera(read_matrix(file, f"{file}")[:3, :3])


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
        camera, candidates = _file_camera(folder, of.camera), []
        for path in paths:
            name, E = path.name.partition(".")[0], None
            file = folder / of.pose.format(name)
            with suppress(InputError):
                E = rigid(read_matrix(file, f"{file}"), f"the pose in {file}")
            depth = folder / of.depth.format(name)
            candidates.append(Candidate(CaptureFrame(name, path, E, depth), camera))
        return Layout(kind, "m", candidates, notes=_assumed(kind, camera))
    return None


def read_tum(folder: Path) -> Layout | None:
    """TUM RGB-D: poses and depth maps by the time of each image."""
    if not ((folder / "rgb.txt").is_file() and (folder / "groundtruth.txt").is_file()):
        return None
    camera, candidates = _file_camera(folder, TUM_RGBD), list[Candidate]()
    pose_at = read_trajectory(folder / "groundtruth.txt")
    depths = _timed_names(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    for t, name in _timed_names(folder / "rgb.txt"):
        near, depth_name = min(depths, key=lambda depth: abs(depth[0] - t), default=(np.inf, ""))
        depth = folder / depth_name if abs(near - t) < FARTHEST_S else None
        frame = CaptureFrame(Path(name).stem, folder / name, pose_at(t), depth, TUM_DEPTH)
        candidates.append(Candidate(frame, camera))
    return Layout("TUM RGB-D", "m", candidates, notes=_assumed("TUM RGB-D", camera))


def _timed_names(file: Path) -> list[tuple[float, str]]:
    with reading_whole(file, "list of seconds and file names"):
        return [(float(t), name) for t, name, *_ in read_rows(file, f"{file}", "seconds and file names")]


def read_trajectory(file: Path) -> PoseAt:
    """Poses of a trajectory in TUM's form, lines ``seconds tx ty tz qx qy qz qw``, camera-to-world."""
    with reading_whole(file, "trajectory of lines seconds tx ty tz qx qy qz qw"):
        lines = [words[:8] for words in read_rows(file, f"{file}", "a trajectory")]
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
