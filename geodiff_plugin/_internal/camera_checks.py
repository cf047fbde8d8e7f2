"""Check camera matrices and poses, and whether images fit them."""

from __future__ import annotations

from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_type, bad_value, check_size, raise_input_error, warn
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.findings import Finding

#: A longer baseline may be in millimetres.
LONG_BASELINE_M = 20.0
#: Known depths may be in millimetres if all of them are farther than this.
FAR_POINTS_M = 100.0
#: Distance from the border, as a fraction of the image, below which a principal point suggests another size.
NEAR_BORDER = 0.2
#: Offset from the centre in both directions, as a fraction of the image, above which a principal point
#: suggests another size, if both offsets are similar.
OFF_MIDDLE = 0.12
#: Maximum difference of the two offsets, because few crops shift both coordinates by the same fraction.
NEARLY_ALIKE = 0.08
#: Maximum ratio of fx and fy. Pixels are about square; stretched images reach 16:9, and mistyped digits more.
MAX_ASPECT_RATIO = 2.0
#: Focal length over width below which a lens without distortion would have a field of view above 150 degrees.
NORMALISED = 0.134
#: How to scale K to another image size.
SCALED_K = (
    "scale it: with s = new size / old size, use fx * s and (cx + 0.5) * s - 0.5, and likewise for fy and cy"
)
#: Hint that defines E.
POSE = "E is the 4x4 pose of the right camera in the left camera's frame, [[R, t], [0, 1]], t in metres."


def _as_matrix(value: Any, name: str, hint: str, *shapes: tuple[int, int]) -> np.ndarray:
    """Convert a value to a finite float64 matrix of one of the shapes. Messages name the first shape."""
    rows, columns = shapes[0]
    if hasattr(value, "detach"):
        value = value.detach().cpu().double().numpy()  # NumPy has no bfloat16
    try:
        matrix = np.array(value, dtype=np.float64)  # a copy, because the caller may modify the original
    except (TypeError, ValueError, OverflowError):
        bad_type(name, f"a {rows}x{columns} matrix of numbers", value, hint)
    if matrix.shape not in shapes:
        bad_value(name, f"a {rows}x{columns} matrix", f"shape {matrix.shape}" if matrix.ndim else value, hint)
    if not np.isfinite(matrix).all():
        bad_value(name, "finite", "NaN or infinity", "Check the calibration file.")
    return matrix


def check_intrinsics(K: Any, name: str = "K") -> np.ndarray:
    """Check a camera matrix in pixels: finite, positive fx and fy, last row (0, 0, 1); returns ``(3, 3)``."""
    hint = "K is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of its image."
    K = _as_matrix(K, name, hint, (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        got = f"{K[0, 0]:g} and {K[1, 1]:g}"
        bad_value(f"{name}[0, 0] and {name}[1, 1] (fx, fy)", "positive focal lengths in pixels", got, hint)
    if not np.allclose(K[2], (0, 0, 1), atol=1e-6) or abs(K[1, 0]) > 1e-6:
        bad_value(name, "upper triangular with last row (0, 0, 1)", K.tolist(), hint)
    return K


def check_intrinsics_fit(K: np.ndarray, width: int, height: int, name: str, image: str) -> None:
    """Raise an error if the principal point is outside the image."""
    cx, cy = K[0, 2], K[1, 2]
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise_input_error(
            f"{name} has its principal point at ({cx:.1f}, {cy:.1f}), outside {image} ({width}x{height} "
            f"pixels). If {name} is for a different resolution, {SCALED_K}. If the image is a crop, set "
            "cropped=True (--cropped).",
            code="camera.principal-point",
        )


def check_calibrated_size(
    size: tuple[int, int], calibrated: tuple[int, int] | None, name: str, source: object, hint: str
) -> None:
    """Raise an error if an image's ``(width, height)`` differs from the calibrated size, if known."""
    if calibrated is not None and tuple(calibrated) != size:
        expected = "{}x{} pixels, as in {}".format(*calibrated, source)
        bad_value(name, expected, "{}x{}".format(*size), hint, code="calibration.size")


def check_size_of(K: np.ndarray, size: tuple[int, int], name: str, image: str) -> None:
    """Raise an error if a camera matrix cannot belong to an image ``(H, W)``; warn if it is implausible."""
    height, width = size
    _check_focal_unit(K, width, height, name, image)
    check_intrinsics_fit(K, width, height, name, image)
    _warn_of_principal_point(K, width, height, name, image)
    _warn_of_aspect_ratio(K, name)


def _check_focal_unit(K: np.ndarray, width: int, height: int, name: str, image: str) -> None:
    """Raise an error if fx is so short that it can only be in another unit than pixels."""
    if K[0, 0] < NORMALISED * width:
        hint = (
            "If fx is in millimetres, multiply it by image width / sensor width, with the sensor width in "
            "millimetres (36 for a 35 mm equivalent, as in EXIF). If K is normalised by the image size, "
            "multiply its first row by the width and its second row by the height."
        )
        expected = f"in pixels of {image} ({width}x{height})"
        bad_value(name, expected, f"fx = {K[0, 0]:g}", hint, code="camera.focal-unit")


def _warn_of_principal_point(K: np.ndarray, width: int, height: int, name: str, image: str) -> None:
    """Warn if the principal point suggests that a camera matrix is for an image of another size."""
    cx, cy = K[0, 2], K[1, 2]
    x, y = cx / width, cy / height
    is_near_border = min(x, y) < NEAR_BORDER or max(x, y) > 1.0 - NEAR_BORDER
    is_scaled = min(abs(x - 0.5), abs(y - 0.5)) > OFF_MIDDLE and abs(x - y) < NEARLY_ALIKE
    if is_near_border:
        place = f"near the border of {image} ({width}x{height} pixels)"
    elif is_scaled:
        place = f"where it would be in an image {x + y:.2g} times the size of {image}"
    else:
        return
    sentence = f"{name} has its principal point at ({cx:.1f}, {cy:.1f}), {place}."
    warn(
        Finding("camera.principal-point", f"{sentence} If {name} is for a different resolution, {SCALED_K}.")
    )


def _warn_of_aspect_ratio(K: np.ndarray, name: str) -> None:
    """Warn if pixels are far from square."""
    if max(K[0, 0] / K[1, 1], K[1, 1] / K[0, 0]) > MAX_ASPECT_RATIO:
        numbers = f"{name} has fx {K[0, 0]:.5g} and fy {K[1, 1]:.5g}"
        message = f"{numbers}, but pixels are usually square. Check both focal lengths."
        warn(Finding("camera.aspect-ratio", message))


def check_pose(E: Any, name: str = "E", hint: str = POSE) -> np.ndarray:
    """Check a rigid transform and return it as ``(4, 4)`` float64 with the nearest exact rotation."""
    E = _as_matrix(E, name, hint, (4, 4), (3, 4))
    if len(E) == 3:
        E = np.vstack([E, (0.0, 0.0, 0.0, 1.0)])
    if not np.allclose(E[3], (0, 0, 0, 1), atol=1e-6):
        got = f"last row {E[3].tolist()}"
        bad_value(name, "rigid with last row (0, 0, 0, 1)", got, hint + " Is it transposed?")
    R = E[:3, :3]
    deviation = np.abs(R @ R.T - np.eye(3)).max()
    determinant = np.linalg.det(R)
    if deviation > 1e-2 or determinant < 0:
        expected = "rigid, with a rotation as upper left 3x3 (orthogonal within 1e-2, determinant +1)"
        got = f"determinant {determinant:.4f}, |R R^T - I| up to {deviation:.4f}"
        bad_value(name, expected, got, hint)
    U, _, Vt = np.linalg.svd(R)
    E[:3, :3] = U @ Vt
    return E


def check_posed_camera(K: Any, E: Any, size: Any, name: str = "reproject") -> PosedCamera:
    """Check a further camera with its pose in the left camera's frame; ``size`` is ``(width, height)``."""
    if size is None:
        bad_type(f"{name}: size", "a pair (width, height)", size)
    pose = "E is the 4x4 pose of that camera in the left camera's frame, [[R, t], [0, 1]]."
    width_height, K = check_size(size, f"{name}: size"), check_intrinsics(K, f"{name}: K")
    assert width_height is not None
    return PosedCamera(K, width_height, E=check_pose(E, f"{name}: E", pose))


def check_baseline(E: np.ndarray, name: str, unit: str | None) -> None:
    """Raise an error for a relative pose without translation; warn if it looks like millimetres."""
    baseline = float(np.linalg.norm(E[:3, 3]))
    if baseline < 1e-6:
        expected = "a pose with a baseline (a camera centre that differs from the left camera's)"
        hint = "Two views without a baseline have no parallax; pass the baseline in metres."
        bad_value(name, expected, f"a translation of {baseline:.1g} m", hint, code="calibration.no-baseline")
    if unit == "m" and baseline > LONG_BASELINE_M:
        hint = "divide its translation, or baseline_m (--baseline, --metres-per-unit), by 1000."
        message = f"{name} has an implausible baseline of {baseline:.4g} m. If it is in millimetres, {hint}"
        warn(Finding("baseline.long", message))


def check_metres(array: np.ndarray, name: str, got: str = "") -> None:
    """Raise an error for integers, which are in a file's own unit or are truncated metres."""
    if array.dtype.kind == "f":
        return
    hint = "Divide integers by the number of units per metre: 1000 for millimetres, 256 for KITTI."
    if array.shape[1] == 3:
        hint = "Divide millimetres by 1000. Metres as integers are truncated: pass floats."
    bad_value(name, "metres as floats", got or f"dtype {array.dtype}", hint)


def warn_of_far_points(points: np.ndarray, name: str) -> None:
    """Warn if known depths, in any form accepted by ``points_to_matches``, look like millimetres."""
    depths = points[..., 0] if points.ndim == 3 else points[:, 2] if points.shape[1] in (3, 4) else points
    depths = depths[np.isfinite(depths) & (depths > 0)]
    if not len(depths):
        return
    whole = np.median(depths) > FAR_POINTS_M and (depths == np.rint(depths)).all()
    if whole or depths.min() > FAR_POINTS_M:
        kind = ", all of them integers" if whole else ""
        hint = "divide them by 1000, or for a file set --points-scale 1000 (scale=1000)."
        depths_are = f"{name} has depths of at least {depths.min():.4g} m{kind}"
        warn(Finding("points.far", f"{depths_are}. If they are in millimetres, {hint}"))
