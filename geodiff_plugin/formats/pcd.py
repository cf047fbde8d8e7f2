"""Reads points of PCD files: ASCII, binary or compressed.

Source: PCL's description of the format, version 0.7, whose compressed form is LZF.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodiff_plugin._internal.checks import bad_value, raise_input_error

#: numpy type codes of PCD types.
TYPES = {"F": "f", "U": "u", "I": "i"}
HEAD = re.compile(rb"[\s\S]{0,4000}?^DATA[ \t]+(\w+)[ \t]*\r?\n", re.MULTILINE)
DAMAGED = "The compressed numbers are damaged."
HINT = "It may be truncated, or in a different format."
#: Number of bytes of the compressed and uncompressed sizes, before the compressed data.
SIZES_BYTES = 8
#: LZF: a control byte below this is the number of literal bytes minus one; others start a copy.
FIRST_COPY_BYTE = 32
#: Copies with this length in the control byte have a further length byte.
LONG_COPY = 7


@dataclass(frozen=True)
class _Layout:
    """Layout in the header: ``columns`` of the ``fields`` begin at ``starts`` of a row."""

    row: np.dtype
    fields: list[str]
    counts: list[int]
    points: int

    @property
    def starts(self) -> np.ndarray:
        return np.cumsum([0, *self.counts])[[self.fields.index(axis) for axis in "xyz"]]


def read_pcd_points(path: Path, name: str = "points") -> np.ndarray:
    """Read the known points ``(N, 3)`` of a PCD file, in the file's unit and frame."""
    data = path.read_bytes()
    head = HEAD.match(data)
    if head is None:
        bad_value(name, "a whole PCD file", path, HINT)
    try:
        layout = _layout(head.group().decode("ascii", errors="replace"))
        body = data[head.end() :]
        reader = {b"ascii": _ascii, b"binary": _binary, b"binary_compressed": _compressed}[head.group(1)]
        xyz = reader(body, layout)
    except Exception:  # any error that a damaged file may cause
        bad_value(name, "a whole PCD file with x, y and z", path, HINT)
    if len(xyz) != layout.points:
        expected = f"a PCD file with {layout.points} points as in its header"
        bad_value(name, expected, f"{path} with {len(xyz)}", HINT)
    return xyz[np.isfinite(xyz).all(axis=1)]


def _layout(head: str) -> _Layout:
    lines = (line.split() for line in head.splitlines())
    entries = {words[0]: words[1:] for words in lines if words and words[0][0] != "#"}
    fields = entries["FIELDS"]
    counts = [int(count) for count in entries.get("COUNT", ["1"] * len(fields))]
    kinds = [f"<{TYPES[kind]}{size}" for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=True)]
    unique = [f"{number} {field}" for number, field in enumerate(fields)]  # padding fields are all called _
    unique = [field if field in "xyz" else other for field, other in zip(fields, unique, strict=True)]
    row = np.dtype([(f, k, (n,)) for f, k, n in zip(unique, kinds, counts, strict=True)])
    return _Layout(row, fields, counts, int(entries["POINTS"][0]))


def _ascii(body: bytes, layout: _Layout) -> np.ndarray:
    return np.array([line.split() for line in body.splitlines()[: layout.points]], float)[:, layout.starts]


def _binary(body: bytes, layout: _Layout) -> np.ndarray:
    rows = np.frombuffer(body, layout.row, layout.points)
    return np.stack([rows[axis][:, 0] for axis in "xyz"], axis=1).astype(np.float64)


def _compressed(body: bytes, layout: _Layout) -> np.ndarray:
    """Read compressed data, which is stored field by field."""
    packed, size = (int(number) for number in np.frombuffer(body, "<u4", 2))
    if size != layout.points * layout.row.itemsize:
        raise_input_error(DAMAGED)
    plain = _decompressed(body[SIZES_BYTES : SIZES_BYTES + packed], size)
    columns = {}
    start = 0
    for field in layout.row.names or ():
        kind = layout.row[field]  # includes the field's count
        columns[field] = np.frombuffer(plain, kind, layout.points, start).reshape(layout.points, -1)[:, 0]
        start += layout.points * kind.itemsize
    return np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)


def _decompressed(data: bytes, size: int) -> bytes:
    """Decompress LZF: runs of literal bytes, and copies of bytes ``distance`` earlier."""
    plain = bytearray()
    at = 0
    while at < len(data) and len(plain) <= size:
        control = data[at]
        at += 1
        if control < FIRST_COPY_BYTE:
            plain += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == LONG_COPY:
            length += data[at]
            at += 1
        distance = ((control & 0x1F) << 8) + data[at] + 1
        at += 1
        start = len(plain) - distance
        length = length + 2
        if start < 0:
            raise_input_error(DAMAGED)
        pattern = bytes(plain[start : start + length])  # shorter if the copy overlaps itself
        plain += (pattern * (length // len(pattern) + 1))[:length]
    if len(plain) != size:
        raise_input_error(DAMAGED)
    return bytes(plain)
