"""Captures: the posed frames of one moving camera, as phones, trackers, SLAM and COLMAP leave them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from geodiff_plugin._checks import InputError, MissingFileError, bad_value
from geodiff_plugin.formats import sfm
from geodiff_plugin.formats.files import (
    PathLike,
    natural_order,
    read_matrix,
    read_rows,
    read_text,
    upright_size,
)
from geodiff_plugin.formats.images import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.formats.recordings import is_video, video_facts
from geodiff_plugin.formats.rigs import Camera, array_of, intrinsics, lens_of, reading_whole, resized, rigid
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Distortion

IMAGES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
SEVEN_SCENES = Camera(intrinsics(525.0, 525.0, 320.0, 240.0), (640, 480))
TUM_RGBD = Camera(intrinsics(525.0, 525.0, 319.5, 239.5), (640, 480))
#: What data sets with a pose a file call their images, poses and depth maps, and their published intrinsics.
TRACKED = {
    "7-Scenes": ("frame-*.color.*", "{}.pose.txt", "{}.depth.png", SEVEN_SCENES),
    "ScanNet": ("color/*", "pose/{}.txt", "depth/{}.png", None),
}
INTRINSICS = "intrinsics.txt camera-intrinsics.txt K.txt intrinsic/intrinsic_color.txt intrinsic_color.txt"
#: Values a metre of TUM's depth maps, others are in millimetres.
TUM_DEPTH = 5000.0
#: With these entries the poses of a transforms.json come from structure from motion.
OF_COLMAP = ("colmap_im_id", "sharpness")
#: Poses of a trajectory further from an image than this, in seconds, are not its own.
FARTHEST_S = 0.05


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One frame; ``E`` is its camera-to-world pose in OpenCV's axes, ``None`` where none is given."""

    name: str
    image: Path
    E: np.ndarray | None = None
    depth: Path | None = None
    depth_per_m: float = 1000.0
    index: int | None = None
    points: np.ndarray | None = None
    size: tuple[int, int] = (0, 0)
    K: np.ndarray = field(default_factory=lambda: np.eye(3))
    lens: Distortion | None = None


#: What a layout's reader returns: its kind, its unit (``"m"`` or ``None``), and the frames, each with its
#: camera as the file has it.
Found = tuple[str, str | None, Sequence[tuple[CaptureFrame, Camera | None]]]


def read_capture(
    path: PathLike,
    *,
    K: np.ndarray | None = None,
    fov: float | None = None,
    trajectory: PathLike | None = None,
) -> tuple[list[CaptureFrame], str, str | None, list[Message]]:
    """The frames of a capture in order, the kind of its layout, its unit, and notes for the user.

    ``K`` and ``fov`` (horizontal, degrees) are for layouts without intrinsics, and go before the files'.
    ``trajectory`` has a video's lines ``seconds tx ty tz qx qy qz qw``, camera-to-world, OpenCV's axes.
    """
    source = Path(path)
    if not source.exists():
        bad_value("PATH", "a capture", f"{source}, which does not exist", error=MissingFileError)
    with reading_whole(source, "capture"):
        read = (layout(source, None if trajectory is None else Path(trajectory)) for layout in LAYOUTS)
        layout = next((each for each in read if each is not None), None)
        if layout is None:
            expected = "a COLMAP model, a transforms.json, 7-Scenes, ScanNet or TUM RGB-D, a video or images"
            bad_value("PATH", expected, f"{source}, which is none of these")
        kind, unit, pairs = layout
        if trajectory is not None and kind != "video":
            bad_value("trajectory (--trajectory)", "left out where the capture is not a video", trajectory)
        whole = [(frame, camera) for frame, camera in pairs if frame.image.is_file()]
        frames = [_finished(frame, camera, K, fov) for frame, camera in whole]
    tracked = any(frame.E is not None for frame in frames)
    skipped = {"no image file": [frame.name for frame, _ in pairs if not frame.image.is_file()]}
    if tracked:
        skipped["no pose"] = [frame.name for frame in frames if frame.E is None]
        frames = [frame for frame in frames if frame.E is not None]
    notes = [
        Message(
            "capture.skipped",
            f"{', '.join(names[:5])}{', ...' * (len(names) > 5)}: {why}; {len(names)} skipped.",
        )
        for why, names in skipped.items()
        if names
    ]
    if K is None and fov is None and any(c is SEVEN_SCENES or c is TUM_RGBD for _, c in whole):
        sentence = f"Assumed: K of the cameras of {kind}, 525 px at 640x480. Give --K for another."
        notes.append(Message("capture.assumed-k", sentence))
    if kind == "video" and trajectory is None:
        sentence = "No --trajectory: the poses are estimated, without a unit."
        notes.append(Message("capture.no-trajectory", sentence))
    if len({frame.name for frame in frames}) < len(frames):  # of two folders, whose names tell them apart
        frames = [replace(frame, name=f"{frame.image.parent.name}-{frame.name}") for frame in frames]
    if len(frames) < 2:
        cure = "One frame has no second view: use geodiff depth with known points, or record more."
        bad_value("a capture", "at least two frames", f"{len(frames)} in {source}", cure)
    return frames, kind, unit if tracked else None, notes


def _finished(
    frame: CaptureFrame, camera: Camera | None, K: np.ndarray | None, fov: float | None
) -> CaptureFrame:
    """The frame with its size and K: as typed, else the file's camera scaled to the image, else by EXIF."""
    name = str(frame.image)
    size = upright_size(frame.image, name) if frame.index is None else frame.size
    if K is None and fov is not None:
        K = intrinsics_from_fov(fov, size)
    elif K is None and camera is not None:
        K = resized(camera, size, name, "Is it a crop? Give --K.").K
    elif K is None and frame.index is not None:
        bad_value("K", "given by --K or --fov", "none", "A video does not say its focal length.")
    elif K is None:
        K = intrinsics_from_exif(frame.image, frame.image.name)[0]
    lens = None if camera is None else lens_of(camera, name)
    depth = frame.depth if frame.depth is not None and frame.depth.is_file() else None
    return replace(frame, size=size, K=np.asarray(K, dtype=np.float64), lens=lens, depth=depth)


def _file_camera(folder: Path, published: Camera | None) -> Camera | None:
    """The intrinsics that a data set has as a file, else its published ones."""
    files = [parent / name for parent in (folder, folder.parent) for name in INTRINSICS.split()]
    file = next((file for file in files if file.is_file()), None)
    return published if file is None else Camera(read_matrix(file, f"{file}")[:3, :3])


def _images_of(paths: Iterable[Path]) -> list[Path]:
    """The images among paths, numbers in names in order."""
    return sorted((path for path in paths if path.suffix.lower() in IMAGES), key=natural_order)


# A layout's reader returns None for what is none.


def _transforms(path: Path, _: Path | None) -> Found | None:
    file = path / "transforms.json" if path.is_dir() else path
    if file.suffix != ".json" or not file.is_file():
        return None
    pairs, solved = [], False
    for name, entries in sfm.nerf_frames(read_text(file, "PATH")).items():
        paths = [file.parent / f"{name}{suffix}" for suffix in ("", *IMAGES)]  # synthetic scenes leave it out
        image = next((path for path in paths if path.is_file()), paths[0])
        camera = sfm.nerf_camera(entries, upright_size(image, f"{image}") if image.is_file() else None)
        depth = file.parent / entries.get("depth_file_path", f"depth/{image.stem}.png")
        pairs.append((CaptureFrame(image.stem, image, sfm.nerf_pose(entries), depth), camera))
        solved |= any(key in entries for key in OF_COLMAP)
    return "transforms.json", None if solved else "m", pairs


def _colmap(path: Path, _: Path | None) -> Found | None:
    folders = (path, path / "sparse" / "0", path / "sparse", path / "colmap" / "sparse" / "0")
    files = next(filter(None, map(sfm.model_files, folders)), None)
    if files is None:
        return None
    cameras, images, folder = *sfm.read_colmap_model(files), files[0].parent
    try:
        seen = sfm.read_colmap_points(folder)
    except MissingFileError:
        seen = {}
    parents = [folder / "images", *(parent / "images" for parent in list(folder.parents)[:3]), folder]
    pairs = []
    for name, (number, T, camera) in sorted(images.items()):
        image = next((parent / name for parent in parents if (parent / name).is_file()), parents[0] / name)
        frame = CaptureFrame(image.stem, image, np.linalg.inv(T), points=seen.get(number))
        pairs.append((frame, cameras[camera]))
    return "COLMAP model", None, pairs


def _tracked(folder: Path, _: Path | None) -> Found | None:
    for kind, (images, pose, depth, published) in TRACKED.items():
        paths = _images_of(folder.glob(images))
        if not (paths and (folder / pose).parent.is_dir()):
            continue
        camera, frames = _file_camera(folder, published), []
        for path in paths:
            name, E = path.name.partition(".")[0], None
            file = folder / pose.format(name)
            with suppress(InputError):  # there is none, or the tracker was lost (infinity, NaN)
                E = read_matrix(file, f"{file}")
            E = None if E is None else rigid(E, f"the pose in {file}")
            frames.append(CaptureFrame(name, path, E, folder / depth.format(name)))
        return kind, "m", [(frame, camera) for frame in frames]
    return None


def _tum(folder: Path, _: Path | None) -> Found | None:
    if not ((folder / "rgb.txt").is_file() and (folder / "groundtruth.txt").is_file()):
        return None
    camera, pose_at, pairs = _file_camera(folder, TUM_RGBD), _trajectory(folder / "groundtruth.txt"), []
    depths = _timed_names(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    for t, name in _timed_names(folder / "rgb.txt"):
        near, depth_name = min(depths, key=lambda depth: abs(depth[0] - t), default=(np.inf, ""))
        depth = folder / depth_name if abs(near - t) < FARTHEST_S else None
        pairs.append((CaptureFrame(Path(name).stem, folder / name, pose_at(t), depth, TUM_DEPTH), camera))
    return "TUM RGB-D", "m", pairs


def _timed_names(file: Path) -> list[tuple[float, str]]:
    with reading_whole(file, "list of seconds and file names"):
        return [(float(t), name) for t, name, *_ in read_rows(file, f"{file}", "seconds and file names")]


def _trajectory(file: Path) -> Callable[[float], np.ndarray | None]:
    """Poses by time, interpolated between the lines of a trajectory in TUM's form."""
    with reading_whole(file, "trajectory of lines seconds tx ty tz qx qy qz qw"):
        lines = [words[:8] for words in read_rows(file, f"{file}", "a trajectory")]
        rows = array_of(lines, (-1, 8), "lines of 8")
        times, first = np.unique(rows[:, 0], return_index=True)
        turns, places = Slerp(times, Rotation.from_quat(rows[first, 4:])), rows[first, 1:4]

    def pose_at(t: float) -> np.ndarray | None:
        if np.abs(times - t).min() > FARTHEST_S:
            return None
        t, E = float(np.clip(t, times[0], times[-1])), np.eye(4)
        E[:3, :3] = turns(t).as_matrix()
        E[:3, 3] = [np.interp(t, times, along) for along in places.T]
        return E

    return pose_at


def _video(path: Path, trajectory: Path | None) -> Found | None:
    if not (path.is_file() and is_video(path)):
        return None
    count, fps, size = video_facts(path, "PATH")
    pose_at = (lambda t: None) if trajectory is None else _trajectory(trajectory)
    frames = (CaptureFrame(f"{n:06d}", path, pose_at(n / fps), index=n, size=size) for n in range(count))
    return "video", "m", [(frame, None) for frame in frames]


def _images(path: Path, _: Path | None) -> Found | None:
    folders = [_images_of(folder.iterdir()) for folder in (path, path / "images") if folder.is_dir()]
    pairs = [(CaptureFrame(image.stem, image), None) for image in next(filter(None, folders), [])]
    return ("images without poses", None, pairs) if pairs else None


LAYOUTS = (_transforms, _colmap, _tracked, _tum, _video, _images)
