"""Reads the cameras of a spatial photo: a HEIC file with a stereo pair, as written by Apple's Image I/O.

Source: ISO/IEC 23008-12 (entity group ``ster``, properties ``cmin`` and ``cmex``); ``Box_cmin`` and
``Box_cmex`` in ``libheif/box.cc`` of strukturag/libheif, also for the two UUIDs under which Apple writes
these properties. Apple's sample code "Writing spatial photos" places the right camera on the positive x axis,
in metres, and the principal point of a central camera at half the image size.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.rigs import CameraChoice, RawCamera, intrinsics, make_rig, reading_file
from geodiff_plugin.types import Rig

#: Suffixes of the files.
SUFFIXES = (".heic", ".heif")
#: Key of the cameras in the text of a file.
MARK = "spatial_photo"
#: Kinds of properties that Apple writes as UUIDs.
UUIDS = {
    "22cc04c7d6d94e079d904eb6ecbaf3a3": b"cmin",
    "4363e9145b7d4aab97aebea69803b434": b"cmex",
}
#: Maximum size of the box with the properties, in bytes.
MAX_META = 1 << 24
#: Flags of ``cmex``: position along x, and everything else: along y and z, and a rotation.
X_PRESENT, OTHERS_PRESENT = 0x1, 0xE
#: Properties that turn, mirror or crop an image; an angle of 0 is no rotation.
CHANGES = {b"irot": "a rotation", b"imir": "a reflection", b"clap": "a crop"}
MICROMETRES = 1e6


class _Box(NamedTuple):
    kind: bytes
    data: bytes


def _boxes(data: bytes) -> Iterator[_Box]:
    """Yield the boxes in some bytes."""
    start = 0
    while start + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, start)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", data, start + 8), 16
        stop = start + size if size else len(data)
        if size and size < head or stop > len(data):
            raise ValueError("a box with a wrong size")
        content = data[start + head : stop]
        if kind == b"uuid":
            kind = UUIDS.get(content[:16].hex(), kind)
            content = content[16:]
        yield _Box(kind, content)
        start = stop


def _meta(path: Path) -> bytes:
    """Return the content of the box ``meta`` of a file, without reading its images."""
    with path.open("rb") as file:
        while head := file.read(8):
            size, kind = struct.unpack(">I4s", head)
            if kind == b"meta" and 12 <= size <= MAX_META:
                return file.read(size - 8)[4:]
            if size < 8:  # a box of 64-bit size or up to the end, as of images
                break
            file.seek(size - 8, 1)
    raise ValueError("no properties")


def _only(boxes: list[_Box], kind: bytes) -> bytes:
    """Return the content of the first box of a kind."""
    found = next((box.data for box in boxes if box.kind == kind), None)
    if found is None:
        raise ValueError(f"no box {kind.decode()}")
    return found


def _associations(data: bytes) -> dict[int, list[int]]:
    """Return the indices of the properties of every item, from 1 (box ``ipma``)."""
    version = data[0]
    is_wide = data[3] & 1
    (count,), at = struct.unpack_from(">I", data, 4), 8
    item = ">H" if version == 0 else ">I"
    index = ">H" if is_wide else ">B"
    indices: dict[int, list[int]] = {}
    for _ in range(count):
        (name,) = struct.unpack_from(item, data, at)
        at += struct.calcsize(item)
        number = data[at]
        at += 1
        values = [struct.unpack_from(index, data, at + n * struct.calcsize(index))[0] for n in range(number)]
        at += number * struct.calcsize(index)
        indices[name] = [value & (0x7FFF if is_wide else 0x7F) for value in values]
    return indices


def text_of_spatial_photo(path: Path) -> str:
    """Return the cameras of a spatial photo as JSON for ``read_spatial_photo``."""
    with reading_file(path, "spatial photo with cameras"):
        boxes = list(_boxes(_meta(path)))
        groups = [box.data for box in _boxes(_only(boxes, b"grpl")) if box.kind == b"ster"]
        if not groups:
            raise ValueError("no stereo pair")
        count, *items = struct.unpack_from(">III", groups[0], 8)
        if count != 2:
            raise ValueError(f"{count} images in its stereo pair")
        within = list(_boxes(_only(boxes, b"iprp")))
        properties = list(_boxes(_only(within, b"ipco")))
        indices = _associations(_only(within, b"ipma"))
        return json.dumps({MARK: [_camera([properties[i - 1] for i in indices[item]]) for item in items]})


def _camera(properties: list[_Box]) -> dict[str, Any]:
    """Return size, focal length, principal point and position of an image."""
    for kind, name in CHANGES.items():
        changes = [box.data for box in properties if box.kind == kind]
        if changes and not (kind == b"irot" and changes[0][0] & 3 == 0):
            raise ValueError(f"{name} of its images")
    camera, place = (_only(properties, kind) for kind in (b"cmin", b"cmex"))
    (flags,) = struct.unpack_from(">I", camera)
    values = struct.unpack_from(f">{4 if flags & 1 else 3}i", camera, 4)
    fx, cx, cy, fy = (value / 2 ** (flags >> 8 & 0x1F) for value in (*values, 0)[:4])
    (flags_of_place,) = struct.unpack_from(">I", place)
    if flags_of_place & OTHERS_PRESENT:
        raise ValueError("cameras that are rotated, or not next to each other along x")
    x = struct.unpack_from(">i", place, 4)[0] if flags_of_place & X_PRESENT else 0
    width, height = struct.unpack_from(">II", _only(properties, b"ispe"), 4)
    focal = [fx * width, fy * height if flags & 1 else fx * width]
    return {"size": [width, height], "focal": focal, "centre": [cx * width, cy * height], "x_um": x}


def read_spatial_photo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read the cameras of a spatial photo, as returned by ``text_of_spatial_photo``, the left one first."""
    cameras = json.loads(texts[0])[MARK]
    left, right = (
        RawCamera(intrinsics(*each["focal"], *(np.array(each["centre"]) - 0.5)), each["size"])
        for each in cameras
    )
    baseline_m = (cameras[1]["x_um"] - cameras[0]["x_um"]) / MICROMETRES
    if baseline_m == 0:
        bad_value("the positions of the cameras", "different", "the same")
    return make_rig(left, right, baseline_m)
