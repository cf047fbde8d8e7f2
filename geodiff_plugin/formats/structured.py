"""JSON, YAML, INI and OpenCV's FileStorage of calibration files as dicts, lists and arrays.

OpenCV's own reader is not used: a damaged file can corrupt its memory, and calibrations come from strangers.
Errors are ``ValueError`` and name the line where there is one.
"""

from __future__ import annotations

import configparser
import json
import math
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from geodiff_plugin._checks import bad_value

__all__ = ["parse_ini", "parse_json", "parse_storage", "parse_yaml"]

CUT_OFF = "Is the file cut off?"
#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")
#: A matrix has rows and columns; from OpenCV 5 on one of Python's ``(5,)`` is "nd", with its sizes in a list.
KINDS = ("opencv-matrix", "opencv-nd-matrix")
#: The channels of an entry stand before the letter of its type, as in "2f" of a list of points.
CHANNELS = re.compile(r"^(\d{1,3})")
#: How deep maps may lie in maps.
DEEPEST = 4


class _Loader(yaml.SafeLoader):
    """YAML as OpenCV writes it: its matrices are mappings like others."""


for _kind in KINDS:
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", lambda loader, node: loader.construct_mapping(node, deep=True)
    )


def parse_json(text: str) -> Any:
    """What a JSON text holds."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        bad_value("the file", "JSON", f"{error.msg} in line {error.lineno}", CUT_OFF)
    except (RecursionError, ValueError):  # lists within lists without end, a number of thousands of digits
        bad_value("the file", "a JSON object of numbers", "lists too deep or thousands of digits")


def parse_yaml(text: str) -> dict[str, Any]:
    """The mapping that the first YAML document holds; later documents (``rostopic echo``) are left out."""
    try:
        content = next(yaml.load_all(OPENCV_HEAD.sub("", text), _Loader), None)  # noqa: S506  (a safe one)
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        bad_value("the file", "YAML", f"{problem or 'something else'}{where}", CUT_OFF)
    except (RecursionError, ValueError):  # a date that is none, a number of thousands of digits
        bad_value("the file", "a YAML file of numbers", "something else", CUT_OFF)
    if not isinstance(content, dict):
        bad_value("the file", "a YAML file of named entries", type(content).__name__, CUT_OFF)
    return content


def parse_ini(text: str) -> configparser.ConfigParser:
    """Sections of ``key=value``."""
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(text)
    except configparser.Error as error:
        bad_value("the file", "sections of key=value", str(error).splitlines()[0], CUT_OFF)
    return parser


def parse_storage(text: str) -> dict[str, Any]:
    """Every entry of an OpenCV file in YAML, XML or JSON, those of nested maps beside the others.

    Returns:
        By key in small letters: matrices as float64 arrays with the axes that they were written with and one
        for their channels, numbers and lists of numbers as float64 arrays of one axis, and strings.
    """
    # JSON is YAML; older versions of OpenCV write 1. and .Nan into it, which JSON itself does not know.
    content = _parse_xml(text) if "<opencv_storage" in text else parse_yaml(text)
    return _flat(content, DEEPEST)


def _parse_xml(text: str) -> dict[str, Any]:
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        cure = "OpenCV writes none; remove it."
        bad_value("the file", "an OpenCV XML file", "a document type with entities", cure)
    try:
        return {node.tag: _of_element(node, DEEPEST) for node in ElementTree.fromstring(text.strip())}
    except ElementTree.ParseError as error:
        bad_value("the file", "well-formed XML", str(error), CUT_OFF)


def _of_element(node: ElementTree.Element, deepest: int) -> Any:
    if len(node) and deepest:
        return {child.tag: _of_element(child, deepest - 1) for child in node}
    words = (node.text or "").split()
    return words[0] if len(words) == 1 and node.tag not in ("data", "sizes") else words


def _flat(content: dict[str, Any], deepest: int) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for key, value in content.items():
        key = str(key).lower()
        if isinstance(value, dict) and "data" in value and "dt" in value:
            entries[key] = _matrix(value, key)
        elif isinstance(value, dict):
            entries = (_flat(value, deepest - 1) if deepest else {}) | entries
        else:
            numbers = _numbers(value)
            entries[key] = value if numbers is None else numbers
    return entries


def _numbers(value: Any) -> np.ndarray | None:
    """A number or a flat list of numbers, some of which may be text; ``None`` for other things."""
    words = value if isinstance(value, list) else [value]
    try:  # OpenCV writes .Nan and .Inf, which Python reads without the dot
        words = [re.sub(r"\.(nan|inf)", r"\1", w.lower()) if isinstance(w, str) else w for w in words]
        return None if any(isinstance(w, bool) for w in words) else np.array([float(w) for w in words])
    except (TypeError, ValueError, OverflowError):
        return None


def _matrix(value: dict[str, Any], key: str) -> np.ndarray:
    sizes = value["sizes"] if "sizes" in value else [value.get("rows"), value.get("cols")]
    shape, numbers = _numbers(sizes), _numbers(value["data"])
    channels = CHANNELS.search(str(value["dt"]).strip('"'))
    if shape is None or numbers is None or not ((shape >= 0) & (shape < 1e9) & (shape % 1 == 0)).all():
        bad_value(key, "a matrix with rows, cols and data of numbers", "something else", CUT_OFF)
    axes = [int(side) for side in (*shape, *(channels.groups() if channels else ()))]
    if numbers.size != math.prod(axes):
        bad_value(key, f"{'x'.join(map(str, axes))} numbers", f"{numbers.size} numbers", CUT_OFF)
    return numbers.reshape(axes)
