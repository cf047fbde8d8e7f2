"""OpenCV's stereo calibration as its samples write it, YAML, XML or JSON, in one file or two.

Data flow: ``P1 P2`` (rectified), else ``M1 D1 M2 D2 R T`` -> ``Rig``.
Paper: none; R, T of ``stereoCalibrate`` map left points to right ones.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.euroc import MARK as EUROC_MARK
from geodiff_plugin.formats.lenses import lens_of
from geodiff_plugin.formats.opencv_storage import is_storage, parse_storage
from geodiff_plugin.formats.orb_slam import matches as is_orb_slam
from geodiff_plugin.formats.rigs import check_rigid, make_rig, pose_from_projections
from geodiff_plugin.types import Distortion, Rig

__all__ = ["OPENCV", "matches", "read"]

#: How a camera is told in a name, behind its word or (where it is a whole word) before it.
LEFT, RIGHT = ("1", "l", "left"), ("2", "r", "right")
K_WORDS = ("m", "k", "mtx", "cameramatrix", "intrinsic", "intrinsics", "intrinsicmatrix")
D_WORDS = (
    *("d", "dis", "dist", "distcoef", "distcoefs", "distcoeff", "distcoeffs", "distort", "distortion"),
    *("distortioncoefficients", "distortioncoeffs"),
)
P_WORDS = ("p", "projection", "projectionmatrix", "projmat", "projmatrix")


def _of(words: tuple[str, ...], camera: tuple[str, ...]) -> frozenset[str]:
    behind = {word + side for word in words for side in camera}
    return frozenset(behind | {camera[-1] + word for word in words})


#: Name in OpenCV's samples -> names in use for the same thing, in small letters without "_" and ".": the
#: arguments of stereoCalibrate, what tutorials call them, ORB-SLAM's ``LEFT.P``.
NAMES = {
    "M1": _of(K_WORDS, LEFT),
    "M2": _of(K_WORDS, RIGHT),
    "D1": _of(D_WORDS, LEFT),
    "D2": _of(D_WORDS, RIGHT),
    "P1": _of(P_WORDS, LEFT),
    "P2": _of(P_WORDS, RIGHT),
    "R": frozenset({"r", "rot", "rotation", "rotationmatrix"}),
    "T": frozenset({"t", "trans", "translation", "translationmatrix", "translationvector"}),
    "image_size": frozenset({"imagesize", "imgres", "imgsize", "size"}),
    "image_width": frozenset({"imagewidth", "leftwidth"}),
    "image_height": frozenset({"imageheight", "leftheight"}),
}
#: Those that are one number; what else is a number, such as a coefficient ``k1``, is none of the matrices.
NUMBERS = ("image_width", "image_height")


def matches(text: str, path: Path) -> bool:
    """Whether it is written as OpenCV does and no other program's."""
    others = "proj_matL" in text or EUROC_MARK.search(text) is not None or is_orb_slam(text, path)
    return is_storage(text) and not others


def _plain(key: str) -> str:
    return key.replace("_", "").replace(".", "")


def _can_be(name: str, value: np.ndarray) -> bool:
    return value.size == 1 if name in NUMBERS else value.shape != (1,)  # a matrix has two axes


def _named(entries: dict[str, np.ndarray], source: str) -> dict[str, np.ndarray]:
    """What ``NAMES`` knows of the entries, by its names; entries that differ under one name are refused."""
    found: dict[str, np.ndarray] = {}
    for name, names in NAMES.items():
        own = [key for key, value in entries.items() if _plain(key) in names and _can_be(name, value)]
        if any(not np.array_equal(entries[key].ravel(), entries[own[0]].ravel()) for key in own[1:]):
            cure = "Keep those that belong to R and T."
            bad_value(f"{name} in {source}", "there once", f"{', '.join(own)}, which differ", cure)
        found |= {name: entries[own[0]]} if own else {}
    return found


def _lens(named: dict[str, np.ndarray], name: str, side: str, source: str) -> Distortion | None:
    if name not in named:
        return None
    return lens_of(named[name], f"Lens distortion of the {side} camera in {source}")


def _check_no_other_lens(entries: dict[str, np.ndarray], named: dict[str, np.ndarray], source: str) -> None:
    """Refuse a lens distortion whose name is not known: without it the images would pass for a pinhole's."""
    known = NAMES["D1"] | NAMES["D2"]
    others = [
        key
        for key, value in entries.items()
        if "dist" in key and _plain(key) not in known and _can_be("D1", value)
    ]
    if others and not {"D1", "D2"} <= named.keys():
        bad_value(
            source,
            "an OpenCV calibration with its lens distortion as D1, D2",
            ", ".join(others),
            "Rename what is lens distortion to D1 and D2, and what is not.",
        )


def _warn_of_one_lens(
    named: dict[str, np.ndarray], lenses: tuple[Distortion | None, Distortion | None], source: str
) -> None:
    """Warn of distortion that is there for one camera alone: two lenses of a rig are rarely that unlike."""
    if lenses == (None, None) or {"D1", "D2"} <= named.keys():
        return
    there, missing, side = ("D1", "D2", "right") if "D1" in named else ("D2", "D1", "left")
    warnings.warn(
        f"{source} has the lens distortion {there} and no {missing}: the {side} image is taken for one "
        f"without distortion. Add {missing} to the file, zeros if that lens has none.",
        stacklevel=3,
    )


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


def _size(named: dict[str, np.ndarray]) -> tuple[int, int] | None:
    pair = named.get("image_size")
    if pair is None and {"image_width", "image_height"} <= named.keys():
        pair = np.concatenate([named["image_width"].ravel(), named["image_height"].ravel()])
    if pair is None or pair.size != 2 or not (np.isfinite(pair).all() and (pair > 0).all()):
        return None
    width, height = (int(v) for v in pair.ravel())
    return width, height


def _check_shape(matrix: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    if matrix.shape != shape:
        bad_value(name, f"of shape {shape}", f"{matrix.shape}", "Was this file written by stereoRectify?")
    return matrix


def _rectified(named: dict[str, np.ndarray], source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    P_left, P_right = (_check_shape(named[key], (3, 4), f"{key} in {source}") for key in ("P1", "P2"))
    return P_left[:, :3], P_right[:, :3], pose_from_projections(P_left, P_right, source)


def _as_taken(named: dict[str, np.ndarray], source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    missing = [name for name in ("M1", "M2", "R", "T") if name not in named]
    if missing:
        bad_value(
            source,
            "an OpenCV calibration with P1, P2, or with M1, M2, R, T",
            f"no {', '.join(missing)}",
            "Where intrinsics and extrinsics are two files, give both; rename what has other names.",
        )
    K_left, K_right, R = (
        _check_shape(named[name], (3, 3), f"{name} in {source}") for name in ("M1", "M2", "R")
    )
    T_right_from_left = np.eye(4)
    T_right_from_left[:3, :3] = R
    T_right_from_left[:3, 3] = _check_shape(named["T"].ravel(), (3,), f"T in {source}")
    return K_left, K_right, np.linalg.inv(check_rigid(T_right_from_left, f"R, T in {source}"))


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one file, or of ``intrinsics`` and ``extrinsics`` in any order.

    ``P1, P2`` stand for the rectified images and come first, whatever the lens distortion before them was.
    Without them ``M1, M2, R, T`` are taken, with the distortion ``D1, D2`` of OpenCV's model. Lengths are
    taken as metres: OpenCV keeps the unit of the chessboard's squares, and the file does not say it.
    ``NAMES`` has what else they may be called.

    Raises:
        ValueError: neither set is there, a matrix is malformed or there twice and different, D has a count
            that OpenCV has not or a name that is not known.
    """
    entries, source = _merged(files), " and ".join(str(file.path) for file in files)
    named = _named(entries, source)
    if {"P1", "P2"} <= named.keys():
        return make_rig(*_rectified(named, source), source, size=_size(named), rectified=True)
    cameras = _as_taken(named, source)
    _check_no_other_lens(entries, named, source)
    lenses = (_lens(named, "D1", "left", source), _lens(named, "D2", "right", source))
    _warn_of_one_lens(named, lenses, source)
    return make_rig(*cameras, source, size=_size(named), distortion=lenses)


OPENCV = CalibrationFormat(
    "OpenCV stereoRectify YAML, XML or JSON (P1, P2, or M1, M2, R, T)", matches, read, file_counts=(1, 2)
)
