"""Reads points of KITTI's lidar (``velodyne/*.bin``) in the frame of the left camera.

Source: ``readme.txt`` of KITTI's raw data, object, tracking and odometry benchmarks; ``pykitti/raw.py`` and
``pykitti/odometry.py`` of utiasSTARS/pykitti.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import PathLike, check_file, read_text
from geodiff_plugin.formats.rigs import CameraChoice, array_of, reading_file, rigid, transform
from geodiff_plugin.formats.stereo import left_projection_of_kitti

#: Suffix of a file with lidar points.
LIDAR_SUFFIX = ".bin"
#: Type of x, y, z and reflectance, little-endian.
NUMBER = np.dtype("<f4")
COLUMNS = 4
#: File with the lidar's pose, next to ``calib_cam_to_cam.txt`` in raw data.
OF_LIDAR = "calib_velo_to_cam.txt"
ENTRY = re.compile(r"(?m)^\s*([A-Za-z]\w*)\s*:?[ \t]+(.*)$")
#: Names of the pose in the object and tracking benchmarks, relative to the unrectified camera 0.
UNRECTIFIED = ("Tr_velo_to_cam", "Tr_velo_cam")
#: Names of camera 0's rectifying rotation, in raw data and in those benchmarks.
RECTIFYING = ("R_rect_00", "R0_rect", "R_rect")
#: Name of the pose in the odometry benchmark, relative to the rectified camera 0.
RECTIFIED = "Tr"
HINT = (
    "Pass KITTI's calibration with the lidar's pose: calib_cam_to_cam.txt with calib_velo_to_cam.txt in "
    "the same folder, or the file of the object, tracking or odometry benchmark. Otherwise transform the "
    "points to the left camera's frame and save them as .npy."
)


def read_lidar(
    path: PathLike,
    calibration: Sequence[PathLike],
    cameras: tuple[int, int] | None = None,
    image_folder_hint: str | None = None,
    name: str = "points",
) -> np.ndarray:
    """Read the points ``(N, 3)`` float32 metres in front of the left camera, in its rectified frame.

    Args:
        path: ``velodyne_points/data/*.bin``: x, y, z and reflectance of each point, in the lidar's frame.
        calibration: files for ``read_calibration``; KITTI has one.
        cameras: as in ``read_calibration``; selects the left camera.
        image_folder_hint: as in ``read_calibration``.
        name: name of the points in errors.

    Raises:
        InputError: a file of other points, or a calibration without the lidar's pose.
    """
    points = _scan(check_file(path, name, "a file of known depths"), name)
    if len(calibration) != 1:
        bad_value(name, "points of the left camera, or KITTI's lidar with its calibration", path, HINT)
    file = Path(calibration[0])
    with reading_file(file, "calibration of KITTI"):
        text = read_text(file, "calibration")
        projection = left_projection_of_kitti(text, CameraChoice(cameras, image_folder_hint))
        T = _rectified_from_lidar(file, text)
    place = np.linalg.solve(
        projection[:, :3], projection[:, 3]
    )  # position of camera 0 in the left camera's frame
    seen = points @ T[:3, :3].T + T[:3, 3] + place
    return seen[seen[:, 2] > 0].astype(np.float32)


def _scan(file: Path, name: str) -> np.ndarray:
    """Return ``(N, 3)`` float64 in the lidar's frame."""
    data = file.read_bytes()
    expected = "points of KITTI's lidar: x, y, z and a reflectance in [0, 1] as float32"
    hint = "For other points, save them in the left camera's frame as .npy, (N, 3) metres."
    if not data or len(data) % (COLUMNS * NUMBER.itemsize):
        bad_value(name, expected, f"{file} of {len(data)} bytes", hint)
    rows = np.frombuffer(data, NUMBER).reshape(-1, COLUMNS).astype(np.float64)
    if not np.isfinite(rows).all() or rows[:, 3].min() < 0 or rows[:, 3].max() > 1:
        bad_value(name, expected, f"{file} with other numbers", hint)
    return rows[:, :3]


def _rectified_from_lidar(file: Path, text: str) -> np.ndarray:
    """Return ``(4, 4)`` from the lidar's frame to the rectified camera 0."""
    entries = dict(ENTRY.findall(text))
    if RECTIFIED in entries:
        return rigid(entries[RECTIFIED].split(), RECTIFIED)
    unrectified = next((key for key in UNRECTIFIED if key in entries), None)
    pose_file = file.parent / OF_LIDAR
    if unrectified is not None:
        T = rigid(entries[unrectified].split(), unrectified)
    elif pose_file.is_file():
        of_lidar = dict(ENTRY.findall(read_text(pose_file, OF_LIDAR)))
        T = transform(of_lidar.get("R", "").split(), of_lidar.get("T", "").split(), OF_LIDAR)
    else:
        bad_value("calibration", "a calibration with the lidar's pose", f"{file} alone", HINT)
    rectifying = next((key for key in RECTIFYING if key in entries), None)
    if rectifying is None:
        bad_value("calibration", f"a file with {RECTIFYING[0]} or {RECTIFYING[1]}", f"{file} without", HINT)
    R = array_of(entries[rectifying].split(), (3, 3), rectifying)
    return transform(R, (0, 0, 0), rectifying) @ T
