"""OpenCV's stereo calibration as its samples write it, YAML, XML or JSON, in one file or two."""

from __future__ import annotations

import re

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.rigs import Camera, CameraChoice, RawRig, projected, rigid
from geodiff_plugin.formats.structured import parse_storage

__all__ = ["read_opencv"]


def _of(words: str, number: str, side: str) -> str:
    """Names of a matrix of one camera: its number, letter or side behind a word, or the side before it."""
    return f"(?:{words})(?:{number}|{side[0]}|{side})|{side}(?:{words})"


K = "m|k|mtx|cameramatrix|intrinsics?|intrinsicmatrix"
D = "d|dis|dist|distcoeffs?|distcoefs?|distort|distortion|distortioncoefficients|distortioncoeffs"
P = "p|projection|projectionmatrix|projmat|projmatrix"
#: Name in OpenCV's samples -> names in use for the same thing, in small letters without "_" and ".": the
#: arguments of stereoCalibrate, what tutorials call them, ORB-SLAM's ``LEFT.P``.
NAMES = {
    "M1": _of(K, "1", "left"),
    "M2": _of(K, "2", "right"),
    "D1": _of(D, "1", "left"),
    "D2": _of(D, "2", "right"),
    "P1": _of(P, "1", "left"),
    "P2": _of(P, "2", "right"),
    "R": "r|rot|rotation|rotationmatrix",
    "T": "t|trans|translation|translationmatrix|translationvector",
    "image_size": "imagesize|imgres|imgsize|size",
    "image_width": "imagewidth|leftwidth",
    "image_height": "imageheight|leftheight",
}
#: Those that are one number; what else is a number, such as a coefficient ``k1``, is none of the matrices.
NUMBERS = ("image_width", "image_height")

Entries = dict[str, np.ndarray]


def _can_be(name: str, key: str, value: np.ndarray) -> bool:
    fits = value.size == 1 if name in NUMBERS else value.shape != (1,)  # a matrix has two axes
    return fits and re.fullmatch(NAMES[name], re.sub("[_.]", "", key)) is not None


def _named(entries: Entries) -> Entries:
    """What ``NAMES`` has of the entries, by its names; entries that differ under one name are refused."""
    named: Entries = {}
    for name in NAMES:
        keys = [key for key, value in entries.items() if _can_be(name, key, value)]
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
        cure = "Was this file written by stereoRectify?"
        bad_value(name, f"of shape {shapes[0]}", f"{named[name].shape}", cure)
    return named[name]


def _lenses(entries: Entries, named: Entries) -> tuple[list[np.ndarray | None], tuple[str, ...]]:
    """``D1`` and ``D2``, and a note where one is missing: two lenses of a rig are rarely that unlike.

    A lens distortion by an unknown name is refused: without it the images would pass for a pinhole's.
    """
    lenses = [named.get(name) for name in ("D1", "D2")]
    given = [lens for lens in lenses if lens is not None]
    if len(given) == 2:
        return lenses, ()
    taken = [id(lens) for lens in given]
    others = [k for k, v in entries.items() if "dist" in k and v.shape != (1,) and id(v) not in taken]
    if others:
        cure = "Rename what is lens distortion to D1 and D2, and what is not."
        bad_value("the lens distortion", "called D1, D2", ", ".join(others), cure)
    if not given or not np.any(given):
        return lenses, ()
    there, missing, side = ("D1", "D2", "right") if lenses[1] is None else ("D2", "D1", "left")
    return lenses, (
        f"it has the lens distortion {there} and no {missing}: the {side} image is taken for one without "
        f"distortion. Add {missing} to the file, zeros if that lens has none.",
    )


def read_opencv(texts: tuple[str, ...], choice: CameraChoice) -> RawRig:
    """One file, or ``intrinsics`` and ``extrinsics`` in any order.

    ``P1, P2`` stand for the rectified images and come first, whatever the lens distortion before them was.
    Without them ``M1, M2, R, T`` are taken, with the distortion ``D1, D2`` of OpenCV's model; ``R, T`` take
    left points to right ones. Lengths are taken as metres: OpenCV keeps the unit of the chessboard's squares,
    and the file does not say it. ``NAMES`` has what else they may be called.
    """
    entries = _merged(texts)
    named = _named(entries)
    size = _size(named)
    if named.keys() >= {"P1", "P2"}:
        P_left, P_right = (_of_shape(named, name, (3, 4)) for name in ("P1", "P2"))
        return projected(P_left, P_right, size, size)
    missing = [name for name in ("M1", "M2", "R", "T") if name not in named]
    if missing:
        expected = "an OpenCV calibration with P1, P2, or with M1, M2, R, T"
        cure = "Where intrinsics and extrinsics are two files, give both; rename what has other names."
        bad_value("the file", expected, f"no {', '.join(missing)}", cure)
    K_left, K_right, R = (_of_shape(named, name, (3, 3)) for name in ("M1", "M2", "R"))
    T = np.hstack([R, _of_shape(named, "T", (3, 1), (1, 3), (3,)).reshape(3, 1)])
    lenses, notes = _lenses(entries, named)
    left, right = (
        Camera(matrix, size, () if lens is None else lens.ravel())
        for matrix, lens in zip((K_left, K_right), lenses, strict=True)
    )
    return RawRig(left, right, np.linalg.inv(rigid(T, "R, T")), notes=notes)
