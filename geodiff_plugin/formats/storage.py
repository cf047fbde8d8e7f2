"""YAML, and matrices by name: OpenCV's FileStorage, plain JSON, ``.npz`` and MATLAB's ``stereoParams``.

OpenCV's own reader is not used: a damaged file can corrupt its memory, and calibrations come from strangers.
"""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import parse_xml
from geodiff_plugin.formats.rigs import Camera, CameraChoice, make_rig, projected, transform
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")


class _Loader(yaml.SafeLoader):
    """YAML as OpenCV writes it: its matrices, since OpenCV 5 of one axis too, are mappings like others."""


for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", lambda loader, node: loader.construct_mapping(node, deep=True)
    )


def read_yaml(text: str) -> Entries:
    """The mapping that the first YAML document holds; later documents (``rostopic echo``) are left out."""
    content = next(yaml.load_all(OPENCV_HEAD.sub("", text), _Loader), None)  # noqa: S506  (a safe one)
    if not isinstance(content, dict):
        bad_value("the file", "a YAML file of named entries", type(content).__name__)
    return content


def read_storage(text: str) -> Entries:
    """The entries of an OpenCV file by key in small letters: numbers as flat arrays, and strings."""
    # JSON is YAML; older versions of OpenCV write 1. and .Nan into it, which JSON itself does not know.
    content = _of_element(parse_xml(text)) if "<opencv_storage" in text else read_yaml(text)
    maps = [value for value in content.values() if isinstance(value, dict) and "data" not in value]
    entries: Entries = {}
    for key, value in [item for each in (*maps, content) for item in each.items()]:
        numbers = _numbers(value["data"] if isinstance(value, dict) and "data" in value else value)
        entries[str(key).lower()] = value if numbers is None else numbers
    return entries


def _of_element(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _of_element(child) for child in node}
    words = (node.text or "").split()
    return words[0] if len(words) == 1 and node.tag != "data" else words


def _numbers(value: Any) -> np.ndarray | None:
    """A number or a flat list of numbers, some of which may be text; ``None`` for other things."""
    words = value if isinstance(value, list) else [value]
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
    "image_size": "imagesize|imgres|imgsize|size",
    "image_width": "imagewidth|leftwidth",
    "image_height": "imageheight|leftheight",
}
#: Those that are one number; what else is a number, such as a coefficient ``k1``, is none of the matrices.
NUMBERS = ("image_width", "image_height")
Arrays = list[tuple[str, np.ndarray]]


def _named(arrays: Arrays) -> Entries:
    """What ``NAMES`` has of the arrays, by its names; those that differ under one name are refused."""
    named: Entries = {}
    for name, words in NAMES.items():
        fits = [(key, v) for key, v in arrays if (v.size == 1) == (name in NUMBERS)]
        fits = [(key, v) for key, v in fits if re.fullmatch(words, re.sub("[_.]", "", key))]
        if any(not np.array_equal(v, fits[0][1]) for _, v in fits[1:]):
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
    sides = np.array([named[name].item() for name in NUMBERS if name in named])
    size = next((pair for pair in (named.get("image_size", sides), sides) if pair.size == 2), None)
    if named.keys() >= {"P1", "P2"}:
        return projected(named["P1"], named["P2"], size, size)
    missing = [name for name in ("M1", "M2", "R", "T") if name not in named]
    if missing:
        expected = "an OpenCV calibration with P1, P2, or with M1, M2, R, T"
        cure = "Where intrinsics and extrinsics are two files, give both; rename what has other names."
        bad_value("the file", expected, f"no {', '.join(missing)}", cure)
    lenses = zip(("M1", "M2"), _lenses(arrays, named), strict=True)
    left, right = (Camera(named[name], size, lens) for name, lens in lenses)
    return make_rig(left, right, np.linalg.inv(transform(named["R"], named["T"], "R, T")))
