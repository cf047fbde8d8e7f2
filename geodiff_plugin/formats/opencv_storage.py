"""OpenCV's FileStorage (YAML, XML, JSON), as far as calibrations use it.

Data flow: text -> {key in small letters: float64 array}.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.structured import parse_json

__all__ = ["is_storage", "parse_storage"]

MATRIX = re.compile(
    r"^[ \t]*([\w.]+)[ \t]*:[ \t]*!!opencv-matrix\s+"
    r"rows:\s*(\d+)\s+cols:\s*(\d+)\s+dt:\s*\S+\s+data:\s*\[([^\]]*)\]",
    re.MULTILINE,
)
JSON_MARK = '"opencv-matrix"'
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


def _matrix(key: str, rows: str, cols: str, data: str, path: Path) -> np.ndarray:
    values = _numbers(data)
    if values is None or values.size != int(rows) * int(cols):
        got = "other than numbers" if values is None else f"{values.size} numbers"
        bad_value(f"{key} in {path}", f"{rows}x{cols} numbers", got, "Is the file cut off?")
    return values.reshape(int(rows), int(cols))


def _parse_yaml(text: str, path: Path) -> dict[str, np.ndarray]:
    entries = {}
    for key, words in (*SEQUENCE.findall(text), *SCALAR.findall(text)):
        values = _numbers(words)
        if values is not None:
            entries[key.lower()] = values
    found = MATRIX.findall(text)
    if len(found) != text.count("!!opencv-matrix"):
        bad_value(
            f"{path}",
            f"an OpenCV file with {text.count('!!opencv-matrix')} whole matrices",
            f"{len(found)} with rows, cols, dt and data up to its ]",
            "Is the file cut off?",
        )
    entries.update({key.lower(): _matrix(key, rows, cols, data, path) for key, rows, cols, data in found})
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
        if node.get("type_id") == "opencv-matrix":
            rows, cols, data = (node.findtext(tag, default="").strip() for tag in ("rows", "cols", "data"))
            if not (rows.isdigit() and cols.isdigit()):
                bad_value(
                    f"{node.tag} in {path}",
                    "a matrix with rows, cols and data",
                    "none",
                    "Is the file cut off?",
                )
            entries[node.tag.lower()] = _matrix(node.tag, rows, cols, data, path)
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
        if isinstance(value, dict) and value.get("type_id") == "opencv-matrix":
            rows, cols, data = str(value.get("rows", "")), str(value.get("cols", "")), value.get("data")
            if not (rows.isdecimal() and cols.isdecimal() and isinstance(data, list)):
                bad_value(f"{key} in {path}", "a matrix with rows, cols and data", "none")
            entries[key.lower()] = _matrix(key, rows, cols, " ".join(map(str, data)), path)
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
        Float64 arrays by key in small letters; matrices are 2-D, the rest 1-D. Strings are left out.

    Raises:
        ValueError: cut off or malformed.
    """
    if "<opencv_storage" in text:
        return _parse_xml(text, path)
    return _parse_json(text, path) if JSON_MARK in text else _parse_yaml(text, path)
