"""Reads data sets with trajectories: EuRoC's layout, TartanAir, KITTI odometry, MVSNet, Tanks and Temples.

Source: ``data_type.md`` of castacks/tartanair_tools; the development kit of KITTI odometry; ``README.md`` of
YoYo000/MVSNet; ``python_toolbox/convert_to_logfile.py`` of isl-org/TanksAndTemples; ``sensor.yaml`` and
``data.csv`` of EuRoC MAV.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError, bad_value
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import read_rows, read_text
from geodiff_plugin.formats.image_files import images_in
from geodiff_plugin.formats.layouts import (
    CameraPerImage,
    Candidate,
    CaptureFrame,
    Layout,
    build_frame,
    one_a_line,
    paired,
    posed,
)
from geodiff_plugin.formats.posed import EUROC, MVSNET, euroc_cameras, mvsnet_cameras
from geodiff_plugin.formats.rigs import RawCamera, array_of, intrinsics, pose_of, rigid
from geodiff_plugin.formats.sequences import TimedPoses

TARTANAIR = RawCamera(intrinsics(320.0, 320.0, 320.0, 240.0), (640, 480))
#: ``(4, 4)`` from OpenCV's axes (x right, y down, z forward) to TartanAir's (x forward, y right, z down).
NED_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
NS_PER_S = 1e9
#: Folders of a KITTI sequence, the colour camera first, with the number of the projection.
KITTI_IMAGES = (("image_2", 2), ("image_0", 0), ("image_3", 3), ("image_1", 1))
#: Rows per frame of a Tanks and Temples log: one of ``LOG_NUMBERS`` numbers, and a 4x4 matrix.
LOG_ROWS = 5
LOG_NUMBERS = 3
#: Folders with the body's pose in EuRoC's layout.
GROUND_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "gt0", "leica0")


def read_euroc(path: Path) -> Layout | None:
    """Read cam0 of a sequence in ASL's layout, from the body's poses and ``T_BS``; ignores other cameras."""
    for folder in (path, path / "mav0"):
        if not all((folder / "cam0" / name).is_file() for name in ("data.csv", "sensor.yaml")):
            continue
        ground_truth = next(
            (t for name in GROUND_TRUTH_FOLDERS if (t := folder / name / "data.csv").is_file()), None
        )
        if ground_truth is None:
            expected = (
                f"with ground truth ({' or '.join(f'{name}/data.csv' for name in GROUND_TRUTH_FOLDERS)})"
            )
            hint = f"Pass {folder / 'cam0' / 'data'} with --K to solve for the poses."
            bad_value("a sequence of EuRoC", expected, f"{folder} without", hint)
        return _euroc(folder, ground_truth)
    return None


def _euroc(folder: Path, ground_truth: Path) -> Layout:
    images = folder / "cam0" / "data"
    entries = euroc_cameras((read_text(folder / "cam0" / "sensor.yaml", "sensor.yaml"),))[0]
    camera = EUROC.camera(entries, "cam0")
    T_body_camera = EUROC.pose_of(entries, "cam0").world_from_camera
    rows = array_of(
        [row[:8] for row in read_rows(ground_truth, f"{ground_truth}", "poses")], (-1, 8), "lines of 8"
    )
    pose_at = TimedPoses(
        rows[:, 0] / NS_PER_S, rows[:, 1:4], rows[:, [5, 6, 7, 4]]
    )  # the quaternion starts with w

    def build(frame: CaptureFrame, ns: str) -> Candidate:
        E = pose_at(float(ns) / NS_PER_S)
        return posed(frame, None if E is None else E @ T_body_camera, camera)

    listed = read_rows(folder / "cam0" / "data.csv", "data.csv", "times and names of images")
    candidates = paired([images / name for _, name, *_ in listed], [ns for ns, *_ in listed], build)
    if not (folder / "cam1").is_dir():
        return Layout("EuRoC", "m", candidates)
    hint = "geodiff depth cam0/data cam1/data --calib cam0/sensor.yaml --calib cam1/sensor.yaml"
    sentence = f"Only cam0 is read. Pairs with cam1 have an exact baseline: {hint}."
    return Layout("EuRoC", "m", candidates, findings=(Finding("capture.part", sentence),))


def read_tartanair(path: Path) -> Layout | None:
    """Read TartanAir's left camera: ``image_left/``, ``pose_left.txt`` (own axes), ``depth_left/*.npy``."""
    file = path / "pose_left.txt"
    images = images_in(path / "image_left")
    if not (file.is_file() and images):
        return None

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        *place, qx, qy, qz, qw = array_of(row, (7,), "a pose")
        E = pose_of(Rotation.from_quat([qx, qy, qz, qw]), place) @ NED_FROM_OPENCV
        depth = path / "depth_left" / f"{frame.name}_depth.npy"
        return posed(frame, E, TARTANAIR, depth=depth)

    return Layout("TartanAir", "m", one_a_line(images, file, build))


def read_kitti_odometry(path: Path) -> Layout | None:
    """Read a KITTI odometry sequence: ``calib.txt``, ``image_2/``, and poses of camera 0 as 3x4 lines."""
    folder, number = next(((path / f, n) for f, n in KITTI_IMAGES if images_in(path / f)), (path, 0))
    place = path.resolve()
    calib = path / "calib.txt"
    named = f"{place.name}.txt"
    poses = (path / "poses.txt", path / named, place.parent.parent / "poses" / named)
    file = next((at for at in poses if at.is_file()), None)
    if folder == path or file is None or not calib.is_file():
        return None
    P = {row[0].rstrip(":"): row[1:] for row in read_rows(calib, f"{calib}", "projections")}
    projection = array_of(P[f"P{number}"], (3, 4), f"P{number}")
    K = projection[:, :3]
    shift = np.eye(4)
    shift[:3, 3] = -np.linalg.solve(K, projection[:, 3])  # the camera's position in camera 0's frame

    def build(frame: CaptureFrame, row: list[str]) -> Candidate:
        return posed(frame, rigid(row, "a pose") @ shift, RawCamera(K))

    return Layout("KITTI odometry", "m", one_a_line(images_in(folder), file, build))


def mvsnet_camera(text: str, name: str) -> tuple[np.ndarray, RawCamera]:
    """Read an MVSNet ``cam.txt``."""
    entries = mvsnet_cameras((text,))[0]
    return MVSNET.pose_of(entries, name).world_from_camera, MVSNET.camera(entries, name)


#: MVSNet scan: ``cams/NAME_cam.txt`` next to ``images/`` or ``blended_images/``.
MVSNET_FOLDER = CameraPerImage(
    "MVSNet",
    None,
    (("images/*", "cams/{}_cam.txt"), ("blended_images/*", "cams/{}_cam.txt")),
    mvsnet_camera,
)


def read_log(path: Path) -> Layout | None:
    """Read a Tanks and Temples ``.log``: three numbers and a camera-to-world matrix per frame."""
    if path.suffix == ".log":
        return _log_of_rows(path, read_rows(path, f"{path}", "poses"))
    for file in sorted(path.glob("*.log")):
        rows: list[list[str]] = []
        with suppress(InputError):  # the log of any program, which may be empty or have decimal commas
            rows = read_rows(file, f"{file}", "poses")
        layout = _log_of_rows(file, rows)
        if layout is not None:
            return layout
    return None


def _log_of_rows(file: Path, rows: list[list[str]]) -> Layout | None:
    """Return the frames of a file with these rows; ``None`` unless it is a log with poses."""
    frames = [rows[first : first + LOG_ROWS] for first in range(0, len(rows), LOG_ROWS)]
    heads = [frame[0] for frame in frames]
    bodies = [list(chain(*frame[1:])) for frame in frames]
    is_log = all(len(head) == LOG_NUMBERS for head in heads) and all(len(body) == 16 for body in bodies)
    return _log(file, heads, bodies) if frames and is_log else None


def _log(file: Path, heads: list[list[str]], bodies: list[list[str]]) -> Layout:
    places = (file.parent, file.parent / "images", file.with_suffix(""))
    images = next(filter(None, map(images_in, places)), [])
    if not images:
        bad_value("PATH", "a .log with its images next to it or in images/", file)

    def build(frame: CaptureFrame, body: list[str]) -> Candidate:
        return posed(frame, rigid(body, f"the pose of {frame.name}") if body else None)

    candidates = []
    for head, body in zip(heads, bodies, strict=True):
        number = int(float(head[0]))
        registered = int(float(head[1])) >= 0  # the toolbox writes -1 for unregistered images
        if not 0 <= number < len(images):
            bad_value(file.name, f"a log of the {len(images)} images next to it", f"a frame {number}")
        frame = CaptureFrame(images[number].stem, images[number])
        candidates.append(build_frame(frame, build, body if registered else []))
    return Layout("Tanks and Temples", None, candidates)
