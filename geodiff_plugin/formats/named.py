"""Calibrations as matrices by name: OpenCV's FileStorage, plain JSON, YAML and TOML, archives of arrays.

Names are those of OpenCV's samples and of the programs that copy them; their unit is often in a name as well.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._camera_checks import LONG_BASELINE_M
from geodiff_plugin._checks import InputError, bad_value, warn
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    in_units,
    intrinsics,
    make_rig,
    projected,
    rectified_from,
    rigid,
    transform,
)
from geodiff_plugin.formats.storage import read_storage
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
Arrays = list[tuple[str, np.ndarray]]
#: Units of length as names end with them, and how many of them a metre has.
UNITS = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e2),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
}
UNIT = f"({'|'.join(UNITS)})"
#: Numbers of cameras as words.
NUMBER_WORDS = ("zero", "one", "two")
#: Words between those of a matrix and the side of its camera.
CAMERA = "(?:cam(?:era)?)?"
WORDS = {
    "M": "m|k|mtx|(?:cam|camera)?(?:mtx|mats?|matrix)|intr|intrinsics?(?:m(?:tx|at|atrix))?",
    "D": "d|(?:dis|dist|disto|distort|distortions?)(?:coe?f?fs?|coe?f?ficients?|vec|vector|param(?:eter)?s)?",
    "R": "r|rrect|(?:rect|rectification)(?:rot|rotation|trans|transform|mats?|matrix)?",
    "P": "p|(?:proj|projection)(?:mats?|matrix)?",
}
#: Between which cameras a rotation or a translation is: left to right, as those of ``stereoCalibrate``.
FORTH = "(?:stereo|relative|lefttoright|ltor|l2r|1to2)?"
#: From the right one to the left: the right camera's pose in the left camera's frame.
BACK = "(?:righttoleft|rtol|r2l|2to1)"
ROTATION = "(?:stereo)?(?:r|rot|rotate|rotation|om|rvec)(?:mat|matrix|vec|vector)?"
TRANSLATION = "(?:stereo)?(?:t|tvec|trans|transl|translation)(?:mat|matrix|vec|vector)?"
#: Lengths, whose names may end with their unit.
T_FORTH, T_BACK = (f"{TRANSLATION}{way}{UNIT}?" for way in (FORTH, BACK))
BASELINE = f"(?:stereo)?baseline{UNIT}?"


def _of(words: str, number: int, side: str) -> str:
    """Names of a matrix of one camera: its number, letter or side behind a word, or number or side before."""
    behind = f"(?:{words}){CAMERA}(?:{number}|{NUMBER_WORDS[number]}|{side[0]}|{side}{CAMERA})"
    return f"{behind}|(?:{side}|{CAMERA}{number}){CAMERA}(?:{words})"


def _names(first: int) -> dict[str, str]:
    """Names in OpenCV's samples -> names in use for the same, in small letters without "_", "." and "-".

    ``first`` is the number of the left camera, 0 or 1.
    """
    return {
        **{f"{name}1": _of(words, first, "left") for name, words in WORDS.items()},
        **{f"{name}2": _of(words, first + 1, "right") for name, words in WORDS.items()},
        "R": ROTATION + FORTH,
        "T": T_FORTH,
        "R_back": ROTATION + BACK,
        "T_back": T_BACK,
        "E": "e|pose",
        "image_size": "imagesize|imgres|imgsize|size|resolution|imageshape",
        "image_width": "imagewidth|leftwidth|width",
        "image_height": "imageheight|leftheight|height",
        "M": WORDS["M"],
        "D": WORDS["D"],
        "baseline": BASELINE,
    }


#: Those that are one number; what else is a number, such as a coefficient ``k1``, is none of the matrices.
NUMBERS = ("image_width", "image_height", "baseline")
SIDES = ("image_width", "image_height")
#: How many numbers others have: a rotation 9, or 3 of a rotation vector.
COUNTS = {
    "P1": (12,),
    "P2": (12,),
    "R1": (9,),
    "R2": (9,),
    "R": (3, 9),
    "T": (3,),
    "R_back": (3, 9),
    "T_back": (3,),
}
ROTATIONS = ("R", "R_back")
#: A rotation that a file gives twice is equal to this in every number.
SAME_TURN = 1e-4
#: Those that may differ between the files of single cameras; which of them is meant nobody says, so none is.
MAY_DIFFER = ("M", "D", "image_size", *SIDES)
#: What files of single cameras say of both images.
SHARED = ("imagesize", "imagewidth", "imageheight")
#: A left camera of number 0.
FROM_ZERO = re.compile(_of(WORDS["M"], 0, "zero"))
#: Names of the size of a board's squares with a unit, which is that of the translation.
SQUARE = re.compile(f"(?:square|pattern|marker|checker|tag|grid)[a-z]*(?:size|length|spacing){UNIT}")
#: Metres between cameras in the unit of the board, at least and at most; a translation may count squares.
LIKELY_BASELINE_M = (0.02, 5.0)
#: A longer baseline is in another unit unless the file says which.
LONGEST_UNSTATED_M = 1.5
#: Lengths of one thing that a file gives twice are equal to this share.
SAME_LENGTH = 0.03
#: Principal points tell how a size is written where one way has them by this factor nearer to the middle.
CLEARLY = 0.5
#: Matrices that a message lists.
MOST_LISTED = 8


def _squeezed(key: str) -> str:
    return re.sub(r"[-_. ]", "", key)


def _named(arrays: Arrays) -> Entries:
    """What ``_names`` has of the arrays, by its names; those that differ under one name are refused."""
    named: Entries = {}
    from_zero = any(FROM_ZERO.fullmatch(_squeezed(key)) for key, v in arrays if v.size > 1)
    for name, words in _names(0 if from_zero else 1).items():
        fits = [(key, v) for key, v in arrays if (v.size == 1) == (name in NUMBERS)]
        fits = [(key, v) for key, v in fits if v.size in COUNTS.get(name, (v.size,))]
        fits = [(key, v) for key, v in fits if re.fullmatch(words, _squeezed(key))]
        if name == "baseline":
            fits = _in_metres(fits)
        if name in ROTATIONS:
            fits = _without_vectors(fits)
        differ = any(not np.array_equal(v, fits[0][1]) for _, v in fits[1:])
        if differ and name in MAY_DIFFER:
            continue
        if differ:
            cure = "Keep those that belong to R and T; files of single cameras have no baseline."
            bad_value(name, "there once", f"{', '.join(key for key, _ in fits)}, which differ", cure)
        if fits:
            named[name] = fits[0][1]
    return named


def _without_vectors(fits: Arrays) -> Arrays:
    """The rotations without the rotation vectors that say the same as a matrix beside them."""
    matrices = [v.reshape(3, 3) for _, v in fits if v.size == 9]

    def is_said(vector: np.ndarray) -> bool:
        turn = Rotation.from_rotvec(vector).as_matrix() if vector.size == 3 else None
        return turn is not None and any(np.allclose(turn, R, atol=SAME_TURN) for R in matrices)

    return [(key, v) for key, v in fits if not is_said(v)]


def _unit_of_name(key: str) -> float | None:
    """Units a metre by the end of a name of a length, if it says one."""
    match = re.fullmatch(f".*?(?:baseline|{TRANSLATION}|size|length|spacing).*?{UNIT}", _squeezed(key))
    return UNITS[match[1]] if match else None


def _in_metres(fits: Arrays) -> Arrays:
    """The baselines whose names say their unit, else all, which are metres."""
    stated = [(key, v / unit) for key, v in fits if (unit := _unit_of_name(key)) is not None]
    return stated[:1] or fits


def _units_a_metre(entries: Entries, length: float) -> float | None:
    """Units of the translation that a metre has, ``None`` where the file does not say; ``length`` is its own.

    By the translation's name, an entry ``unit``, a baseline beside it, or the name of a board's square.
    """
    for key, value in entries.items():
        name = _squeezed(key)
        if re.fullmatch(f"{T_FORTH}|{T_BACK}", name) and (unit := _unit_of_name(key)):
            return unit
        if re.fullmatch("(?:length|world)?units?", name) and str(value).lower() in UNITS:
            return UNITS[str(value).lower()]
    numbers = {key: v.item() for key, v in entries.items() if isinstance(v, np.ndarray) and v.size == 1}
    baselines = {key: number for key, number in numbers.items() if re.fullmatch(BASELINE, _squeezed(key))}
    for key, number in baselines.items():
        if (unit := _unit_by_baseline(length, number, _unit_of_name(key))) is not None:
            return unit
    for key in numbers:
        if match := SQUARE.fullmatch(_squeezed(key)):
            unit = UNITS[match[1]]
            return unit if LIKELY_BASELINE_M[0] <= length / unit <= LIKELY_BASELINE_M[1] else None
    return None


def _unit_by_baseline(length: float, baseline: float, stated: float | None) -> float | None:
    """Units a metre of the translation's ``length`` in which it is as long as the baseline beside it.

    ``stated`` is the same of the baseline, if its name says its unit; else it is taken to be in metres, and
    that both lengths are equal then says nothing.
    """
    for unit in (1e3, 1e2, 1.0):
        if abs(length / unit * (stated or 1.0) - baseline) <= SAME_LENGTH * baseline:
            return unit if stated or unit != 1.0 else None
    return None


def _lenses(arrays: Arrays, named: Entries) -> list[Any]:
    """``D1`` and ``D2``, or none; without one that has another name, images would pass for a pinhole's."""
    given = [named[name] for name in ("D1", "D2") if name in named]
    others = [key for key, v in arrays if "dist" in key and v.size > 1 and not any(v is d for d in given)]
    if len(given) < 2 and (others or np.any(given)):
        cure = "Rename what is lens distortion to D1 and D2, and what is not; a lens without any has zeros."
        bad_value("the lens distortion", "of both cameras (D1, D2)", ", ".join(others) or "one of them", cure)
    return given if len(given) == 2 else [(), ()]


def read_opencv(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P1, P2`` of rectified images, else ``M1, M2, R, T`` and ``D1, D2``.

    Lengths are in the unit that the file says, else they are taken as metres.
    """
    read = _with_sides([read_storage(text) for text in texts])
    arrays = [item for entries in read for item in entries.items() if isinstance(item[1], np.ndarray)]
    named = _named(arrays)
    size = _size_of(named, choice)
    of_taken = named.keys() >= {"M1", "M2", "R", "T"}
    if named.keys() >= {"P1", "P2"} and (not of_taken or _are_rectified(named)):
        rig = projected(named["P1"], named["P2"], size, size)
        if named.keys() >= {"M1", "M2", "D1", "D2"}:
            rig = _with_taken(rig, named, size)
    elif "baseline" in named and not named.keys() & {"R", "T", "T_back"} and not _is_posed(named):
        return _parallel(named, arrays, size)
    else:
        _refuse_missing(named, arrays)
        lenses = zip(("M1", "M2"), _lenses(arrays, named), strict=True)
        left, right = (Camera(_matrix(named[name], name), size, lens) for name, lens in lenses)
        rig = make_rig(left, right, _pose(named))
    return in_stated_unit(rig, {key: value for entries in read for key, value in entries.items()}, choice)


def _size_of(named: Entries, choice: CameraChoice) -> Any:
    """Width and height of the images, ``None`` if unknown; some programs write numpy's shape, height first.

    So it is where the image is of the turned shape, and the principal points lie nearer to its middle:
    images that were turned themselves have them as far from it.
    """
    sides = np.array([named[name].item() for name in SIDES if name in named])
    size = named.get("image_size", sides)
    if size.size != 2:
        return sides if sides.size == 2 else None
    at = {4: [2, 3], 9: [2, 5]}  # cx and cy among the numbers of a matrix
    found = [named[name] for name in ("M1", "M2", "M") if name in named]
    centres = np.array([K[at[K.size]] for K in found if K.size in at]).reshape(-1, 2)
    off, off_turned = (np.abs(centres - each / 2).sum() for each in (size, size[::-1]))
    width, height = choice.image_size or size
    is_turned = (width > height) != (size[0] > size[1]) and off_turned < CLEARLY * off
    return size[::-1] if is_turned else size


def _are_rectified(named: Entries) -> bool:
    """Whether both projections are those of rectified images: ``K [I | t]`` with focal lengths of pixels.

    Programs that do not rectify write 0 or 1 there, and others ``K [R | t]`` of the images as taken.
    """
    both = [named[name].reshape(3, 4)[:, :3] for name in ("P1", "P2")]
    return all(min(A[0, 0], A[1, 1]) > 1 and not A[(1, 2, 2), (0, 0, 1)].any() for A in both)


def _with_taken(rig: Rig, named: Entries, size: Any) -> Rig:
    """The rig of rectified pictures with the cameras that they were made from, where they can be read."""
    with suppress(InputError):
        left, right = (Camera(_matrix(named[f"M{n}"], "K"), size, named[f"D{n}"]) for n in (1, 2))
        if named.keys() >= {"R", "T"}:
            return replace(rig, as_taken=make_rig(left, right, _pose(named)))
        if named.keys() >= {"R1", "R2"}:
            return rectified_from(rig, left, right, (named["R1"], named["R2"]))
    return rig


def _with_sides(read: list[Entries]) -> list[Entries]:
    """The entries of files, with left and right those of two files of one camera each.

    Their pose stands in a third file, or both have the projections of the rectified images.
    """
    alone = [n for n, entries in enumerate(read) if any(_is_camera(key) for key in entries)]
    projected_pair = len(read) == 2 and all(map(_has_projection, read))
    if len(alone) != 2 or not (len(read) == 3 or projected_pair):
        return read
    for n, side in zip(alone, ("left", "right"), strict=True):
        read[n] = {
            key if _squeezed(key) in SHARED else f"{side}.{key}": value for key, value in read[n].items()
        }
    return read


def _is_camera(key: str) -> bool:
    return bool(re.fullmatch(WORDS["M"], _squeezed(key)))


def _has_projection(entries: Entries) -> bool:
    return any(re.fullmatch(WORDS["P"], _squeezed(key)) for key in entries)


def _is_posed(named: Entries) -> bool:
    return "E" in named and named["E"].size == 16 and "R" not in named  # of 9 it is the essential matrix


def _matrix(numbers: np.ndarray, name: str) -> np.ndarray:
    """K of 9 numbers, or of fx, fy, cx, cy."""
    return intrinsics(*numbers) if numbers.size == 4 else array_of(numbers, (3, 3), name)


def _pose(named: Entries) -> np.ndarray:
    """``(4, 4)`` pose of the right camera in the left camera's frame."""
    if _is_posed(named):
        return rigid(named["E"], "E")
    R, T = ("R", "T") if "T" in named else ("R_back", "T_back")
    rotation = named[R]
    rotation = Rotation.from_rotvec(rotation).as_matrix() if rotation.size == 3 else rotation
    pose = transform(rotation, named[T], "R, T")
    return np.linalg.inv(pose) if R == "R" else pose


def _refuse_missing(named: Entries, arrays: Arrays) -> None:
    """Refuse a file without both cameras or without their pose, and say what it has."""
    pose = () if _is_posed(named) or named.keys() >= {"R_back", "T_back"} else ("R", "T")
    missing = [name for name in ("M1", "M2", *pose) if name not in named]
    if not missing:
        return
    cure = "Where intrinsics and extrinsics lie in several files, give all of them; rename what has "
    cure += "other names, or give K and E of the pair (--K, --K-right, --E)."
    if {"M1", "M2"} <= set(missing) and ("M" in named or any(_is_camera(key) for key, _ in arrays)):
        cure = "It is of one camera: give the stereo calibration, or K and E of the pair (--K, --E)."
    there = [f"{key} ({v.size})" for key, v in arrays if v.size in (3, 4, 5, 8, 9, 12, 14, 16)]
    others = f" among {', '.join(there[:MOST_LISTED])}" if there else ""
    expected = "a calibration with P1, P2, or with M1, M2, R, T"
    bad_value("the file", expected, f"no {', '.join(missing)}{others}", cure)


def in_stated_unit(rig: Rig, entries: Entries, choice: CameraChoice) -> Rig:
    """The rig in metres by the unit that ``entries`` say; else it is taken to be in metres.

    Where that is unlikely it warns.
    """
    length = float(np.linalg.norm(rig.E[:3, 3]))
    units = _units_a_metre(entries, length)
    if units is None and choice.baseline_m is None and LONGEST_UNSTATED_M < length <= LONG_BASELINE_M:
        sentence = (
            f"The calibration does not say its unit, and {length:.4g} m is long for two cameras that were "
            f"calibrated together: its unit may be centimetres, or squares of the board. Give the measured "
            f"distance of the cameras (--baseline, baseline_m)."
        )
        warn(Message("calibration.assumed-metres", sentence))
    return in_units(rig, units or 1.0)


def _parallel(named: Entries, arrays: Arrays, size: Any) -> Rig:
    """Parallel cameras of one height, by their matrices, or one for both, and the baseline in metres."""
    found = [named.get(name, named.get("M")) for name in ("M1", "M2")]
    Ks = [_matrix(K, "K") for K in found if K is not None]
    if len(Ks) != 2:
        cure = "It has a baseline, but no camera: give the file of the cameras beside it, or instead of it."
        bad_value("the file", "a calibration with K1 and K2, or K, and a baseline", "no K1, K2", cure)
    of_each = "M" not in named or named.keys() & {"D1", "D2"}
    lenses = _lenses(arrays, named) if of_each else [named.get("D", ())] * 2
    left, right = (Camera(K, size, lens) for K, lens in zip(Ks, lenses, strict=True))
    return make_rig(left, right, named["baseline"].item())
