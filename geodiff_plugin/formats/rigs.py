"""Checked ``Rig`` records from the numbers of a calibration file.

Data flow: camera matrices, projections, world-to-camera transforms, baselines -> ``Rig``.
Paper: S3.3; E as in docs/reference/calibration.md.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._camera_checks import check_intrinsics
from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.geometry import nearest_rotation
from geodiff_plugin.types import Distortion, Rig

__all__ = [
    "check_no_distortion",
    "finite",
    "check_rigid",
    "intrinsics",
    "is_distorted",
    "make_rig",
    "pose_from_projections",
    "pose_from_world_to_camera",
    "pose_to_the_right",
    "positive",
    "rig_from_parameters",
    "whole_pixels",
]

#: Coefficients below this move no pixel of a 12 megapixel image by a tenth of a pixel.
DISTORTION_TOLERANCE = 1e-6
#: How far a file's rotation may be from orthogonal; what is left is rounding in print.
ROTATION_TOLERANCE = 1e-2


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """The ``(3, 3)`` float64 camera matrix of four numbers in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=np.float64)


def positive(value: Any, name: str) -> float:
    """A finite number above 0, as float.

    Raises:
        ValueError: it is not.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):  # a whole number of any length is JSON
        bad_value(name, "a number above 0", repr(value))
    if not (np.isfinite(number) and number > 0):
        bad_value(name, "a finite number above 0", number, "Check the calibration file.")
    return number


def whole_pixels(value: Any, name: str) -> int:
    """A side of an image, as int; ``640.0`` is one too.

    Raises:
        ValueError: it is not a whole number above 0.
    """
    try:
        number = 0.0 if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = 0.0
    if not number >= 1 or number % 1 != 0:  # infinity % 1 is NaN
        cure = "The images are checked against it; leave out both sides where they are not known."
        bad_value(name, "a whole number of pixels above 0", "none" if value is None else repr(value), cure)
    return int(number)


def finite(value: Any, name: str) -> float:
    """A finite number, as float; text is none.

    Raises:
        ValueError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        bad_value(name, "a number", repr(value))
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        bad_value(name, "a finite number", repr(value), "Check the calibration file.")
    return number


def check_rigid(T: np.ndarray, name: str) -> np.ndarray:
    """A ``(4, 4)`` float64 transform with its rotation projected to the nearest one.

    Raises:
        ValueError: not finite, last row not (0, 0, 0, 1), mirrored, or not orthogonal within 1e-2.
    """
    T = np.asarray(T, dtype=np.float64)
    if not np.isfinite(T).all():
        bad_value(name, "finite", "NaN or infinity in it", "Check the calibration file.")
    if not np.allclose(T[3], (0, 0, 0, 1), atol=1e-6):
        bad_value(
            name, "a rigid transform with last row 0 0 0 1", f"last row {T[3].tolist()}", "Is it transposed?"
        )
    R = T[:3, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        bad_value(
            name,
            f"a rigid transform, its upper left 3x3 a rotation (within {ROTATION_TOLERANCE})",
            f"determinant {np.linalg.det(R):.4f}, |R R^T - I| up to {off:.4f}",
            "Check that rows and columns are not swapped and that no scale is multiplied in.",
        )
    T = T.copy()
    T[:3, :3] = nearest_rotation(torch.from_numpy(R.copy())).numpy()
    return T


def is_distorted(lens: Distortion | None) -> bool:
    """Whether a lens moves any pixel; a fisheye does with coefficients of zero as well."""
    if lens is None:
        return False
    return lens.model == "fisheye" or np.abs(lens.coefficients).max(initial=0.0) > DISTORTION_TOLERANCE


def check_no_distortion(lens: Distortion | None, name: str) -> None:
    """Refuse lens distortion: every formula here is of a pinhole camera.

    Raises:
        ValueError: a lens that moves pixels.
    """
    if lens is None or not is_distorted(lens):
        return
    numbers = np.array2string(lens.coefficients, precision=4, separator=", ")
    bad_value(
        name,
        "zero (images of a pinhole camera)",
        f"fisheye {numbers}" if lens.model == "fisheye" else numbers,
        "Undistort or rectify both images first (OpenCV: stereoRectify, initUndistortRectifyMap, remap) "
        "and give the calibration of the result (P1, P2), or use geodiff depth, which undistorts them.",
    )


def pose_to_the_right(baseline_m: float) -> np.ndarray:
    """E of a right camera ``baseline_m`` metres to the right: ``E[0, 3] == +baseline_m``."""
    E = np.eye(4)
    E[0, 3] = baseline_m
    return E


def pose_from_projections(P_left: np.ndarray, P_right: np.ndarray, source: str | Path) -> np.ndarray:
    """E of two rectified ``(3, 4)`` projections ``K [I | t]`` that share one frame.

    A camera with ``K [I | t]`` has its centre at ``-t``, so E's translation is ``t_left - t_right``.

    Raises:
        ValueError: a left 3x3 part that is no camera matrix, naming the file ``source``.
    """
    t_left, t_right = (
        np.linalg.solve(check_intrinsics(P[:, :3], f"K of the {side} camera in {source}"), P[:, 3])
        for side, P in (("left", P_left), ("right", P_right))
    )
    E = np.eye(4)
    E[:3, 3] = t_left - t_right
    return E


def pose_from_world_to_camera(T_left_from_world: np.ndarray, T_right_from_world: np.ndarray) -> np.ndarray:
    """E of two world-to-camera transforms: ``T_left_from_right``."""
    return T_left_from_world @ np.linalg.inv(T_right_from_world)


def make_rig(
    K_left: np.ndarray,
    K_right: np.ndarray,
    E: np.ndarray,
    source: str | Path,
    *,
    size: tuple[int, int] | None = None,
    size_right: tuple[int, int] | None = None,
    distortion: tuple[Distortion | None, Distortion | None] = (None, None),
    rectified: bool = False,
) -> Rig:
    """A ``Rig`` whose numbers are finite and whose matrices have the right form.

    Args:
        K_left: ``(3, 3)`` pixels.
        K_right: ``(3, 3)`` pixels.
        E: ``(4, 4)`` metres, pose of the right camera in the left camera's frame.
        source: the file.
        size: ``(width, height)`` of the left image, and of the right one unless ``size_right`` is given.
        size_right: ``(width, height)`` of the right image.
        distortion: of both lenses.
        rectified: whether the file says that its images are rectified.

    Raises:
        ValueError: a matrix that is none, naming the file.
    """
    if not np.isfinite(E).all():
        bad_value(f"the pose in {source}", "finite", "NaN or infinity in it", "Check the calibration file.")
    return Rig(
        K_left=check_intrinsics(K_left, f"K of the left camera in {source}"),
        K_right=check_intrinsics(K_right, f"K of the right camera in {source}"),
        E=np.asarray(E, dtype=np.float64),
        size_left=size,
        size_right=size if size_right is None else size_right,
        source=str(source),
        distortion=distortion,
        rectified=rectified,
    )


def rig_from_parameters(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    baseline_m: float,
    *,
    cx_right: float | None = None,
    size: tuple[int, int] | None = None,
) -> Rig:
    """A rectified rig from the numbers that a data sheet gives.

    Args:
        fx: focal length in pixels, > 0.
        fy: focal length in pixels, > 0.
        cx: principal point of the left image, pixels, centre of the first pixel at 0.
        cy: likewise, both images.
        baseline_m: distance of the cameras in metres, > 0; the right one stands to the right.
        cx_right: principal point of the right image; ``None`` means ``cx`` (no ``doffs``).
        size: ``(width, height)`` that these belong to, where known.

    Raises:
        TypeError, ValueError: not finite numbers, or not above 0 where they must be.
    """
    tiny = float(np.finfo(np.float64).tiny)
    for name, value in (("fx", fx), ("fy", fy), ("baseline", baseline_m)):
        check_number(value, name, tiny, np.finfo(np.float64).max)
    for name, value in (("cx", cx), ("cy", cy), ("cx_right", cx if cx_right is None else cx_right)):
        check_number(value, name, -1e9, 1e9)
    K_left = intrinsics(fx, fy, cx, cy)
    K_right = intrinsics(fx, fy, cx if cx_right is None else cx_right, cy)
    return make_rig(K_left, K_right, pose_to_the_right(float(baseline_m)), "arguments", size=size)
