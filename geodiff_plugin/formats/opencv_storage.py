"""OpenCV's FileStorage (YAML, XML, JSON), as far as calibrations use it.

Data flow: text -> {key in small letters: float64 array}.
Paper: none.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.structured import parse_json

__all__ = ["is_storage", "parse_storage"]

#: A matrix has rows and columns; from OpenCV 5 on one of Python's ``(5,)`` is "nd", with its sizes in a list.
KINDS = ("opencv-matrix", "opencv-nd-matrix")
MATRIX = re.compile(
    r"^[ \t]*([\w.]+)[ \t]*:[ \t]*!!opencv-(?:nd-)?matrix\s+"
    r"(?:rows:\s*(\d+)\s+cols:\s*(\d+)|sizes:\s*\[([\d,\s]*)\])\s+dt:\s*(\S+)\s+data:\s*\[([^\]]*)\]",
    re.MULTILINE,
)
JSON_MARK = '"opencv-matrix"'
#: The channels of an entry stand before the letter of its type, as in "2f" of a list of points.
CHANNELS = re.compile(r'^"?(\d{1,3})')
#: Older versions write 1. and .Nan into JSON, which has no such numbers.
BARE_POINT = re.compile(r"(?<=\d)\.(?=[\s,\]}eE])")
NOT_FINITE = re.compile(r"(-?)\.(Nan|Inf)")
SEQUENCE = re.compile(r"^([\w.]+)[ \t]*:[ \t]*\[([^\]]*)\]", re.MULTILINE)
SCALAR = re.compile(r"^([\w.]+)[ \t]*:[ \t]*([-+.\d][^\s#]*)[ \t]*(?:#.*)?$", re.MULTILINE)


def is_storage(text: str) -> bool:
    """Whether the text is written by OpenCV's FileStorage, as YAML, XML or JSON."""
    return any(mark in text for mark in ("!!opencv-matrix", "<opencv_storage", JSON_MARK))


def _numbers(text: str) -> np.ndarray | None:
    # OpenCV writes .Nan and .Inf, which Python reads without the dot.
    words = text.replace(",", " ").lower().replace(".nan", "nan").replace(".inf", "inf").split()
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return None


def _matrix(key: str, sizes: Sequence[str], kind: str, data: str, path: Path) -> np.ndarray:
    values, channels = _numbers(data), CHANNELS.search(kind)
    shape = [int(size[:12]) for size in (*sizes, *([channels[1]] if channels else []))]
    if values is None or values.size != math.prod(shape):
        got = "other than numbers" if values is None else f"{values.size} numbers"
        bad_value(f"{key} in {path}", f"{'x'.join(map(str, shape))} numbers", got, "Is the file cut off?")
    return values.reshape(shape)


def _parse_yaml(text: str, path: Path) -> dict[str, np.ndarray]:
    entries = {}
    for key, words in (*SEQUENCE.findall(text), *SCALAR.findall(text)):
        values = _numbers(words)
        if values is not None:
            entries[key.lower()] = values
    found = MATRIX.findall(text)
    count = sum(text.count(f"!!{kind}") for kind in KINDS)
    if len(found) != count:
        bad_value(
            f"{path}",
            f"an OpenCV file with {count} whole matrices",
            f"{len(found)} with rows, cols, dt and data up to its ]",
            "Is the file cut off?",
        )
    for key, rows, cols, sizes, kind, data in found:
        shape = (rows, cols) if rows else sizes.replace(",", " ").split()
        entries[key.lower()] = _matrix(key, shape, kind, data, path)
    return entries


def _parse_xml(text: str, path: Path) -> dict[str, np.ndarray]:
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        bad_value(
            f"{path}", "an OpenCV XML file", "a document type with entities", "OpenCV writes none; remove it."
        )
    try:
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        bad_value(f"{path}", "well-formed XML", str(error), "Is the file cut off?")
    entries = {}
    for node in root:
        if node.get("type_id") in KINDS:
            rows, cols, sizes, kind, data = (
                node.findtext(tag, default="").strip() for tag in ("rows", "cols", "sizes", "dt", "data")
            )
            shape = sizes.split() or (rows, cols)
            if not all(size.isdecimal() for size in shape):
                bad_value(
                    f"{node.tag} in {path}",
                    "a matrix with rows, cols and data",
                    "none",
                    "Is the file cut off?",
                )
            entries[node.tag.lower()] = _matrix(node.tag, shape, kind, data, path)
        elif len(node) == 0 and node.text:
            values = _numbers(node.text)
            if values is not None:
                entries[node.tag.lower()] = values
    return entries


def _parse_json(text: str, path: Path) -> dict[str, np.ndarray]:
    names = {"Nan": "NaN", "Inf": "Infinity"}
    text = NOT_FINITE.sub(lambda found: found[1] + names[found[2]], BARE_POINT.sub(".0", text))
    content = parse_json(text, path)
    entries = {}
    for key, value in content.items() if isinstance(content, dict) else ():
        if isinstance(value, dict) and value.get("type_id") in KINDS:
            sizes, data = value.get("sizes", [value.get("rows"), value.get("cols")]), value.get("data")
            shape = [str(size) for size in sizes] if isinstance(sizes, list) else [""]
            if not (all(size.isdecimal() for size in shape) and isinstance(data, list)):
                bad_value(f"{key} in {path}", "a matrix with rows, cols and data", "none")
            entries[key.lower()] = _matrix(
                key, shape, str(value.get("dt", "")), " ".join(map(str, data)), path
            )
        elif isinstance(value, (int, float, list)) and not isinstance(value, bool):
            numbers = _numbers(str(value).strip("[]"))
            if numbers is not None:
                entries[key.lower()] = numbers
    return entries


def parse_storage(text: str, path: Path) -> dict[str, np.ndarray]:
    """Every matrix, sequence and number at the top level.

    Args:
        text: content of the file.
        path: the file, for messages.

    Returns:
        Float64 arrays by key in small letters; matrices have the axes that they were written with, and one
        for their channels, the rest has one. Strings are left out.

    Raises:
        ValueError: cut off or malformed.
    """
    if "<opencv_storage" in text:
        return _parse_xml(text, path)
    return _parse_json(text, path) if JSON_MARK in text else _parse_yaml(text, path)
