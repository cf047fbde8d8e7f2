"""Reads the points of a PLY file, ASCII or binary, whatever else it holds.

Data flow: ``.ply`` -> ``(N, 3)`` x, y, z.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value

__all__ = ["read_ply_points"]

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: A head is text; none is near this size.
LONGEST_HEAD = 65_536
MOST_POINTS = 50_000_000


def _head(data: bytes, path: Path, name: str) -> tuple[str, int, list[tuple[str, str]], int]:
    """Format, number of points, their properties as ``(name, type)``, and where the data begins."""
    end = data.find(b"end_header", 0, LONGEST_HEAD)
    begin = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or begin == 0:
        bad_value(name, "a PLY file", f"{path} without a PLY head", "Is it cut off, or another format?")
    kind, count, properties, element = "", None, [], ""
    for line in data[:end].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            if words[1] == "vertex":
                count = int(words[2][:12])
            elif count is None:
                bad_value(name, "a PLY file whose first element is vertex", f"{path} with {words[1]!r} first")
            element = words[1]
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                bad_value(name, "a PLY file whose points have plain properties", f"{path} with {line!r}")
            properties.append((words[2], TYPES[words[1]]))
    names = [key for key, _ in properties]
    if kind not in ORDERS or not count or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        bad_value(name, "a PLY file with points (element vertex with x, y, z)", f"{path}, which has none")
    if count > MOST_POINTS:
        bad_value(name, f"at most {MOST_POINTS} points", f"{path} with {count}")
    return kind, count, properties, begin


def read_ply_points(path: Path, name: str = "points") -> np.ndarray:
    """The points of a PLY file.

    Args:
        path: an existing file.
        name: the argument that it came in, for messages.

    Returns:
        ``(N, 3)`` float64, in the file's unit and frame.

    Raises:
        ValueError: not PLY, no x, y, z, or cut off.
    """
    data = path.read_bytes()
    kind, count, properties, begin = _head(data, path, name)
    columns = [key for key, _ in properties]
    if kind == "ascii":
        lines = data[begin:].decode("latin-1").splitlines()[:count]
        try:
            table = np.array([[float(word) for word in line.split()[: len(columns)]] for line in lines])
        except ValueError:
            table = np.empty(0)
        if table.shape != (count, len(columns)):
            cure = "Is it cut off?"
            bad_value(name, f"{count} points of {len(columns)} numbers", f"{path} with others", cure)
        return table[:, [columns.index(axis) for axis in "xyz"]]
    row = np.dtype([(key, ORDERS[kind] + code) for key, code in properties])
    if len(data) - begin < count * row.itemsize:
        got = f"{path} with {len(data) - begin} bytes of them"
        bad_value(name, f"{count} points of {row.itemsize} bytes", got, "Is it cut off?")
    table = np.frombuffer(data, dtype=row, count=count, offset=begin)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
