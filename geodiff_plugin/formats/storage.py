"""YAML, and matrices by name: OpenCV's FileStorage, plain JSON, ``.npz`` and MATLAB's ``stereoParams``.

OpenCV's own reader is not used: a damaged file can corrupt its memory, and calibrations come from strangers.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import parse_xml
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    make_rig,
    projected,
    rigid,
    transform,
)
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")
#: A list behind its name without a blank, which OpenCV reads, as in the settings of ORB-SLAM.
TIGHT_LIST = re.compile(r"(?m)^(\s*[\w.]+:)\[")
#: Entries may lie so many levels below each other.
MOST_LEVELS = 8
#: Dumps of programs that share a list have a few.
MOST_ALIASES = 32
#: Numbers that an array of an .npz may have: those of cameras have 16 at most, lists of lenses 14.
MOST_NUMBERS = 64
#: Bytes before the numbers of an array in an .npz, at most.
NPY_HEAD = 256


class _Loader(yaml.SafeLoader):
    """YAML as OpenCV writes it: its matrices, since OpenCV 5 of one axis too, are mappings like others.

    An alias may stand for a part of the file without aliases: those of aliases grow a kilobyte to gigabytes.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._aliases, self._holding = 0, set[int]()  # how many, and the nodes that hold any

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The node, or that of an alias, which is refused where it holds others or is one of too many."""
        is_alias, before = self.check_event(yaml.events.AliasEvent), self._aliases
        node = super().compose_node(parent, index)
        if is_alias:
            self._aliases += 1
            # A node without an end stands for itself, inside of itself.
            if self._aliases > MOST_ALIASES or id(node) in self._holding or node.end_mark is None:
                expected = f"YAML with {MOST_ALIASES} aliases at most, none of which holds others"
                bad_value("the file", expected, "more", "Write out what its aliases (*name) stand for.")
        elif self._aliases > before:
            self._holding.add(id(node))
        return node


for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", lambda loader, node: loader.construct_mapping(node, deep=True)
    )


def read_yaml(text: str) -> Entries:
    """The mapping that the first YAML document holds; later documents (``rostopic echo``) are left out."""
    text = TIGHT_LIST.sub(r"\1 [", OPENCV_HEAD.sub("", text))
    content = next(yaml.load_all(text, _Loader), None)  # noqa: S506  (a safe one)
    if not isinstance(content, dict):
        bad_value("the file", "a YAML file of named entries", type(content).__name__)
    return content


def read_storage(text: str) -> Entries:
    """The entries of an OpenCV file by key in small letters: numbers as flat arrays, and strings."""
    # JSON is YAML; older versions of OpenCV write 1. and .Nan into it, which JSON itself does not know.
    content = _of_element(parse_xml(text)) if "<opencv_storage" in text else read_yaml(text)
    entries: Entries = {}
    unclear = set[str]()  # names that entries of several parts have, and none of them is the file's own
    for key, value, level in _flat(content, ""):
        key, numbers = key.lower(), _numbers(value["data"] if _is_matrix(value) else value)
        value = value if numbers is None else numbers
        if level and key in entries and not np.array_equal(entries[key], value):
            unclear.add(key)
        entries[key] = value
    own = {str(key).lower() for key in content}
    return {key: value for key, value in entries.items() if key in own or key not in unclear}


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value


def _flat(content: Entries, outer: str, level: int = 0) -> Iterator[tuple[str, Any, int]]:
    """Names, entries and levels, lower ones first, with the side of a camera where an outer name says one."""
    sides = set(re.findall("left|right", outer.lower()))
    side = f"{sides.pop()}." if len(sides) == 1 else ""
    for key, value in content.items():
        if isinstance(value, dict) and not _is_matrix(value) and level < MOST_LEVELS:
            yield from _flat(value, f"{outer}.{key}", level + 1)
    for key, value in content.items():
        yield f"{side}{key}", value, level


def _of_element(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _of_element(child) for child in node}
    words = (node.text or "").split()
    return words[0] if len(words) == 1 and node.tag != "data" else words


def _numbers(value: Any) -> np.ndarray | None:
    """A number, or the numbers of a list or of lists in it, some of which may be text; else ``None``."""
    words = value if isinstance(value, list) else [value]
    while any(isinstance(word, list) for word in words):
        words = [part for word in words for part in (word if isinstance(word, list) else [word])]
    try:  # OpenCV writes .Nan and .Inf, which Python reads without the dot
        words = [re.sub(r"\.(nan|inf)", r"\1", w.lower()) if isinstance(w, str) else w for w in words]
        return None if any(isinstance(w, bool) for w in words) else np.array([float(w) for w in words])
    except (TypeError, ValueError, OverflowError):
        return None


def _of(words: str, number: str, side: str) -> str:
    """Names of a matrix of one camera: its number, letter or side behind a word, or the side before it."""
    return f"(?:{words})(?:{number}|{side[0]}|{side})|{side}(?:{words})"


WORDS = {
    "M": "m|k|mtx|cameramatrix|intrinsics?|intrinsicmatrix",
    "D": "d|dis|dist|distcoeffs?|distcoefs?|distort|distortion|distortioncoefficients|distortioncoeffs",
    "P": "p|projection|projectionmatrix|projmat|projmatrix",
}
#: Name in OpenCV's samples -> names in use for the same thing, in small letters without "_" and ".": the
#: arguments of stereoCalibrate, what tutorials call them, ORB-SLAM's ``LEFT.P``.
NAMES = {
    **{f"{name}1": _of(words, "1", "left") for name, words in WORDS.items()},
    **{f"{name}2": _of(words, "2", "right") for name, words in WORDS.items()},
    "R": "r|rot|rotation|rotationmatrix",
    "T": "t|trans|translation|translationmatrix|translationvector",
    "E": "e|pose",
    "image_size": "imagesize|imgres|imgsize|size",
    "image_width": "imagewidth|leftwidth",
    "image_height": "imageheight|leftheight",
    "M": WORDS["M"],
    "D": WORDS["D"],
    "baseline": "baseline|baselinem|baselinemeters|baselinemetres",
}
#: Those that are one number; what else is a number, such as a coefficient ``k1``, is none of the matrices.
NUMBERS = ("image_width", "image_height", "baseline")
SIDES = ("image_width", "image_height")
#: Those that two parallel cameras may share.
FOR_BOTH = ("M", "D")
Arrays = list[tuple[str, np.ndarray]]


def _named(arrays: Arrays) -> Entries:
    """What ``NAMES`` has of the arrays, by its names; those that differ under one name are refused."""
    named: Entries = {}
    for name, words in NAMES.items():
        fits = [(key, v) for key, v in arrays if (v.size == 1) == (name in NUMBERS)]
        fits = [(key, v) for key, v in fits if re.fullmatch(words, re.sub("[_.]", "", key))]
        differ = any(not np.array_equal(v, fits[0][1]) for _, v in fits[1:])
        if differ and name in FOR_BOTH:
            continue
        if differ:
            cure = "Keep those that belong to R and T; files of single cameras have no baseline."
            bad_value(name, "there once", f"{', '.join(key for key, _ in fits)}, which differ", cure)
        if fits:
            named[name] = fits[0][1]
    return named


def _lenses(arrays: Arrays, named: Entries) -> list[Any]:
    """``D1`` and ``D2``, or none; without one that has another name, images would pass for a pinhole's."""
    given = [named[name] for name in ("D1", "D2") if name in named]
    others = [key for key, v in arrays if "dist" in key and v.size > 1 and not any(v is d for d in given)]
    if len(given) < 2 and (others or np.any(given)):
        cure = "Rename what is lens distortion to D1 and D2, and what is not; a lens without any has zeros."
        bad_value("the lens distortion", "of both cameras (D1, D2)", ", ".join(others) or "one of them", cure)
    return given if len(given) == 2 else [(), ()]


def read_opencv(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P1, P2`` of rectified images, else ``M1, M2, R, T`` and ``D1, D2``; lengths are taken as metres."""
    arrays = [
        item for text in texts for item in read_storage(text).items() if isinstance(item[1], np.ndarray)
    ]
    named = _named(arrays)
    sides = np.array([named[name].item() for name in SIDES if name in named])
    size = next((pair for pair in (named.get("image_size", sides), sides) if pair.size == 2), None)
    if named.keys() >= {"P1", "P2"}:
        return projected(named["P1"], named["P2"], size, size)
    posed = "E" in named and named["E"].size == 16 and "R" not in named  # of 9 it is the essential matrix
    if "baseline" in named and not posed and not named.keys() & {"R", "T"}:
        return _parallel(named, arrays, size)
    missing = [name for name in ("M1", "M2", *(() if posed else ("R", "T"))) if name not in named]
    if missing:
        expected = "a calibration with P1, P2, or with M1, M2, R, T"
        cure = "Where intrinsics and extrinsics are two files, give both; rename what has other names."
        one = "It is of one camera: give the stereo calibration, or K and E of the pair (--K, --E)."
        cure = one if "M" in named and not named.keys() & {"M1", "M2"} else cure
        bad_value("the file", expected, f"no {', '.join(missing)}", cure)
    lenses = zip(("M1", "M2"), _lenses(arrays, named), strict=True)
    left, right = (Camera(named[name], size, lens) for name, lens in lenses)
    if posed:
        return make_rig(left, right, rigid(named["E"], "E"))
    return make_rig(left, right, np.linalg.inv(transform(named["R"], named["T"], "R, T")))


def _parallel(named: Entries, arrays: Arrays, size: Any) -> Rig:
    """Parallel cameras of one height, by their matrices, or one for both, and the baseline in metres."""
    Ks = [named.get(name, named.get("M")) for name in ("M1", "M2")]
    if any(K is None for K in Ks):
        bad_value("the file", "a calibration with K1 and K2, or K, and a baseline", "no K1, K2")
    of_each = "M" not in named or named.keys() & {"D1", "D2"}
    lenses = _lenses(arrays, named) if of_each else [named.get("D", ())] * 2
    left, right = (Camera(K, size, lens) for K, lens in zip(Ks, lenses, strict=True))
    return make_rig(left, right, named["baseline"].item())


def text_of_npz(path: Path) -> str:
    """The small arrays of an ``.npz`` as JSON, for ``read_opencv``; nothing is unpickled."""
    matrices: Entries = {}
    try:
        with zipfile.ZipFile(path) as archive, np.load(path, allow_pickle=False) as arrays:
            small = [each for each in archive.infolist() if each.file_size <= 8 * MOST_NUMBERS + NPY_HEAD]
            for name in (each.filename.removesuffix(".npy") for each in small):
                value = arrays[name]
                if value.dtype.kind in "fiu" and value.size <= MOST_NUMBERS:
                    matrices[name] = value.tolist()
    except Exception as error:  # of any kind that a damaged archive leads to
        bad_value("calibration", "a whole .npz of matrices", f"{path} ({error})", "Is it cut off?")
    return json.dumps(matrices)


#: What MATLAB calls its units, and how many of them a metre has; millimetres are its default.
MATLAB_UNITS = {"mm": 1e3, "millimeters": 1e3, "cm": 1e2, "centimeters": 1e2, "m": 1.0, "meters": 1.0}


def _matlab_camera(entries: Entries) -> Camera:
    """A camera of ``cameraParameters``: pixels count from 1, and ``IntrinsicMatrix`` is transposed."""
    K = array_of(entries.get("K") or entries["IntrinsicMatrix"], (3, 3), "IntrinsicMatrix")
    K = K.T if K[2, :2].any() else K
    K[:2, 2] -= 1
    radial = [*np.ravel(entries["RadialDistortion"]), 0.0][:3]
    p1, p2 = np.ravel(entries.get("TangentialDistortion") or (0.0, 0.0))
    size = entries.get("ImageSize") or (None, None)  # rows, columns
    return Camera(K, (size[1], size[0]), (radial[0], radial[1], p1, p2, radial[2]))


def read_matlab(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """MATLAB's ``stereoParameters`` by ``jsonencode``, its rotation transposed as it multiplies rows.

    Source: its documentation; ``RotationOfCamera2`` is ``PoseCamera2.R`` transposed, which newer files have.
    """
    data = json.loads(texts[0])
    left, right = (_matlab_camera(data[f"CameraParameters{n}"]) for n in (1, 2))
    if "PoseCamera2" in data:
        R, t = np.array(data["PoseCamera2"]["R"], float), data["PoseCamera2"]["Translation"]
    else:
        R, t = np.array(data["RotationOfCamera2"], float).T, data["TranslationOfCamera2"]
    unit = str(data["CameraParameters1"].get("WorldUnits") or "mm").lower()
    if unit not in MATLAB_UNITS:
        bad_value("WorldUnits", f"one of {', '.join(MATLAB_UNITS)}", unit)
    shift_m = array_of(t, (3,), "TranslationOfCamera2") / MATLAB_UNITS[unit]
    return make_rig(left, right, np.linalg.inv(transform(R, shift_m, "RotationOfCamera2")))
