"""OpenCV's stereo calibration as its samples write it, YAML, XML or JSON, in one file or two."""

from __future__ import annotations

from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.kalibr import EUROC
from geodiff_plugin.formats.middlebury import BOOSTER
from geodiff_plugin.formats.orb_slam import ORB_SLAM
from geodiff_plugin.formats.rigs import CalibrationFormat, Camera, CameraChoice, RawRig, projected, rigid
from geodiff_plugin.formats.structured import is_storage, parse_storage

__all__ = ["OPENCV"]

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

Entries = dict[str, np.ndarray]


def _plain(key: str) -> str:
    return key.replace("_", "").replace(".", "")


def _can_be(name: str, value: np.ndarray) -> bool:
    return value.size == 1 if name in NUMBERS else value.shape != (1,)  # a matrix has two axes


def _named(entries: Entries) -> Entries:
    """What ``NAMES`` knows of the entries, by its names; entries that differ under one name are refused."""
    named: Entries = {}
    for name, names in NAMES.items():
        keys = [key for key, value in entries.items() if _plain(key) in names and _can_be(name, value)]
        if any(not np.array_equal(entries[key].ravel(), entries[keys[0]].ravel()) for key in keys[1:]):
            cure = "Keep those that belong to R and T."
            bad_value(name, "there once", f"{', '.join(keys)}, which differ", cure)
        if keys:
            named[name] = entries[keys[0]]
    return named


def _merged(texts: tuple[str, ...]) -> Entries:
    entries: Entries = {}
    for text in texts:
        new = {key: value for key, value in parse_storage(text).items() if isinstance(value, np.ndarray)}
        clash = [key for key in new if key in entries and not np.array_equal(new[key], entries[key])]
        if clash:
            expected = "one calibration in two files (intrinsics.yml, extrinsics.yml)"
            cure = "A pair of single-camera files has no baseline; give the file that stereoRectify wrote."
            bad_value("the files", expected, f"different {', '.join(clash)}", cure)
        entries.update(new)
    return entries


def _size(named: Entries) -> list[float] | None:
    pair = named.get("image_size")
    if pair is None and named.keys() >= set(NUMBERS):
        pair = np.concatenate([named[name].ravel() for name in NUMBERS])
    if pair is None or pair.size != 2 or not (np.isfinite(pair).all() and (pair >= 1).all()):
        return None
    return np.floor(pair.ravel()).tolist()


def _of_shape(named: Entries, name: str, *shapes: tuple[int, ...]) -> np.ndarray:
    if named[name].shape not in shapes:
        bad_value(
            name, f"of shape {shapes[0]}", f"{named[name].shape}", "Was this file written by stereoRectify?"
        )
    return named[name]


def _check_no_other_lens(entries: Entries, named: Entries) -> None:
    """Refuse a lens distortion whose name is not known: without it the images would pass for a pinhole's."""
    listed = NAMES["D1"] | NAMES["D2"]
    others = [
        key
        for key, value in entries.items()
        if "dist" in key and _plain(key) not in listed and _can_be("D1", value)
    ]
    if others and not named.keys() >= {"D1", "D2"}:
        cure = "Rename what is lens distortion to D1 and D2, and what is not."
        bad_value("the lens distortion", "called D1, D2", ", ".join(others), cure)


def _note_of_one_lens(lenses: list[Any]) -> tuple[str, ...]:
    """A note on distortion that is there for one camera alone: two lenses of a rig are rarely that unlike."""
    if (lenses[0] is None) == (lenses[1] is None) or not np.any(
        [lens for lens in lenses if lens is not None]
    ):
        return ()
    there, missing, side = ("D1", "D2", "right") if lenses[1] is None else ("D2", "D1", "left")
    return (
        f"it has the lens distortion {there} and no {missing}: the {side} image is taken for one without "
        f"distortion. Add {missing} to the file, zeros if that lens has none.",
    )


def _as_taken(entries: Entries, named: Entries) -> RawRig:
    missing = [name for name in ("M1", "M2", "R", "T") if name not in named]
    if missing:
        expected = "an OpenCV calibration with P1, P2, or with M1, M2, R, T"
        cure = "Where intrinsics and extrinsics are two files, give both; rename what has other names."
        bad_value("the file", expected, f"no {', '.join(missing)}", cure)
    K_left, K_right, R = (_of_shape(named, name, (3, 3)) for name in ("M1", "M2", "R"))
    T_right_from_left = np.eye(4)
    T_right_from_left[:3, :3] = R
    T_right_from_left[:3, 3] = _of_shape(named, "T", (3, 1), (1, 3), (3,)).ravel()
    _check_no_other_lens(entries, named)
    lenses, size = [named.get(name) for name in ("D1", "D2")], _size(named)
    left, right = (
        Camera(K, size, () if lens is None else lens.ravel())
        for K, lens in zip((K_left, K_right), lenses, strict=True)
    )
    E = np.linalg.inv(rigid(T_right_from_left, "R, T"))
    return RawRig(left, right, E, notes=_note_of_one_lens(lenses))


def _read(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """One file, or ``intrinsics`` and ``extrinsics`` in any order.

    ``P1, P2`` stand for the rectified images and come first, whatever the lens distortion before them was.
    Without them ``M1, M2, R, T`` are taken, with the distortion ``D1, D2`` of OpenCV's model; ``R, T`` take
    left points to right ones. Lengths are taken as metres: OpenCV keeps the unit of the chessboard's squares,
    and the file does not say it. ``NAMES`` has what else they may be called.
    """
    entries = _merged(texts)
    named = _named(entries)
    if named.keys() >= {"P1", "P2"}:
        P_left, P_right = (_of_shape(named, name, (3, 4)) for name in ("P1", "P2"))
        return projected(P_left, P_right, _size(named), _size(named))
    return _as_taken(entries, named)


OPENCV = CalibrationFormat(
    "OpenCV stereoRectify YAML, XML or JSON (P1, P2, or M1, M2, R, T)",
    lambda text: is_storage(text) and not any(other.matches(text) for other in (BOOSTER, EUROC, ORB_SLAM)),
    _read,
    file_counts=(1, 2),
)
