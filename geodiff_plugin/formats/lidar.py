"""Points of KITTI's lidar (``velodyne/*.bin``), brought into the frame of the left camera.

Source: ``readme.txt`` of KITTI's raw data, object, tracking and odometry benchmarks; ``pykitti/raw.py`` and
``pykitti/odometry.py`` of utiasSTARS/pykitti.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import PathLike, check_file, read_text
from geodiff_plugin.formats.rigs import CameraChoice, array_of, reading_whole, rigid, transform
from geodiff_plugin.formats.stereo import left_projection_of_kitti

#: How a file of a lidar's points is recognised.
LIDAR_SUFFIX = ".bin"
#: x, y, z and reflectance, little-endian.
NUMBER = np.dtype("<f4")
COLUMNS = 4
#: The file of the lidar's pose beside ``calib_cam_to_cam.txt`` in raw data.
OF_LIDAR = "calib_velo_to_cam.txt"
ENTRY = re.compile(r"(?m)^\s*([A-Za-z]\w*)\s*:?[ \t]+(.*)$")
#: Names of the pose in the object and the tracking benchmark, whose camera 0 is not rectified yet.
UNRECTIFIED = ("Tr_velo_to_cam", "Tr_velo_cam")
#: Names of the rectifying rotation of camera 0, in raw data and in those benchmarks.
RECTIFYING = ("R_rect_00", "R0_rect", "R_rect")
#: The pose in the odometry benchmark, whose camera 0 is rectified.
RECTIFIED = "Tr"
CURE = (
    "Give KITTI's calibration with the lidar's pose: calib_cam_to_cam.txt with calib_velo_to_cam.txt beside "
    "it, or the file of the object, tracking or odometry benchmark. Else take the points to the left "
    "camera's frame and save them as .npy."
)


def read_lidar(
    path: PathLike,
    calibration: Sequence[PathLike],
    cameras: tuple[int, int] | None = None,
    image_folder_hint: str | None = None,
    name: str = "points",
) -> np.ndarray:
    """The points ``(N, 3)`` float32 metres before the left camera, in its rectified frame.

    Args:
        path: ``velodyne_points/data/*.bin``: x, y, z and reflectance of each point, in the lidar's frame.
        calibration: the files of ``read_calibration``, of which KITTI has one.
        cameras: as in ``read_calibration``, by which the left camera is chosen.
        image_folder_hint: likewise.
        name: what messages call the points.

    Raises:
        InputError: a file of other points, or a calibration that does not say where the lidar is.
    """
    points = _scan(check_file(path, name, "a file of known depths"), name)
    if len(calibration) != 1:
        bad_value(name, "points of the left camera, or of KITTI's lidar with its calibration", path, CURE)
    file = Path(calibration[0])
    with reading_whole(file, "calibration of KITTI"):
        text = read_text(file, "calibration")
        projection = left_projection_of_kitti(text, CameraChoice(cameras, image_folder_hint))
        T = _rectified_from_lidar(file, text)
    place = np.linalg.solve(projection[:, :3], projection[:, 3])  # of camera 0 in the left camera's frame
    seen = points @ T[:3, :3].T + T[:3, 3] + place
    return seen[seen[:, 2] > 0].astype(np.float32)


def _scan(file: Path, name: str) -> np.ndarray:
    """``(N, 3)`` float64 in the lidar's frame."""
    data = file.read_bytes()
    expected = "points of KITTI's lidar: x, y, z and a reflectance in [0, 1] as float32"
    cure = "Points of another program: save them in the left camera's frame as .npy, (N, 3) metres."
    if not data or len(data) % (COLUMNS * NUMBER.itemsize):
        bad_value(name, expected, f"{file} of {len(data)} bytes", cure)
    rows = np.frombuffer(data, NUMBER).reshape(-1, COLUMNS).astype(np.float64)
    if not np.isfinite(rows).all() or rows[:, 3].min() < 0 or rows[:, 3].max() > 1:
        bad_value(name, expected, f"{file} of other numbers", cure)
    return rows[:, :3]


def _rectified_from_lidar(file: Path, text: str) -> np.ndarray:
    """``(4, 4)``, from the lidar's frame to that of the rectified camera 0."""
    entries = dict(ENTRY.findall(text))
    if RECTIFIED in entries:
        return rigid(entries[RECTIFIED].split(), RECTIFIED)
    unrectified = next((key for key in UNRECTIFIED if key in entries), None)
    beside = file.parent / OF_LIDAR
    if unrectified is not None:
        T = rigid(entries[unrectified].split(), unrectified)
    elif beside.is_file():
        of_lidar = dict(ENTRY.findall(read_text(beside, OF_LIDAR)))
        T = transform(of_lidar.get("R", "").split(), of_lidar.get("T", "").split(), OF_LIDAR)
    else:
        bad_value("calibration", "one that says where the lidar is", f"{file} alone", CURE)
    rectifying = next((key for key in RECTIFYING if key in entries), None)
    if rectifying is None:
        bad_value("calibration", f"one with {RECTIFYING[0]} or {RECTIFYING[1]}", f"{file} without", CURE)
    R = array_of(entries[rectifying].split(), (3, 3), rectifying)
    return transform(R, (0, 0, 0), rectifying) @ T
