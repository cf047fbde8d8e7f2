"""Entries by name of YAML, JSON, TOML, OpenCV's FileStorage and archives of numpy arrays.

OpenCV's own reader is not used: a damaged file can corrupt its memory, and calibrations come from strangers.
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

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import parse_xml

Entries = dict[str, Any]
#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")
#: A name and its value without a blank between them, which OpenCV reads, as in the settings of ORB-SLAM.
TIGHT_ENTRY = re.compile(r"(?m)^(\s*[A-Za-z_][\w.]*:)(?=[^\s:])")
#: A table, or a name and a list or a number, as TOML has them.
TOML_LINE = re.compile(
    r"(?m)^[ \t]*(?:\[+[\w.\"' -]+\]+|[\w.\"'-]+[ \t]*=[ \t]*[-+\d\[\"'tf].*)[ \t]*(?:#.*)?$"
)
#: Characters of a line that a message repeats.
MOST_OF_LINE = 60
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
    # Tabs separate words in files that OpenCV reads, and YAML has none.
    text = TIGHT_ENTRY.sub(r"\1 ", OPENCV_HEAD.sub("", text).replace("\t", " "))
    try:
        content = next(yaml.load_all(text, _Loader), None)  # noqa: S506  (a safe one)
    except yaml.MarkedYAMLError as error:
        end, mark = error.problem_mark, error.context_mark or error.problem_mark
        if mark is None or end is None or end.index >= len(text.rstrip()):  # it ends too early
            raise
        cure = "Correct the line; of another format give fx, fy, cx, cy and baseline, or K and E."
        line = text.splitlines()[mark.line].strip()[:MOST_OF_LINE]
        bad_value("the file", "YAML", f"{line!r} in line {mark.line + 1} ({error.problem})", cure)
    if not isinstance(content, dict):
        bad_value("the file", "a YAML file of named entries", type(content).__name__)
    return content


def read_content(text: str) -> Entries:
    """The mapping that a text in XML, TOML, YAML or JSON holds."""
    if "<opencv_storage" in text:
        return _of_element(parse_xml(text))
    if text.lstrip()[:1] != "{" and TOML_LINE.search(text):
        with suppress(tomllib.TOMLDecodeError):
            return tomllib.loads(text)
    # JSON is YAML; older versions of OpenCV write 1. and .Nan into it, which JSON itself does not know.
    return read_yaml(text)


def read_storage(text: str) -> Entries:
    """The entries of an OpenCV file by key in small letters: numbers as flat arrays, and strings."""
    content = read_content(text)
    entries: Entries = {}
    unclear = set[str]()  # names that entries of several parts have, and none of them is the file's own
    for key, value, level in _flat(content, ""):
        key, numbers = key.lower(), _numbers(without_sizes(value))
        value = value if numbers is None else numbers
        if level and key in entries and not np.array_equal(entries[key], value):
            unclear.add(key)
        entries[key] = value
    own = {str(key).lower() for key in content}
    return {key: value for key, value in entries.items() if key in own or key not in unclear}


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value


def without_sizes(value: Any) -> Any:
    """The ``data`` of a matrix that is written with its rows and columns; any other value as it is."""
    return value["data"] if _is_matrix(value) else value


#: What an outer name says of the camera: its side, or its number.
SIDE = re.compile(
    r"left|right|(?<=cam)[012](?!\d)|(?<=cam_)[012](?!\d)|(?<=camera)[012](?!\d)|(?<=camera_)[012](?!\d)"
)


def _flat(content: Entries, outer: str, level: int = 0) -> Iterator[tuple[str, Any, int]]:
    """Names, entries and levels, lower ones first, with the side of a camera where an outer name says one."""
    sides = set(SIDE.findall(outer.lower()))
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


def text_of_arrays(folder: Path) -> str:
    """The small arrays of a folder of ``.npy`` as JSON, for ``read_opencv``; empty where there are none.

    StereoVision and StereoPi's tutorial keep a calibration so: ``cam_mats_left.npy`` and so on.
    """
    matrices: Entries = {}
    for path in sorted(folder.glob("*.npy")):
        if path.stat().st_size <= 8 * MOST_NUMBERS + NPY_HEAD:
            with suppress(ValueError, OSError, EOFError):  # of objects, or damaged
                value = np.load(path, allow_pickle=False)
                if value.dtype.kind in "fiu" and value.size <= MOST_NUMBERS:
                    matrices[path.stem] = value.tolist()
    return json.dumps(matrices) if len(matrices) > 1 else ""


def _is_of_objects(archive: zipfile.ZipFile, name: str) -> bool:
    """Whether an array of an ``.npz`` holds objects of Python, which only unpickling would read."""
    with archive.open(name) as opened:
        return np.lib.format.read_magic(opened) == (1, 0) and bool(
            np.lib.format.read_array_header_1_0(opened)[2].hasobject
        )


def text_of_npz(path: Path) -> str:
    """The small arrays of an ``.npz`` as JSON, for ``read_opencv``; nothing is unpickled.

    Lists of pictures' corners and the like, which are objects, are left out.
    """
    matrices: Entries = {}
    try:
        with zipfile.ZipFile(path) as archive, np.load(path, allow_pickle=False) as arrays:
            small = [each for each in archive.infolist() if each.file_size <= 8 * MOST_NUMBERS + NPY_HEAD]
            names = [each.filename for each in small if not _is_of_objects(archive, each.filename)]
            for name in (each.removesuffix(".npy") for each in names):
                value = arrays[name]
                if value.dtype.kind in "fiu" and value.size <= MOST_NUMBERS:
                    matrices[name] = value.tolist()
    except Exception as error:  # of any kind that a damaged archive leads to
        bad_value("calibration", "a whole .npz of matrices", f"{path} ({error})", "Is it cut off?")
    if not matrices and len(names) < len(small):
        got = f"{path} of pickled objects, which are never loaded"
        bad_value("calibration", "a .npz of matrices", got, "Save every matrix as an array (numpy.savez).")
    return json.dumps(matrices)
