"""What scanning apps of phones leave as raw data, and ARKitScenes; all in metres, by ARKit.

Source: ``process_data/polycam_utils.py`` and ``record3d_utils.py`` of nerfstudio-project/nerfstudio;
the page on its format of strayrobots/scanner and ``stray_visualize.py`` of kekeblom/StrayVisualizer;
``tenFpsDataLoader.py`` of apple/ARKitScenes; for 3D Scanner App other readers of ``cameraPoseARFrame``, some
of which take it by rows and some by columns.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.formats.files import read_matrix, read_rows, read_text
from geodiff_plugin.formats.image_files import images_in
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Layout, build_frame
from geodiff_plugin.formats.recordings import video_facts
from geodiff_plugin.formats.rigs import Camera, array_of, intrinsics, pose_of, rigid
from geodiff_plugin.formats.sequences import poses_by_time
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

#: Polycam's folders of cameras and of their images, those after its own adjustment first.
POLYCAM = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
#: Pixels are counted from the corner of the first one, as in nerfstudio, which takes the numbers as they are.
HALF = 0.5
#: The entry of 3D Scanner App with a camera-to-world pose.
SCANNER_POSE = "cameraPoseARFrame"


def read_polycam(path: Path) -> Layout | None:
    """Polycam's raw export: one JSON a camera, with its pose as ``t_00`` to ``t_23`` in OpenGL's axes."""
    for folder in (path, path / "keyframes"):
        for cameras, images in POLYCAM:
            files = [(image, folder / cameras / f"{image.stem}.json") for image in images_in(folder / images)]
            if any(file.is_file() for _, file in files):
                candidates = [
                    build_frame(CaptureFrame(image.stem, image), partial(_polycam_frame, file=file))
                    for image, file in files
                ]
                return Layout("Polycam", "m", candidates)
    return None


def _polycam_frame(frame: CaptureFrame, file: Path) -> Candidate:
    entries = json.loads(read_text(file, f"the camera of {frame.name}"))
    pose = [entries[f"t_{row}{column}"] for row in range(3) for column in range(4)]
    K = intrinsics(entries["fx"], entries["fy"], entries["cx"] - HALF, entries["cy"] - HALF)
    depth = file.parent.parent / "depth" / f"{frame.name}.png"
    E = rigid(pose, "t_00 to t_23") @ OPENGL_FROM_OPENCV
    return Candidate(replace(frame, E=E, depth=depth), Camera(K, (entries["width"], entries["height"])))


def read_record3d(path: Path) -> Layout | None:
    """Record3D's export as images: ``metadata.json`` (K by columns, poses), ``rgb/``, ``depth/*.exr``."""
    for folder in (path, path / "EXR_RGBD"):
        file = folder / "metadata.json"
        images = images_in(folder / "rgb")
        if not (images and file.is_file()):
            continue
        entries = json.loads(read_text(file, "PATH"))
        if "poses" not in entries or "K" not in entries:
            continue
        build = partial(_record3d_frame, entries=entries)
        candidates = [build_frame(CaptureFrame(image.stem, image), build) for image in images]
        return Layout("Record3D", "m", candidates)
    return None


def _record3d_frame(frame: CaptureFrame, entries: dict[str, Any]) -> Candidate:
    number = int(frame.name)  # images are numbered from 0, as the poses
    qx, qy, qz, qw, *place = array_of(entries["poses"][number], (7,), f"pose {number}")
    E = pose_of(Rotation.from_quat([qx, qy, qz, qw]), place) @ OPENGL_FROM_OPENCV
    K = array_of(entries["K"], (3, 3), "K").T
    each = entries.get("perFrameIntrinsicCoeffs") or []
    fx, fy, cx, cy = each[number][:4] if number < len(each) else (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    depth = frame.image.parent.parent / "depth" / f"{frame.name}.exr"
    camera = Camera(intrinsics(fx, fy, cx - HALF, cy - HALF), (entries["w"], entries["h"]))
    return Candidate(replace(frame, E=E, depth=depth), camera)


def read_stray(path: Path) -> Layout | None:
    """Stray Scanner's folder: ``odometry.csv`` beside ``rgb.mp4``, poses in OpenCV's axes, depth in mm."""
    file, video = path / "odometry.csv", path / "rgb.mp4"
    if not (file.is_file() and video.is_file()):
        return None
    count, _, size = video_facts(video, "PATH")
    camera = Camera(read_matrix(path / "camera_matrix.csv", "camera_matrix.csv"), size)
    heading, *rows = read_rows(file, f"{file}", "rows of a trajectory")
    column = {word.lower(): number for number, word in enumerate(heading)}

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        x, y, z, qx, qy, qz, qw = (row[column[key]] for key in ("x", "y", "z", "qx", "qy", "qz", "qw"))
        turn = Rotation.from_quat(array_of((qx, qy, qz, qw), (4,), "a rotation"))
        depths = (path / "depth" / f"{frame.name}{suffix}" for suffix in (".png", ".npy"))
        depth = next((depth for depth in depths if depth.is_file()), None)
        return Candidate(replace(frame, E=pose_of(turn, (x, y, z)), depth=depth), camera)

    candidates = []
    for row in rows:
        number = int(row[column["frame"]])
        frame = CaptureFrame(f"{number:06d}", video, index=number, size=size)
        if number < count:
            candidates.append(build_frame(frame, partial(build, row=row)))
    return Layout("Stray Scanner", "m", candidates)


def read_scanner_app(path: Path) -> Layout | None:
    """3D Scanner App's "all data": ``frame_NUMBER.json`` beside ``frame_NUMBER.jpg``, in OpenGL's axes."""
    pairs = [
        (image, image.with_suffix(".json")) for image in images_in(path) if image.stem.startswith("frame_")
    ]
    pairs = [(image, file) for image, file in pairs if file.is_file()]
    if not pairs or SCANNER_POSE not in read_text(pairs[0][1], "PATH"):
        return None
    candidates = [
        build_frame(CaptureFrame(image.stem, image), partial(_scanner_frame, file=file))
        for image, file in pairs
    ]
    return Layout("3D Scanner App", "m", candidates)


def _scanner_frame(frame: CaptureFrame, file: Path) -> Candidate:
    entries = json.loads(read_text(file, f"the camera of {frame.name}"))
    pose = array_of(entries[SCANNER_POSE], (4, 4), SCANNER_POSE)
    pose = pose.T if pose[3, :3].any() else pose  # by columns: the place stands in the last row
    K = array_of(entries["intrinsics"], (3, 3), "intrinsics")
    K = K.T if K[2, :2].any() else K
    K[:2, 2] -= HALF
    depth = file.with_name(f"{file.stem.replace('frame', 'depth', 1)}.png")
    return Candidate(replace(frame, E=rigid(pose, SCANNER_POSE) @ OPENGL_FROM_OPENCV, depth=depth), Camera(K))


def read_arkitscenes(path: Path) -> Layout | None:
    """A scene of ARKitScenes: ``lowres_wide/``, its ``.traj`` (world-to-camera) and ``.pincam`` files."""
    for folder in (path, path / f"{path.resolve().name}_frames"):
        images, file = images_in(folder / "lowres_wide"), folder / "lowres_wide.traj"
        if images and file.is_file():
            return _arkitscenes(folder, file, images)
    return None


def _arkitscenes(folder: Path, file: Path, images: list[Path]) -> Layout:
    rows = array_of([row[:7] for row in read_rows(file, f"{file}", "poses")], (-1, 7), "lines of 7")
    T = [pose_of(Rotation.from_rotvec(row[1:4]), row[4:]) for row in rows]  # camera from world
    places = np.array([np.linalg.inv(each) for each in T])
    quaternions = Rotation.from_matrix(places[:, :3, :3]).as_quat()
    pose_at = poses_by_time(rows[:, 0], places[:, :3, 3], quaternions)
    lenses = {_seconds(each): each for each in (folder / "lowres_wide_intrinsics").glob("*.pincam")}

    def build(frame: CaptureFrame) -> Candidate:
        seconds = _seconds(frame.image)
        near = min(lenses, key=lambda other: abs(other - seconds))
        (row,) = read_rows(lenses[near], lenses[near].name, "one line of a camera")
        width, height, fx, fy, cx, cy = array_of(row, (6,), "a camera")
        depth = folder / "lowres_depth" / frame.image.name
        camera = Camera(intrinsics(fx, fy, cx, cy), (int(width), int(height)))
        return Candidate(replace(frame, E=pose_at(seconds), depth=depth), camera)

    return Layout("ARKitScenes", "m", [build_frame(CaptureFrame(i.stem, i), build) for i in images])


def _seconds(file: Path) -> float:
    """The time in a name such as ``41069021_305.377.png``."""
    return float(file.stem.rpartition("_")[2])
