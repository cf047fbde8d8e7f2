"""Data sets of trajectories and images: EuRoC's layout, TartanAir, KITTI odometry, MVSNet, Tanks and Temples.

Source: ``data_type.md`` of castacks/tartanair_tools; the development kit of KITTI odometry; ``README.md`` of
YoYo000/MVSNet; ``python_toolbox/convert_to_logfile.py`` of isl-org/TanksAndTemples; ``sensor.yaml`` and
``data.csv`` of EuRoC MAV.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import read_rows, read_text
from geodiff_plugin.formats.image_files import images_in
from geodiff_plugin.formats.layouts import (
    Candidate,
    CaptureFrame,
    Layout,
    build_frame,
)
from geodiff_plugin.formats.rigs import Camera, array_of, intrinsics, pose_of, rigid
from geodiff_plugin.formats.robotics import body_from_camera, euroc_camera
from geodiff_plugin.formats.sequences import poses_by_time
from geodiff_plugin.formats.storage import read_yaml
from geodiff_plugin.messages import Message

TARTANAIR = Camera(intrinsics(320.0, 320.0, 320.0, 240.0), (640, 480))
#: ``(4, 4)``, from a camera's frame (x right, y down, z forward) to TartanAir's (x forward, y right, z down).
NED_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
NS_PER_S = 1e9
#: Folders of a KITTI sequence, the colour camera first, and the number of its projection.
KITTI_IMAGES = (("image_2", 2), ("image_0", 0), ("image_3", 3), ("image_1", 1))
#: Where EuRoC's layout has the pose of the body.
GROUND_TRUTHS = ("state_groundtruth_estimate0", "mocap0", "gt0", "leica0")


def read_euroc(path: Path) -> Layout | None:
    """cam0 of a sequence in ASL's layout, by the body's poses and ``T_BS``; the other camera is left out."""
    for folder in (path, path / "mav0"):
        if not all((folder / "cam0" / name).is_file() for name in ("data.csv", "sensor.yaml")):
            continue
        truth = next((t for name in GROUND_TRUTHS if (t := folder / name / "data.csv").is_file()), None)
        if truth is None:
            expected = f"with ground truth ({' or '.join(f'{name}/data.csv' for name in GROUND_TRUTHS)})"
            cure = f"Give {folder / 'cam0' / 'data'} with --K to solve for the poses."
            bad_value("a sequence of EuRoC", expected, f"{folder} without", cure)
        return _euroc(folder, truth)
    return None


def _euroc(folder: Path, truth: Path) -> Layout:
    images = folder / "cam0" / "data"
    entries = read_yaml(read_text(folder / "cam0" / "sensor.yaml", "sensor.yaml"))
    camera, T_body_camera = euroc_camera(entries), body_from_camera(entries)
    rows = array_of([row[:8] for row in read_rows(truth, f"{truth}", "poses")], (-1, 8), "lines of 8")
    pose_at = poses_by_time(rows[:, 0] / NS_PER_S, rows[:, 1:4], rows[:, [5, 6, 7, 4]])  # w comes first

    def build(frame: CaptureFrame, ns: str) -> Candidate:
        E = pose_at(float(ns) / NS_PER_S)
        return Candidate(replace(frame, E=None if E is None else E @ T_body_camera), camera)

    listed = read_rows(folder / "cam0" / "data.csv", "data.csv", "times and names of images")
    candidates = [
        build_frame(CaptureFrame(Path(name).stem, images / name), partial(build, ns=ns))
        for ns, name, *_ in listed
    ]
    if not (folder / "cam1").is_dir():
        return Layout("EuRoC", "m", candidates)
    cure = "geodiff depth cam0/data cam1/data --calib cam0/sensor.yaml --calib cam1/sensor.yaml"
    sentence = f"cam0 alone is read. Its pairs with cam1 have an exact baseline: {cure}."
    return Layout("EuRoC", "m", candidates, notes=(Message("capture.part", sentence),))


def read_tartanair(path: Path) -> Layout | None:
    """TartanAir's left camera: ``image_left/``, ``pose_left.txt`` in its own axes, ``depth_left/*.npy``."""
    file, images = path / "pose_left.txt", images_in(path / "image_left")
    if not (file.is_file() and images):
        return None

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        *place, qx, qy, qz, qw = array_of(row, (7,), "a pose")
        E = pose_of(Rotation.from_quat([qx, qy, qz, qw]), place) @ NED_FROM_OPENCV
        depth = path / "depth_left" / f"{frame.name}_depth.npy"
        return Candidate(replace(frame, E=E, depth=depth), TARTANAIR)

    return Layout("TartanAir", "m", _one_a_line(images, file, build))


def _one_a_line(
    images: Sequence[Path], file: Path, build: Callable[[CaptureFrame, list[str]], Candidate]
) -> list[Candidate]:
    """The candidates of images with a pose a line."""
    rows = read_rows(file, f"{file}", "poses, one a line")
    if len(rows) != len(images):
        bad_value(f"{file.name}", f"of {len(images)} lines, one for each image", f"{len(rows)}")
    pairs = zip(images, rows, strict=True)
    return [
        build_frame(CaptureFrame(image.stem, image), lambda frame, row=row: build(frame, row))  # type: ignore[misc]
        for image, row in pairs
    ]


def read_kitti_odometry(path: Path) -> Layout | None:
    """A sequence of KITTI odometry: ``calib.txt``, ``image_2/``, and the poses of camera 0 as 3x4 lines."""
    folder, number = next(((path / f, n) for f, n in KITTI_IMAGES if images_in(path / f)), (path, 0))
    place, calib = path.resolve(), path / "calib.txt"
    named = f"{place.name}.txt"
    poses = (path / "poses.txt", path / named, place.parent.parent / "poses" / named)
    file = next((at for at in poses if at.is_file()), None)
    if folder == path or file is None or not calib.is_file():
        return None
    P = {row[0].rstrip(":"): row[1:] for row in read_rows(calib, f"{calib}", "projections")}
    projection = array_of(P[f"P{number}"], (3, 4), f"P{number}")
    K, shift = projection[:, :3], np.eye(4)
    shift[:3, 3] = -np.linalg.solve(K, projection[:, 3])  # the camera's place in camera 0's frame

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        return Candidate(replace(frame, E=rigid(row, "a pose") @ shift), Camera(K))

    return Layout("KITTI odometry", "m", _one_a_line(images_in(folder), file, build))


def read_mvsnet_folder(path: Path) -> Layout | None:
    """MVSNet's folder of a scan: ``cams/NAME_cam.txt`` beside ``images/`` or ``blended_images/``."""
    folder = next((at for name in ("images", "blended_images") if images_in(at := path / name)), None)
    if folder is None or not any((path / "cams").glob("*_cam.txt")):
        return None

    def build(frame: CaptureFrame) -> Candidate:
        text = read_text(path / "cams" / f"{frame.name}_cam.txt", f"the camera of {frame.name}")
        extrinsic, _, intrinsic = text.partition("extrinsic")[2].partition("intrinsic")
        T = rigid(extrinsic.split()[:16], "extrinsic")
        K = array_of(intrinsic.split()[:9], (3, 3), "intrinsic")
        return Candidate(replace(frame, E=np.linalg.inv(T)), Camera(K))

    candidates = [build_frame(CaptureFrame(image.stem, image), build) for image in images_in(folder)]
    return Layout("MVSNet", None, candidates)


def read_log(path: Path) -> Layout | None:
    """Tanks and Temples' ``.log`` beside images: three numbers and a camera-to-world matrix a frame; no K."""
    files = [path] if path.suffix == ".log" else sorted(path.glob("*.log")) if path.is_dir() else []
    for file in files:
        rows = read_rows(file, f"{file}", "poses")
        heads = rows[::5]
        bodies = [[word for row in rows[n + 1 : n + 5] for word in row] for n in range(0, len(rows), 5)]
        if all(len(head) == 3 for head in heads) and all(len(body) == 16 for body in bodies):
            return _log(file, heads, bodies)
    return None


def _log(file: Path, heads: list[list[str]], bodies: list[list[str]]) -> Layout:
    places = (file.parent, file.parent / "images", file.with_suffix(""))
    images = next(filter(None, map(images_in, places)), [])
    if not images:
        bad_value("PATH", "a .log with its images beside it or in images/", file)

    def build(frame: CaptureFrame, registered: bool, body: list[str]) -> Candidate:
        return Candidate(replace(frame, E=rigid(body, f"the pose of {frame.name}") if registered else None))

    candidates = []
    for head, body in zip(heads, bodies, strict=True):
        number, registered = int(float(head[0])), int(float(head[1])) >= 0  # the toolbox writes -1 otherwise
        if not 0 <= number < len(images):
            bad_value(file.name, f"of the {len(images)} images beside it", f"a frame {number}")
        frame = CaptureFrame(images[number].stem, images[number])
        candidates.append(build_frame(frame, partial(build, registered=registered, body=body)))
    return Layout("Tanks and Temples", None, candidates)
