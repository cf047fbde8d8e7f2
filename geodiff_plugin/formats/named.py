"""Reads calibrations as named matrices: OpenCV's FileStorage, JSON, YAML, TOML, archives of arrays.

``DIALECTS`` lists the supported names, with a program that writes them.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError, bad_value
from geodiff_plugin.formats.rigs import (
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    projected,
    rectified_from,
    rigid,
    transform,
)
from geodiff_plugin.formats.storage import read_storage
from geodiff_plugin.formats.units import in_stated_unit, split_unit, squeezed
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
Arrays = list[tuple[str, np.ndarray]]


class Dialect(NamedTuple):
    """Names used by some programs; alternatives for one matrix are separated by blanks.

    The matrices of one camera have its side after or before their name (``BEHIND``, ``IN_FRONT``), or are
    nested under it. Letter case, ``_``, ``-`` and ``.`` are ignored.
    """

    programs: str
    K: str = ""
    lens: str = ""
    rectifying: str = ""  # rotation
    projection: str = ""
    rotation: str = ""  # from the left to the right camera frame, as in cv::stereoCalibrate
    translation: str = ""


DIALECTS = (
    Dialect("stereo_calib of OpenCV's samples", "M", "D", "R", "P", "R", "T"),
    Dialect("sourishg/stereo-calibration, aliyasineser/stereoDepth, ORB-SLAM2 (LEFT.K)", "K", "D", "R", "P",
            "R rot", "T trans"),
    Dialect("scripts with the names of cv::stereoCalibrate's arguments", "cameraMatrix",
            "distCoeffs distortionCoeffs", rotation="R stereo_R", translation="T stereo_T"),
    Dialect("calibration of OpenCV's samples, camera_calibration of ROS", "camera_matrix",
            "distortion_coefficients dist_coeff", "rectification_matrix", "projection_matrix",
            "rotation_matrix", "translation_vector"),
    Dialect("scripts after OpenCV's Python tutorials", "mtx", "dist", "rect rot_rect", "proj proj_matrix"),
    Dialect("erget/StereoVision, StereoPi", "cam_mats", "dist_coefs", "rect_trans", "proj_mats", "rot_mat",
            "trans_vec"),
    Dialect("scripts that save depthai's calibration", "intrinsics intrinsic intrinsic_matrix", "distortion",
            rotation="rotation_left_to_right", translation="translation_left_to_right"),
    Dialect("scripts with camera_mat and rotation_mat", "camera_mat cam_mtx", "distortion", "", "projection",
            "rotation_mat rotation", "translation_vec translation t_vec"),
    Dialect("BinoCalib", "camera_matrix", "camera_distCoeffs", rotation="Rotate_Matrix Rotate",
            translation="Translate_Matrix"),
    Dialect("rotation vectors: scripts with cv2.Rodrigues, Bouguet's toolbox", rotation="rvec om",
            translation="tvec T"),
)  # fmt: skip
#: Names of the left and right camera after a dialect's name; some are also used before it.
BEHIND = (("left", "right"), ("l", "r"), ("one", "two"))
IN_FRONT = (("left", "right"),)
#: Camera numbers before or after a name (``0``, ``cam0``): from 1, or from 0 if the file has a camera 0.
NUMBERED = {1: ("1", "2"), 0: ("0", "1")}
#: Names of matrices that belong to no single camera.
OTHERS = {
    **dict.fromkeys(("e", "pose"), "E"),
    **dict.fromkeys(("imagesize", "imgsize", "imgres", "imageshape", "size", "resolution"), "image_size"),
    **dict.fromkeys(("imagewidth", "leftwidth", "width"), "image_width"),
    **dict.fromkeys(("imageheight", "leftheight", "height"), "image_height"),
    **dict.fromkeys(("baseline", "stereobaseline"), "baseline"),
}
#: Allowed numbers of values of a matrix: 9 for a rotation, or 3 for a rotation vector. All others: more than
#: one.
COUNTS = {
    **dict.fromkeys(("P", "P1", "P2"), (12,)),
    **{"R1": (9,), "R2": (9,), "R": (3, 9), "T": (3,)},
    **dict.fromkeys(("image_width", "image_height", "baseline"), (1,)),
}
#: Matrices whose names may end with a unit.
LENGTHS = ("T", "baseline")
SIDE_LENGTHS = ("image_width", "image_height")
#: Matrices that may differ between the files of single cameras; none is used then.
MAY_DIFFER = ("K", "D", "P", "image_size", *SIDE_LENGTHS)
#: Maximum ratio of distances between principal point and image centre that decides between two size orders.
CLEARLY = 0.5
#: Numbers of values of matrices listed in a message: vectors of 3, distortion, 3x3, 3x4 and 4x4 matrices.
SIZES = (3, 4, 5, 8, 9, 12, 14, 16)
#: Maximum number of matrices in a message.
MAX_LISTED = 8
RENAME = (
    "Rename its matrices to K1, D1, K2, D2, R, T, or to other names of docs/reference/calibration.md, "
    "or pass K and E of the pair (--K, --K-right, --E)."
)


def _names(field: str) -> list[str]:
    """Return the normalised names of a matrix in all dialects."""
    return [squeezed(name) for dialect in DIALECTS for name in getattr(dialect, field).split()]


def _table(first: int) -> dict[str, str]:
    """Map each normalised name to K1, K2, D1 etc.; ``first`` is the number of the left camera."""
    table = dict(OTHERS)
    of_camera = {"K": "K", "D": "lens", "P": "projection"}
    for letter, field in (of_camera | {"R": "rotation", "T": "translation"}).items():
        table |= dict.fromkeys(_names(field), letter)
    numbers = NUMBERED[first]
    before = (*IN_FRONT, numbers, [f"cam{number}" for number in numbers])
    for letter, field in (of_camera | {"R": "rectifying"}).items():
        for name, n in product(_names(field), (0, 1)):
            table |= dict.fromkeys([name + sides[n] for sides in (*BEHIND, numbers)], f"{letter}{n + 1}")
            table |= dict.fromkeys([sides[n] + name for sides in before], f"{letter}{n + 1}")
    return table


TABLES = {first: _table(first) for first in NUMBERED}
TRANSLATIONS = tuple(_names("translation"))


def _named(arrays: Arrays) -> Entries:
    """Return the matrices under their standard names; raise if several with one name differ."""
    keys = [squeezed(key) for key, value in arrays if value.size > 1]
    table = TABLES[0 if any(TABLES[0].get(key) == "K1" and key not in TABLES[1] for key in keys) else 1]
    found: dict[str, Arrays] = {}
    for key, value in arrays:
        name, length = (table.get(each) for each in (squeezed(key), split_unit(squeezed(key))[0]))
        name = length if name is None and length in LENGTHS else name
        if name and (value.size in COUNTS[name] if name in COUNTS else value.size > 1):
            found.setdefault(name, []).append((key, value))
    named: Entries = {}
    for name, fits in found.items():
        fits = _in_metres(fits) if name == "baseline" else fits
        if name == "R":  # a matrix takes precedence over a rotation vector, which may be of something else
            fits = [(key, value) for key, value in fits if value.size == 9] or fits
        if all(np.array_equal(value, fits[0][1]) for _, value in fits):
            named[name] = fits[0][1]
        elif name not in MAY_DIFFER:
            hint = "Keep the ones that match R and T; files of single cameras have no baseline."
            bad_value(name, "unique", f"{', '.join(key for key, _ in fits)}, which differ", hint)
    return named


def _in_metres(fits: Arrays) -> Arrays:
    """Return the first baseline whose name has a unit, otherwise all, which are in metres."""
    stated = [(key, value / unit) for key, value in fits if (unit := split_unit(squeezed(key))[1])]
    return stated[:1] or fits


def _lenses(arrays: Arrays, named: Entries) -> list[Any]:
    """Return the distortion coefficients of both cameras, empty if the file has none.

    A file that has some, but not as ``D1`` and ``D2``, is an error: they would silently count as zero.
    """
    if named.keys() >= {"D1", "D2"}:
        return [named["D1"], named["D2"]]
    single = [named[name] for name in ("D", "D1", "D2") if name in named]
    unrecognised = [
        key
        for key, value in arrays
        if "dist" in squeezed(key) and value.size > 1 and not any(value is each for each in single)
    ]
    if unrecognised or any(each.any() for each in single):
        got = ", ".join(unrecognised) or "for one of them"
        hint = "Name lens distortion D1 and D2 (zeros for no distortion), and other matrices differently."
        bad_value("the lens distortion", "specified for both cameras (D1, D2)", got, hint)
    return [(), ()]


def read_named(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read ``P1, P2`` of rectified images, or ``K1, K2, R, T`` and ``D1, D2``, or parallel cameras.

    Lengths are in the unit stated in the file, otherwise in metres.
    """
    read = _with_sides([read_storage(text) for text in texts])
    arrays = [item for entries in read for item in entries.items() if isinstance(item[1], np.ndarray)]
    named = _named(arrays)
    size = _size_of(named, choice)
    of_taken = named.keys() >= {"K1", "K2", "R", "T"}
    if named.keys() >= {"P1", "P2"} and (not of_taken or _are_rectified(named)):
        rig = projected(named["P1"], named["P2"], size, size)
        if named.keys() >= {"K1", "K2", "D1", "D2"}:
            rig = _with_taken(rig, named, size)
    elif "baseline" in named and not named.keys() & {"R", "T"} and not _is_posed(named):
        return _parallel(named, arrays, size)
    else:
        _check_complete(named, arrays)
        lenses = zip(("K1", "K2"), _lenses(arrays, named), strict=True)
        left, right = (RawCamera(_matrix(named[name], name), size, lens) for name, lens in lenses)
        rig = make_rig(left, right, _pose(named))
    every = {key: value for entries in read for key, value in entries.items()}
    return in_stated_unit(rig, every, TRANSLATIONS, choice)


def _size_of(named: Entries, choice: CameraChoice) -> Any:
    """Return the image size as width and height, ``None`` if unknown; detects numpy's order (height first).

    The order is swapped if the image has the swapped shape and the principal points are then closer to its
    centre. For images that were rotated themselves they are as far from it.
    """
    sides = np.array([named[name].item() for name in SIDE_LENGTHS if name in named])
    size = named.get("image_size", sides)
    if size.size != 2:
        return sides if sides.size == 2 else None
    at = {4: [2, 3], 9: [2, 5]}  # indices of cx and cy in a matrix
    found = [named[name] for name in ("K1", "K2", "K") if name in named]
    centres = np.array([K[at[K.size]] for K in found if K.size in at]).reshape(-1, 2)
    off, off_turned = (np.abs(centres - each / 2).sum() for each in (size, size[::-1]))
    width, height = choice.image_size or size
    is_reoriented = (width > height) != (size[0] > size[1]) and off_turned < CLEARLY * off
    return size[::-1] if is_reoriented else size


def _are_rectified(named: Entries) -> bool:
    """Whether both projections are of rectified images: ``K [I | t]`` with focal lengths in pixels.

    Programs without rectification write 0 or 1 instead, others ``K [R | t]`` of the original images.
    """
    both = [named[name].reshape(3, 4)[:, :3] for name in ("P1", "P2")]
    return all(min(A[0, 0], A[1, 1]) > 1 and not A[(1, 2, 2), (0, 0, 1)].any() for A in both)


def _with_taken(rig: Rig, named: Entries, size: Any) -> Rig:
    """Return the rig of rectified images with its original cameras, if they can be read."""
    with suppress(InputError):
        left, right = (RawCamera(_matrix(named[f"K{n}"], "K"), size, named[f"D{n}"]) for n in (1, 2))
        if named.keys() >= {"R", "T"}:
            return replace(rig, as_taken=make_rig(left, right, _pose(named)))
        if named.keys() >= {"R1", "R2"}:
            return rectified_from(rig, left, right, (named["R1"], named["R2"]))
    return rig


def _with_sides(read: list[Entries]) -> list[Entries]:
    """Merge the entries of files; two single-camera files become left and right.

    Their pose is in a third file, or both have the projections of the rectified images.
    """
    alone = [n for n, entries in enumerate(read) if _has(entries, "K")]
    projected_pair = len(read) == 2 and all(_has(entries, "P") for entries in read)
    if len(alone) != 2 or not (len(read) == 3 or projected_pair):
        return read
    for n, side in zip(alone, ("left", "right"), strict=True):
        shared = [key for key in read[n] if OTHERS.get(squeezed(key), "").startswith("image_")]
        read[n] = {key if key in shared else f"{side}.{key}": value for key, value in read[n].items()}
    return read


def _has(entries: Iterable[str], name: str) -> bool:
    """Whether there is a matrix with this name, without a side."""
    return any(TABLES[1].get(squeezed(key)) == name for key in entries)


def _is_posed(named: Entries) -> bool:
    return (
        "E" in named and named["E"].size == 16 and "R" not in named
    )  # with 9 numbers E is the essential matrix


def _matrix(numbers: np.ndarray, name: str) -> np.ndarray:
    """Return K from 9 numbers, or from fx, fy, cx, cy."""
    return intrinsics(*numbers) if numbers.size == 4 else array_of(numbers, (3, 3), name)


def _pose(named: Entries) -> np.ndarray:
    """Return the ``(4, 4)`` pose of the right camera in the left camera's frame."""
    if _is_posed(named):
        return rigid(named["E"], "E")
    R = named["R"]
    R = Rotation.from_rotvec(R).as_matrix() if R.size == 3 else R
    return np.linalg.inv(transform(R, named["T"], "R, T"))


def _check_complete(named: Entries, arrays: Arrays) -> None:
    """Check that both cameras and their pose are given; the error lists the entries found."""
    needed = ["K1", "K2"] if _is_posed(named) else ["K1", "K2", "R", "T"]
    missing = [name for name in needed if name not in named]
    if not missing:
        return
    hint = f"If intrinsics and extrinsics are in several files, pass all of them. {RENAME}"
    code = "calibration.no-baseline" if set(missing) <= {"R", "T"} else ""
    if {"K1", "K2"} <= set(missing) and _has(dict(arrays), "K"):
        code = "calibration.one-camera"
        hint = "It has a single camera. Pass the stereo calibration, or K and E of the pair (--K, --E)."
    listed = [f"{key} ({v.size})" for key, v in arrays if v.size in SIZES]
    others = f" among {', '.join(listed[:MAX_LISTED])}" if listed else ""
    expected = "a calibration with P1, P2, or with K1, K2, R, T"
    bad_value("the file", expected, f"no {', '.join(missing)}{others}", hint, code=code)


def _parallel(named: Entries, arrays: Arrays, size: Any) -> Rig:
    """Return parallel cameras from their matrices, or one matrix for both, and the baseline in metres."""
    found = [named.get(name, named.get("K")) for name in ("K1", "K2")]
    Ks = [_matrix(K, "K") for K in found if K is not None]
    if len(Ks) != 2:
        hint = f"It has a baseline but no cameras; pass the file of the cameras as well. {RENAME}"
        bad_value("the file", "a calibration with K1 and K2, or K, and a baseline", "no K1, K2", hint)
    of_each = "K" not in named or named.keys() & {"D1", "D2"}
    lenses = _lenses(arrays, named) if of_each else [named.get("D", ())] * 2
    left, right = (RawCamera(K, size, lens) for K, lens in zip(Ks, lenses, strict=True))
    return make_rig(left, right, named["baseline"].item())
