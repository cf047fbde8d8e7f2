"""OpenCV's stereo calibration as its samples write it, YAML, XML or JSON, in one file or two.

Data flow: ``P1 P2`` (rectified), else ``M1 D1 M2 D2 R T`` -> ``Rig``.
Paper: none; R, T of ``stereoCalibrate`` map left points to right ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.lenses import lens_of
from geodiff_plugin.formats.opencv_storage import is_storage, parse_storage
from geodiff_plugin.formats.rigs import check_rigid, make_rig, pose_from_projections
from geodiff_plugin.types import Distortion, Rig

__all__ = ["OPENCV", "matches", "read"]

#: Names in use for the same thing: OpenCV's samples first, then the arguments of stereoCalibrate.
LEFT_K, RIGHT_K = ("m1", "k1", "cameramatrix1"), ("m2", "k2", "cameramatrix2")
LEFT_D, RIGHT_D = ("d1", "distcoeffs1"), ("d2", "distcoeffs2")
SIZE_KEYS = ("image_size", "imagesize", "img_res", "size")


def matches(text: str, path: Path) -> bool:
    """Whether OpenCV wrote it and it is not Booster's."""
    return is_storage(text) and "proj_matL" not in text


def _first(entries: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((entries[name] for name in names if name in entries), None)


def _lens(
    entries: dict[str, np.ndarray], names: tuple[str, ...], side: str, source: str
) -> Distortion | None:
    coefficients = _first(entries, names)
    name = f"Lens distortion of the {side} camera in {source}"
    return None if coefficients is None else lens_of(coefficients, name)


def _merged(files: tuple[CalibrationFile, ...]) -> dict[str, np.ndarray]:
    entries: dict[str, np.ndarray] = {}
    for file in files:
        new = parse_storage(file.text, file.path)
        clash = [key for key in new if key in entries and not np.array_equal(new[key], entries[key])]
        if clash:
            bad_value(
                f"{files[0].path} and {file.path}",
                "one calibration in two files (intrinsics.yml, extrinsics.yml)",
                f"different {', '.join(clash)}",
                "A pair of single-camera files has no baseline; give the file that stereoRectify wrote.",
            )
        entries.update(new)
    return entries


def _size(entries: dict[str, np.ndarray]) -> tuple[int, int] | None:
    pair = _first(entries, SIZE_KEYS)
    if pair is None and {"image_width", "image_height"} <= entries.keys():
        pair = np.concatenate([entries["image_width"], entries["image_height"]])
    if pair is None or pair.size != 2 or not (np.isfinite(pair).all() and (pair > 0).all()):
        return None
    width, height = (int(v) for v in pair.ravel())
    return width, height


def _check_shape(matrix: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    if matrix.shape != shape:
        bad_value(name, f"of shape {shape}", f"{matrix.shape}", "Was this file written by stereoRectify?")
    return matrix


def _rectified(entries: dict[str, np.ndarray], source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    P_left, P_right = (
        _check_shape(entries[key], (3, 4), f"{key.upper()} in {source}") for key in ("p1", "p2")
    )
    return P_left[:, :3], P_right[:, :3], pose_from_projections(P_left, P_right, source)


def _as_taken(entries: dict[str, np.ndarray], source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    K_left, K_right = _first(entries, LEFT_K), _first(entries, RIGHT_K)
    needed = {"M1": K_left, "M2": K_right, "R": entries.get("r"), "T": entries.get("t")}
    missing = [name for name, matrix in needed.items() if matrix is None]
    if K_left is None or K_right is None or missing:
        bad_value(
            source,
            "an OpenCV calibration with P1, P2, or with M1, M2, R, T",
            f"no {', '.join(missing)}",
            "Where intrinsics and extrinsics are two files, give both.",
        )
    for matrix, name in ((K_left, "M1"), (K_right, "M2"), (entries["r"], "R")):
        _check_shape(matrix, (3, 3), f"{name} in {source}")
    T_right_from_left = np.eye(4)
    T_right_from_left[:3, :3] = entries["r"]
    T_right_from_left[:3, 3] = _check_shape(entries["t"].ravel(), (3,), f"T in {source}")
    return K_left, K_right, np.linalg.inv(check_rigid(T_right_from_left, f"R, T in {source}"))


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one file, or of ``intrinsics`` and ``extrinsics`` in any order.

    ``P1, P2`` stand for the rectified images and come first, whatever the lens distortion before them was.
    Without them ``M1, M2, R, T`` are taken, with the distortion ``D1, D2`` of OpenCV's model. Lengths are
    taken as metres: OpenCV keeps the unit of the chessboard's squares, and the file does not say it.

    Raises:
        ValueError: neither set is there, a matrix is malformed, or D has a count that OpenCV has not.
    """
    entries, source = _merged(files), " and ".join(str(file.path) for file in files)
    if {"p1", "p2"} <= entries.keys():
        return make_rig(*_rectified(entries, source), source, size=_size(entries), rectified=True)
    lenses = (_lens(entries, LEFT_D, "left", source), _lens(entries, RIGHT_D, "right", source))
    return make_rig(*_as_taken(entries, source), source, size=_size(entries), distortion=lenses)


OPENCV = CalibrationFormat(
    "OpenCV stereoRectify YAML, XML or JSON (P1, P2, or M1, M2, R, T)", matches, read, file_counts=(1, 2)
)
