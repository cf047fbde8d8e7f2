"""Reads named entries of YAML, JSON, TOML, OpenCV's FileStorage and archives of numpy arrays.

OpenCV's own reader is not used, because a damaged file can corrupt its memory, and calibrations are untrusted
input.
"""

from __future__ import annotations

import json
import re
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import parse_xml

Entries = dict[str, Any]
#: Matches OpenCV's YAML header, which is invalid YAML; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")
#: Matches a name and value without a blank in between, which OpenCV accepts, as in ORB-SLAM's settings.
TIGHT_ENTRY = re.compile(r"(?m)^(\s*[A-Za-z_][\w.]*:)(?=[^\s:])")
#: Matches a TOML table, or a TOML name with a list, number or string.
TOML_LINE = re.compile(
    r"(?m)^[ \t]*(?:\[+[\w.\"' -]+\]+|[\w.\"'-]+[ \t]*=[ \t]*[-+\d\[\"'tf].*)[ \t]*(?:#.*)?$"
)
#: Maximum number of characters of a line that a message quotes.
MAX_LINE_LENGTH = 60
#: Maximum nesting of entries.
MAX_LEVELS = 8
#: Maximum number of aliases; dumps of programs that share a list have a few.
MAX_ALIASES = 32
#: Maximum number of values of an array in an .npz: camera arrays have at most 16, lens arrays 14.
MAX_NUMBERS = 64
#: Maximum number of bytes before the values of an array in an .npz.
NPY_HEAD = 256


class _Loader(yaml.SafeLoader):
    """YAML as written by OpenCV: its matrices (since OpenCV 5 also with one axis) are ordinary mappings.

    An alias may only refer to a part without aliases: nested aliases can expand a kilobyte to gigabytes.
    """

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._aliases, self._holding = 0, set[int]()  # count of aliases, and nodes that contain any

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node; raise an error for aliases that contain others, or too many aliases."""
        is_alias = self.check_event(yaml.events.AliasEvent)
        before = self._aliases
        node = super().compose_node(parent, index)
        if is_alias:
            self._aliases += 1
            # A node without an end refers to itself.
            if self._aliases > MAX_ALIASES or id(node) in self._holding or node.end_mark is None:
                expected = f"YAML with at most {MAX_ALIASES} aliases, none of them nested"
                bad_value("the file", expected, "more", "Replace the aliases (*name) by their content.")
        elif self._aliases > before:
            self._holding.add(id(node))
        return node


for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_kind}", lambda loader, node: loader.construct_mapping(node, deep=True)
    )


def read_yaml(text: str) -> Entries:
    """Read the mapping in the first YAML document; ignores later documents (``rostopic echo``)."""
    # Files that OpenCV reads may separate words by tabs, which YAML forbids.
    text = TIGHT_ENTRY.sub(r"\1 ", OPENCV_HEAD.sub("", text).replace("\t", " "))
    try:
        content = next(yaml.load_all(text, _Loader), None)  # noqa: S506  (a safe one)
    except yaml.MarkedYAMLError as error:
        end = error.problem_mark
        mark = error.context_mark or error.problem_mark
        if mark is None or end is None or end.index >= len(text.rstrip()):  # truncated
            raise
        hint = "Correct the line, or pass fx, fy, cx, cy and baseline, or K and E."
        line = text.splitlines()[mark.line].strip()[:MAX_LINE_LENGTH]
        bad_value("the file", "YAML", f"{line!r} in line {mark.line + 1} ({error.problem})", hint)
    if not isinstance(content, dict):
        bad_value("the file", "a YAML file of named entries", type(content).__name__)
    return content


def read_content(text: str) -> Entries:
    """Read the mapping in a text in XML, TOML, YAML or JSON."""
    if "<opencv_storage" in text:
        return _of_element(parse_xml(text))
    if text.lstrip()[:1] != "{" and TOML_LINE.search(text):
        with suppress(tomllib.TOMLDecodeError):
            return tomllib.loads(text)
    # JSON is YAML. Older versions of OpenCV write "1." and ".Nan" to it, which are invalid in JSON.
    return read_yaml(text)


def read_storage(text: str) -> Entries:
    """Return the entries of an OpenCV file by key in lower case: flat number arrays, and strings."""
    content = read_content(text)
    entries: Entries = {}
    unclear = set[str]()  # names that occur in several sections, none of them top-level
    for key, value, level in _flat(content, ""):
        key = key.lower()
        numbers = _numbers(without_sizes(value))
        value = value if numbers is None else numbers
        if level and key in entries and not np.array_equal(entries[key], value):
            unclear.add(key)
        entries[key] = value
    own = {str(key).lower() for key in content}
    return {key: value for key, value in entries.items() if key in own or key not in unclear}


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value


def without_sizes(value: Any) -> Any:
    """Return the ``data`` of a matrix written with rows and columns; other values unchanged."""
    return value["data"] if _is_matrix(value) else value


#: Matches a camera's side or number in an outer name.
SIDE = re.compile(
    r"left|right|(?<=cam)[012](?!\d)|(?<=cam_)[012](?!\d)|(?<=camera)[012](?!\d)|(?<=camera_)[012](?!\d)"
)


def _flat(content: Entries, outer: str, level: int = 0) -> Iterator[tuple[str, Any, int]]:
    """Yield names, entries and levels, inner ones first, with the camera's side if an outer name has one."""
    sides = set(SIDE.findall(outer.lower()))
    side = f"{sides.pop()}." if len(sides) == 1 else ""
    for key, value in content.items():
        if isinstance(value, dict) and not _is_matrix(value) and level < MAX_LEVELS:
            yield from _flat(value, f"{outer}.{key}", level + 1)
    for key, value in content.items():
        yield f"{side}{key}", value, level


def _of_element(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _of_element(child) for child in node}
    words = (node.text or "").split()
    return words[0] if len(words) == 1 and node.tag != "data" else words


def _numbers(value: Any) -> np.ndarray | None:
    """Return a number, or the numbers of (nested) lists, possibly as text; otherwise ``None``."""
    words = value if isinstance(value, list) else [value]
    while any(isinstance(word, list) for word in words):
        words = [part for word in words for part in (word if isinstance(word, list) else [word])]
    try:  # OpenCV writes .Nan and .Inf, which Python parses without the dot
        words = [re.sub(r"\.(nan|inf)", r"\1", w.lower()) if isinstance(w, str) else w for w in words]
        return None if any(isinstance(w, bool) for w in words) else np.array([float(w) for w in words])
    except (TypeError, ValueError, OverflowError):
        return None


def text_of_arrays(folder: Path) -> str:
    """Return the small arrays of a folder of ``.npy`` as JSON for ``read_named``; empty if there are none.

    StereoVision and StereoPi's tutorial store calibrations this way: ``cam_mats_left.npy`` etc.
    """
    matrices: Entries = {}
    for path in sorted(folder.glob("*.npy")):
        if path.stat().st_size <= 8 * MAX_NUMBERS + NPY_HEAD:
            with suppress(ValueError, OSError, EOFError):  # arrays of objects, or damaged files
                value = np.load(path, allow_pickle=False)
                if value.dtype.kind in "fiu" and value.size <= MAX_NUMBERS:
                    matrices[path.stem] = value.tolist()
    return json.dumps(matrices) if len(matrices) > 1 else ""


def _is_of_objects(archive: zipfile.ZipFile, name: str) -> bool:
    """Whether an array of an ``.npz`` contains Python objects, which only unpickling would read."""
    with archive.open(name) as opened:
        return np.lib.format.read_magic(opened) == (1, 0) and bool(
            np.lib.format.read_array_header_1_0(opened)[2].hasobject
        )


def text_of_npz(path: Path) -> str:
    """Return the small arrays of an ``.npz`` as JSON for ``read_named``; never unpickles.

    Skips object arrays, such as lists of corners per image.
    """
    matrices: Entries = {}
    try:
        with zipfile.ZipFile(path) as archive, np.load(path, allow_pickle=False) as arrays:
            small = [each for each in archive.infolist() if each.file_size <= 8 * MAX_NUMBERS + NPY_HEAD]
            names = [each.filename for each in small if not _is_of_objects(archive, each.filename)]
            for name in (each.removesuffix(".npy") for each in names):
                value = arrays[name]
                if value.dtype.kind in "fiu" and value.size <= MAX_NUMBERS:
                    matrices[name] = value.tolist()
    except Exception as error:  # any error that a damaged archive may cause
        bad_value("calibration", "a whole .npz of matrices", f"{path} ({error})", "It may be truncated.")
    if not matrices and len(names) < len(small):
        got = f"{path} with pickled objects, which are never loaded"
        bad_value("calibration", "a .npz of matrices", got, "Save every matrix as an array (numpy.savez).")
    return json.dumps(matrices)
