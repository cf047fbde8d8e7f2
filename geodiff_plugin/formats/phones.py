"""Reads raw data of phone scanning apps, and ARKitScenes; all in metres, from ARKit.

Source: ``process_data/polycam_utils.py`` and ``record3d_utils.py`` of nerfstudio-project/nerfstudio;
the page on its format of strayrobots/scanner and ``stray_visualize.py`` of kekeblom/StrayVisualizer;
``tenFpsDataLoader.py`` of apple/ARKitScenes; for 3D Scanner App other readers of ``cameraPoseARFrame``, some
row-major and some column-major.
"""

from __future__ import annotations

import json
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.formats.files import read_matrix, read_rows, read_text
from geodiff_plugin.formats.image_files import images_in
from geodiff_plugin.formats.layouts import (
    CameraPerImage,
    Candidate,
    CaptureFrame,
    Layout,
    build_frame,
    paired,
    posed,
)
from geodiff_plugin.formats.recordings import video_facts
from geodiff_plugin.formats.rigs import RawCamera, array_of, intrinsics, pose_of, rigid
from geodiff_plugin.formats.sequences import TimedPoses
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV

#: Offset of pixels counted from the corner of the first one, as in nerfstudio, which uses the numbers
#: unchanged.
HALF = 0.5
#: Key of the camera-to-world pose in 3D Scanner App.
SCANNER_POSE = "cameraPoseARFrame"


def polycam_camera(text: str, name: str) -> tuple[np.ndarray, RawCamera]:
    """Read a JSON of Polycam's raw export, with the pose as ``t_00`` to ``t_23`` in OpenGL's axes."""
    entries = json.loads(text)
    pose = [entries[f"t_{row}{column}"] for row in range(3) for column in range(4)]
    K = intrinsics(entries["fx"], entries["fy"], entries["cx"] - HALF, entries["cy"] - HALF)
    camera = RawCamera(K, (entries["width"], entries["height"]))
    return rigid(pose, "t_00 to t_23") @ OPENGL_FROM_OPENCV, camera


def scanner_camera(text: str, name: str) -> tuple[np.ndarray, RawCamera]:
    """Read a JSON of 3D Scanner App, in OpenGL's axes; matrices are row-major or column-major."""
    entries = json.loads(text)
    pose = array_of(entries[SCANNER_POSE], (4, 4), SCANNER_POSE)
    pose = pose.T if pose[3, :3].any() else pose
    K = array_of(entries["intrinsics"], (3, 3), "intrinsics")
    K = K.T if K[2, :2].any() else K
    K[:2, 2] -= HALF
    return rigid(pose, SCANNER_POSE) @ OPENGL_FROM_OPENCV, RawCamera(K)


#: Polycam's raw export; adjusted cameras take precedence.
POLYCAM = CameraPerImage(
    "Polycam",
    "m",
    (("corrected_images/*", "corrected_cameras/{}.json"), ("images/*", "cameras/{}.json")),
    polycam_camera,
    lambda image: image.parent.parent / "depth" / f"{image.stem}.png",
    below=("", "keyframes"),
)
#: Export "All data" of 3D Scanner App.
SCANNER_APP = CameraPerImage(
    "3D Scanner App",
    "m",
    (("frame_*", "{}.json"),),
    scanner_camera,
    lambda image: image.with_name(f"{image.stem.replace('frame', 'depth', 1)}.png"),
    mark=SCANNER_POSE,
)


def read_record3d(path: Path) -> Layout | None:
    """Read Record3D's export: ``metadata.json`` (K column-major, poses), ``rgb/``, ``depth/*.exr``."""
    for folder in (path, path / "EXR_RGBD"):
        file = folder / "metadata.json"
        images = images_in(folder / "rgb")
        if not (images and file.is_file()):
            continue
        entries = json.loads(read_text(file, "PATH"))
        if "poses" not in entries or "K" not in entries:
            continue
        return Layout("Record3D", "m", paired(images, repeat(entries, len(images)), _record3d_frame))
    return None


def _record3d_frame(frame: CaptureFrame, entries: dict[str, Any]) -> Candidate:
    number = int(frame.name)  # images and poses are numbered from 0
    qx, qy, qz, qw, *place = array_of(entries["poses"][number], (7,), f"pose {number}")
    E = pose_of(Rotation.from_quat([qx, qy, qz, qw]), place) @ OPENGL_FROM_OPENCV
    K = array_of(entries["K"], (3, 3), "K").T
    each = entries.get("perFrameIntrinsicCoeffs") or []
    fx, fy, cx, cy = each[number][:4] if number < len(each) else (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    depth = frame.image.parent.parent / "depth" / f"{frame.name}.exr"
    camera = RawCamera(intrinsics(fx, fy, cx - HALF, cy - HALF), (entries["w"], entries["h"]))
    return posed(frame, E, camera, depth=depth)


def read_stray(path: Path) -> Layout | None:
    """Read Stray Scanner's folder: ``odometry.csv``, ``rgb.mp4``, poses in OpenCV's axes, depth in mm."""
    file, video = path / "odometry.csv", path / "rgb.mp4"
    if not (file.is_file() and video.is_file()):
        return None
    facts = video_facts(video, "PATH")
    camera = RawCamera(read_matrix(path / "camera_matrix.csv", "camera_matrix.csv"), facts.size)
    heading, *rows = read_rows(file, f"{file}", "rows of a trajectory")
    column = {word.lower(): number for number, word in enumerate(heading)}

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        x, y, z, qx, qy, qz, qw = (row[column[key]] for key in ("x", "y", "z", "qx", "qy", "qz", "qw"))
        turn = Rotation.from_quat(array_of((qx, qy, qz, qw), (4,), "a rotation"))
        depths = (path / "depth" / f"{frame.name}{suffix}" for suffix in (".png", ".npy"))
        depth = next((depth for depth in depths if depth.is_file()), None)
        return posed(frame, pose_of(turn, (x, y, z)), camera, depth=depth)

    candidates = []
    for row in rows:
        number = int(row[column["frame"]])
        frame = CaptureFrame(f"{number:06d}", video, index=number)
        if number < facts.frames:
            candidates.append(build_frame(frame, build, row))
    return Layout("Stray Scanner", "m", candidates)


def read_arkitscenes(path: Path) -> Layout | None:
    """Read an ARKitScenes scene: ``lowres_wide/``, its ``.traj`` (world-to-camera) and ``.pincam`` files."""
    for folder in (path, path / f"{path.resolve().name}_frames"):
        images = images_in(folder / "lowres_wide")
        file = folder / "lowres_wide.traj"
        if images and file.is_file():
            return _arkitscenes(folder, file, images)
    return None


def _arkitscenes(folder: Path, file: Path, images: list[Path]) -> Layout:
    rows = array_of([row[:7] for row in read_rows(file, f"{file}", "poses")], (-1, 7), "lines of 7")
    T = [pose_of(Rotation.from_rotvec(row[1:4]), row[4:]) for row in rows]  # world-to-camera
    places = np.array([np.linalg.inv(each) for each in T])
    quaternions = Rotation.from_matrix(places[:, :3, :3]).as_quat()
    pose_at = TimedPoses(rows[:, 0], places[:, :3, 3], quaternions)
    lenses = {_seconds(each): each for each in (folder / "lowres_wide_intrinsics").glob("*.pincam")}

    def build(frame: CaptureFrame, seconds: float) -> Candidate:
        near = min(lenses, key=lambda other: abs(other - seconds))
        (row,) = read_rows(lenses[near], lenses[near].name, "one line of a camera")
        width, height, fx, fy, cx, cy = array_of(row, (6,), "a camera")
        depth = folder / "lowres_depth" / frame.image.name
        camera = RawCamera(intrinsics(fx, fy, cx, cy), (int(width), int(height)))
        return posed(frame, pose_at(seconds), camera, depth=depth)

    return Layout("ARKitScenes", "m", paired(images, map(_seconds, images), build))


def _seconds(file: Path) -> float:
    """Return the time in a name such as ``41069021_305.377.png``."""
    return float(file.stem.rpartition("_")[2])
