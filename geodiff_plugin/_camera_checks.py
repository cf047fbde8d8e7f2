"""Checks of camera matrices and poses, and of images against them."""

from __future__ import annotations

from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_type, bad_value, refuse, warn
from geodiff_plugin.messages import Message

#: A longer baseline may be in millimetres.
LONG_BASELINE_M = 20.0
#: Known depths may be in millimetres if all of them are further than this.
FAR_POINTS_M = 100.0
#: A principal point this close to the border, as a share of the image, is rather that of another size.
NEAR_BORDER = 0.2
#: So is one that is this share of the image off the middle, in both directions, by nearly the same share.
OFF_MIDDLE = 0.12
#: The shares are nearly the same if they differ by less than this: few crops move both alike.
NEARLY_ALIKE = 0.08
#: Pixels are about square; a stretched image has them up to 16:9, and a mistyped digit beyond.
STRETCHED = 2.0
#: Focal length over width below which a lens without distortion would see more than 150 degrees.
NORMALISED = 0.134
SCALED_K = "with s = new size / old size take fx * s and (cx + 0.5) * s - 0.5, and likewise fy, cy"
POSE = "E is the 4x4 pose of the right camera in the left camera's frame, [[R, t], [0, 1]], t in metres."


def _as_matrix(value: Any, name: str, cure: str, *shapes: tuple[int, int]) -> np.ndarray:
    """A finite float64 matrix of one of the given shapes; messages name the first."""
    rows, columns = shapes[0]
    if hasattr(value, "detach"):
        value = value.detach().cpu().double().numpy()  # numpy has no bfloat16
    try:
        matrix = np.array(value, dtype=np.float64)  # a copy: the caller may go on to change theirs
    except (TypeError, ValueError, OverflowError):
        bad_type(name, f"a {rows}x{columns} matrix of numbers", value, cure)
    if matrix.shape not in shapes:
        bad_value(name, f"a {rows}x{columns} matrix", f"shape {matrix.shape}" if matrix.ndim else value, cure)
    if not np.isfinite(matrix).all():
        bad_value(name, "finite", "NaN or infinity in it", "Check the calibration file.")
    return matrix


def check_intrinsics(K: Any, name: str = "K") -> np.ndarray:
    """A ``(3, 3)`` float64 camera matrix in pixels, finite, fx and fy positive, last row (0, 0, 1)."""
    cure = "K is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of the image it comes with."
    K = _as_matrix(K, name, cure, (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        got = f"{K[0, 0]:g} and {K[1, 1]:g}"
        bad_value(f"{name}[0, 0] and {name}[1, 1] (fx, fy)", "positive focal lengths in pixels", got, cure)
    if not np.allclose(K[2], (0, 0, 1), atol=1e-6) or abs(K[1, 0]) > 1e-6:
        bad_value(name, "upper triangular with last row (0, 0, 1)", K.tolist(), cure)
    return K


def check_intrinsics_fit(K: np.ndarray, width: int, height: int, name: str, image: str) -> None:
    """Refuse a camera matrix whose principal point lies outside the image that it comes with."""
    cx, cy = K[0, 2], K[1, 2]
    if not (0 <= cx <= width and 0 <= cy <= height):
        refuse(
            f"{name} puts the principal point ({cx:.1f}, {cy:.1f}) outside {image} of {width}x{height} "
            f"pixels. It probably belongs to another resolution: {SCALED_K}. If the image is a crop, say so "
            "with cropped=True (--cropped)."
        )


def check_calibrated_size(
    size: tuple[int, int], calibrated: tuple[int, int] | None, name: str, source: object, cure: str
) -> None:
    """Refuse an image whose ``(width, height)`` differs from that of its calibration, if it has one."""
    if calibrated is not None and tuple(calibrated) != size:
        expected = "of {}x{} pixels, as {} says".format(*calibrated, source)
        bad_value(name, expected, "{}x{}".format(*size), cure)


def check_size_of(K: np.ndarray, size: tuple[int, int], name: str, image: str) -> None:
    """Refuse a camera matrix that cannot belong to an image ``(H, W)``, and warn of a doubtful one."""
    height, width = size
    if K[0, 0] < NORMALISED * width:
        cure = "Is it normalised? Multiply its first row by the width and its second by the height."
        bad_value(name, f"in pixels of {image} of {width}x{height}", f"fx {K[0, 0]:g}", cure)
    check_intrinsics_fit(K, width, height, name, image)
    x, y = K[0, 2] / width, K[1, 2] / height
    place = ""
    if min(x, y) < NEAR_BORDER or max(x, y) > 1.0 - NEAR_BORDER:
        place = f"near the border of {image} of {width}x{height} pixels"
    elif min(abs(x - 0.5), abs(y - 0.5)) > OFF_MIDDLE and abs(x - y) < NEARLY_ALIKE:
        place = f"where that of an image {x + y:.2g} times the size of {image} would be"
    if place:
        at = f"{name} has its principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) {place}"
        warn(Message("camera.principal-point", f"{at}. If it is for another resolution, {SCALED_K}."))
    if max(K[0, 0] / K[1, 1], K[1, 1] / K[0, 0]) > STRETCHED:
        numbers = f"{name} has fx {K[0, 0]:.5g} and fy {K[1, 1]:.5g}"
        sentence = f"{numbers}; pixels are about square, so one of them may be mistyped."
        warn(Message("camera.stretched", sentence))


def check_pose(E: Any, name: str = "E", cure: str = POSE) -> np.ndarray:
    """A ``(4, 4)`` float64 rigid transform; a rotation off by at most 1e-2 becomes the nearest one."""
    E = _as_matrix(E, name, cure, (4, 4), (3, 4))
    if len(E) == 3:
        E = np.vstack([E, (0.0, 0.0, 0.0, 1.0)])
    if not np.allclose(E[3], (0, 0, 0, 1), atol=1e-6):
        got = f"last row {E[3].tolist()}"
        bad_value(name, "rigid with last row (0, 0, 0, 1)", got, cure + " Is it transposed?")
    R = E[:3, :3]
    apart, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
    if apart > 1e-2 or determinant < 0:
        expected = "rigid: its upper left 3x3 a rotation (orthogonal within 1e-2, determinant +1)"
        got = f"determinant {determinant:.4f}, |R R^T - I| up to {apart:.4f}"
        bad_value(name, expected, got, cure)
    U, _, Vt = np.linalg.svd(R)
    E[:3, :3] = U @ Vt
    return E


def check_baseline(E: np.ndarray, name: str, unit: str | None) -> None:
    """Refuse a relative pose without translation, and warn of one that looks like millimetres."""
    baseline = float(np.linalg.norm(E[:3, 3]))
    if baseline < 1e-6:
        expected = "a pose whose camera centre differs from the left one's (a baseline)"
        cure = "Without it two views do not tell the scale; give the distance between the cameras in metres."
        bad_value(name, expected, f"a translation of {baseline:.1g} m", cure)
    if unit == "m" and baseline > LONG_BASELINE_M:
        cure = "divide its translation, or baseline_m (--baseline, --metres-per-unit), by 1000."
        sentence = f"{name} has a baseline of {baseline:.4g} m. If that is millimetres, {cure}"
        warn(Message("baseline.long", sentence))


def check_metres(array: np.ndarray, name: str, got: str = "") -> None:
    """Refuse integers, which are a file's own unit, or metres without their fraction."""
    if array.dtype.kind == "f":
        return
    cure = "Divide the file's integers by its factor: 1000 for millimetres, 256 for KITTI."
    if array.shape[1] == 3:
        cure = "Divide millimetres by 1000; metres lose their fraction as integers: keep them floats."
    bad_value(name, "metres as floats", got or f"dtype {array.dtype}", cure)


def warn_of_far_points(points: np.ndarray, name: str) -> None:
    """Warn of known depths that look like millimetres; in the forms of ``points_to_matches``."""
    depths = points[..., 0] if points.ndim == 3 else points[:, 2] if points.shape[1] in (3, 4) else points
    depths = depths[np.isfinite(depths) & (depths > 0)]
    if not len(depths):
        return
    whole = np.median(depths) > FAR_POINTS_M and (depths == np.rint(depths)).all()
    if whole or depths.min() > FAR_POINTS_M:
        kind = "only whole numbers" if whole else "none nearer"
        cure = "divide them by 1000, or give --points-scale 1000 (scale=1000) with a file."
        depths_are = f"{name} has depths of {depths.min():.4g} m and more, {kind}"
        warn(Message("points.far", f"{depths_are}. If they are millimetres, {cure}"))
