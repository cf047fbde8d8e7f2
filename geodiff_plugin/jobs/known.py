"""Reads what is known about the scene before matching: depths, and the length of a line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.formats import (
    LIDAR_SUFFIX,
    depth_of_disparity,
    read_confidence,
    read_lidar,
    read_points,
    undistorted_points,
)
from geodiff_plugin.jobs.cameras import ViewCameras
from geodiff_plugin.jobs.options import DepthOptions


@dataclass(frozen=True, eq=False)
class KnownGeometry:
    """Known depths and lengths in the undistorted left image.

    Attributes:
        points: a map ``(H, W)`` of the left image in metres, or points ``(N, 3)`` in metres in the camera
            frame.
        points_confidence: confidence of the points in [0, 1], ``(H, W)`` or ``(N,)``.
        length: x1, y1, x2, y2 in pixels, and the 3D distance between the two points in metres.
    """

    points: np.ndarray | None = None
    points_confidence: np.ndarray | None = None
    length: tuple[float, ...] | None = None


def read_known(options: DepthOptions, cameras: ViewCameras) -> KnownGeometry:
    """Read ``--points``, ``--disparity``, ``--points-confidence`` and ``--known-length``.

    Raises:
        InputError: unreadable files, or files that do not match the left image.
    """
    confidence = None
    if options.points_confidence is not None:
        confidence = read_confidence(options.points_confidence, "--points-confidence")
    return KnownGeometry(_points(options, cameras), confidence, _length(options, cameras))


def _points(options: DepthOptions, cameras: ViewCameras) -> np.ndarray | None:
    if options.disparity is not None:
        return _points_of_disparity(options, options.disparity, cameras)
    if options.points is None:
        return None
    if options.points.suffix.lower() == LIDAR_SUFFIX:
        points = _points_of_lidar(options, options.points)
    else:
        points = read_points(options.points, "--points", scale=options.points_scale)
    camera = cameras.left
    if camera.lens is None or points.shape[1] == 3:
        return points
    assert camera.size is not None  # an image's camera has a size
    if points.shape[::-1] != camera.size:
        expected, got = ("{}x{}".format(*of) for of in (camera.size, points.shape[::-1]))
        hint = "A map must match the original left image pixel by pixel. Otherwise pass points (N, 3)."
        bad_value("--points", f"a map of the left image's {expected} pixels", got, hint)
    return undistorted_points(points, camera)


def _points_of_disparity(options: DepthOptions, path: Path, cameras: ViewCameras) -> np.ndarray:
    """Return the depth map ``(H, W)`` of a disparity map of the rectified rig."""
    if cameras.rig is None:
        raise_input_error(
            "--disparity needs a calibrated rectified rig and cannot be used with --estimate-pose."
        )
    size = cameras.left.size
    per_px = options.points_scale
    assert size is not None  # an image's camera has a size
    return depth_of_disparity(path, cameras.rig, size, "--disparity", per_px=per_px)


def _points_of_lidar(options: DepthOptions, path: Path) -> np.ndarray:
    """Return KITTI's lidar points ``(N, 3)`` in the left camera's frame, using the calibration of both."""
    if options.points_scale is not None:
        bad_value("--points-scale", "omitted for lidar points, which are in metres", options.points_scale)
    return read_lidar(path, options.calib, options.camera_pair(), str(options.left), "--points")


def _length(options: DepthOptions, cameras: ViewCameras) -> tuple[float, ...] | None:
    """Return ``X1,Y1,X2,Y2,METRES`` as given, with end points moved to the undistorted image."""
    if options.known_length is None:
        return None
    try:
        x1, y1, x2, y2, metres = (float(part) for part in options.known_length.split(","))
    except ValueError:  # not numbers, or not five of them
        hint = "Pass two pixels of LEFT and the 3D distance between them, such as 100,200,400,210,1.5."
        bad_value("--known-length", "X1,Y1,X2,Y2,METRES", repr(options.known_length), hint)
    return *cameras.left.undistorted_px(np.array([[x1, y1], [x2, y2]])).ravel().tolist(), metres
