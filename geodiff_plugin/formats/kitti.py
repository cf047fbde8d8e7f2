"""KITTI (S5.1): ``calib_cam_to_cam`` and files of ``P0`` to ``P3``; velodyne scans as points."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import check_file, read_text
from geodiff_plugin.formats.rigs import (
    CalibrationFormat,
    CameraChoice,
    RawRig,
    array_of,
    projected,
    two_cameras,
)

__all__ = ["KITTI_CAM_TO_CAM", "KITTI_PROJECTIONS", "read_velodyne"]

ROW = re.compile(r"^\s*(\w+)\s*:(.*)$", re.MULTILINE)
RECTIFIED = re.compile(r"^\s*P_rect_(\d+)\s*:", re.MULTILINE)
# The number behind the colon keeps OpenCV's "P1: !!opencv-matrix" out.
PROJECTION = re.compile(r"^\s*P([0-3])\s*:\s*[-+.\d]", re.MULTILINE)
#: The grey pair and the colour pair.
PAIRS = ((0, 1), (2, 3))
#: Folder names of the benchmarks: image_2 and image_02, and colored_0 of KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")
WHICH = "it holds the grey pair 0,1 and the colour pair 2,3; taking 2,3. Give cameras (--cameras) to choose."
VELODYNE = "KITTI's calib/N.txt, or calib_velo_to_cam.txt together with calib_cam_to_cam.txt"
#: The left colour camera, which the benchmarks' left images are of.
CAMERA = 2


def _cameras(available: Collection[int], choice: CameraChoice) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Left and right camera, and a note where they were a guess.

    In this order: ``cameras`` as given; the pair that the image folder's name says, if the file has it; the
    only pair in the file; the colour pair, with a note, where the file has both.
    """
    if choice.cameras is not None:
        return two_cameras(choice, available), ()
    pairs = [pair for pair in PAIRS if set(pair) <= set(available)]
    for kind, camera in FOLDER.findall(choice.image_folder_hint or "")[-1:]:
        pair = PAIRS[kind == "colored" or int(camera) >= 2]
        if pair in pairs:
            return pair, ()
    if pairs:
        return pairs[-1], (WHICH,) if len(pairs) > 1 else ()
    have = sorted(available)
    if len(have) != 2:
        got = f"cameras {', '.join(map(str, have))}"
        bad_value("the file", "a calibration with two cameras", got, "Give cameras (--cameras).")
    return (have[0], have[1]), ()


def _read(text: str, numbers: Sequence[str], key: str, choice: CameraChoice) -> RawRig:
    rows = dict(ROW.findall(text))
    names = {int(digits): digits for digits in numbers}
    cameras, notes = _cameras(names, choice)
    P = [array_of(rows[key + names[camera]].split(), (3, 4), key + names[camera]) for camera in cameras]
    sizes = [rows.get(f"S_rect_{names[camera]}") for camera in cameras]
    raw = projected(*P, *(None if size is None else array_of(size.split(), (2,), "S_rect") for size in sizes))
    return RawRig(raw.left, raw.right, raw.pose, raw.rectified, notes)


KITTI_CAM_TO_CAM = CalibrationFormat(
    "KITTI calib_cam_to_cam (P_rect_02: ...)",
    lambda text: RECTIFIED.search(text) is not None,
    lambda texts, choice: _read(texts[0], RECTIFIED.findall(texts[0]), "P_rect_", choice),
    uses_cameras=True,
)
KITTI_PROJECTIONS = CalibrationFormat(
    "KITTI projections (P0: ... to P3: ...)",
    lambda text: PROJECTION.search(text) is not None,
    lambda texts, choice: _read(texts[0], PROJECTION.findall(texts[0]), "P", choice),
    uses_cameras=True,
)


def _velodyne_rows(paths: Sequence[str | os.PathLike[str]], name: str) -> dict[str, np.ndarray]:
    """Every ``key: numbers`` of the files; other lines are left out."""
    rows: dict[str, np.ndarray] = {}
    for path in paths:
        for key, words in ROW.findall(read_text(path, name, VELODYNE)):
            try:
                rows[key] = np.array([float(word) for word in words.split()])
            except ValueError:
                continue
    return rows


def _of_rows(
    rows: dict[str, np.ndarray], keys: tuple[str, ...], shape: tuple[int, int], name: str
) -> np.ndarray:
    """The first of the rows as a ``(4, 4)`` matrix."""
    row = next((rows[key] for key in keys if key in rows), None)
    if row is None or row.size != shape[0] * shape[1] or not np.isfinite(row).all():
        bad_value(name, VELODYNE, f"files without {' or '.join(keys)} of {shape[0] * shape[1]} numbers")
    matrix = np.eye(4)
    matrix[: shape[0], : shape[1]] = row.reshape(shape)
    return matrix


def _camera_from_velodyne(paths: Sequence[str | os.PathLike[str]], name: str) -> np.ndarray:
    """``(4, 4)``: from the scanner's frame to that of the rectified left colour camera."""
    rows = _velodyne_rows(paths, name)
    rectify = _of_rows(rows, ("R0_rect", "R_rect_00", "R_rect"), (3, 3), name)
    projection = _of_rows(rows, (f"P{CAMERA}", f"P_rect_0{CAMERA}"), (3, 4), name)
    if "R" in rows and "T" in rows:
        moved = _of_rows(rows, ("R",), (3, 3), name)
        moved[:3, 3] = _of_rows(rows, ("T",), (3, 1), name)[:3, 0]
    else:
        moved = _of_rows(rows, ("Tr_velo_to_cam", "Tr_velo_cam"), (3, 4), name)
    beside = np.eye(4)  # camera 2 stands beside camera 0, in whose frame the rest is
    try:
        beside[:3, 3] = np.linalg.solve(projection[:3, :3], projection[:3, 3])
    except np.linalg.LinAlgError:
        bad_value(name, VELODYNE, f"a P{CAMERA} that is no projection")
    return beside @ rectify @ moved


def read_velodyne(
    path: Path, calibration: Sequence[str | os.PathLike[str]], name: str = "points"
) -> np.ndarray:
    """A velodyne scan as points of the left colour camera.

    Args:
        path: ``.bin``, float32 x, y, z, reflectance.
        calibration: one file or two, see ``read_points``.
        name: the argument that ``path`` came in, for messages.

    Returns:
        ``(N, 3)`` metres; what lies behind the camera is left out.

    Raises:
        OSError, ValueError: no calibration, or one without the scanner's pose; not whole points.
    """
    if not calibration:
        cure = "The scanner has a frame of its own: x forward, y left, z up."
        bad_value(f"{name}-calib", f"given with a .bin ({VELODYNE})", "nothing", cure)
    for file in calibration:
        check_file(file, f"{name}-calib", "a calibration file")
    data = path.read_bytes()
    if len(data) % 16:
        expected = "a velodyne .bin of whole points (4 float32 each)"
        bad_value(name, expected, f"{path} of {len(data)} bytes", "Is it cut off?")
    scan = np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    T = _camera_from_velodyne(calibration, f"{name}-calib")
    points = scan @ T[:3, :3].T + T[:3, 3]
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]
    if not len(points):
        bad_value(name, "a scan with points before the camera", f"{path} with none")
    return points
