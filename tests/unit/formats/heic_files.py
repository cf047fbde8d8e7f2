"""Spatial photos with pixels: files of pillow-heif, with a group and properties after the standard."""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

#: Names under which Apple's devices write the properties of a camera.
CMIN = bytes.fromhex("22cc04c7d6d94e079d904eb6ecbaf3a3")
CMEX = bytes.fromhex("4363e9145b7d4aab97aebea69803b434")
#: Numbers of a camera have the denominator 2 ** 30.
SHIFT = 30


def box(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(data), kind) + data


def full(kind: bytes, flags: int, data: bytes) -> bytes:
    return box(kind, struct.pack(">I", flags) + data)


def as_uuid(plain: bytes, name: bytes) -> bytes:
    return box(b"uuid", name + plain[8:])


def fixed(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 2**SHIFT)) for value in values)


def cmin(fx: float, cx: float, cy: float, fy: float | None = None) -> bytes:
    """Focal length and principal point, relative to the image; with ``fy`` and no skew if it differs."""
    more = b"" if fy is None else fixed(fy) + struct.pack(">i", 0)
    return full(b"cmin", SHIFT << 8 | (fy is not None), fixed(fx, cx, cy) + more)


def cmex(x_um: int = 0, further: int = 0) -> bytes:
    """The position along x in micrometres; 0 is left out."""
    values = struct.pack(">i", x_um) * bool(x_um) + struct.pack(">i", 9) * bool(further)
    return full(b"cmex", bool(x_um) | further, values)


def boxes(data: bytes, start: int = 0) -> Iterator[tuple[bytes, bytes]]:
    """Kinds and contents of boxes, from an offset on."""
    while start < len(data):
        size, kind = struct.unpack_from(">I4s", data, start)
        yield kind, bytes(data[start + 8 : start + size])
        start += size


def _located(iloc: bytes, more: int) -> tuple[list[int], bytes]:
    """The items of a file, and their places after ``more`` bytes were put before their data."""
    assert iloc[0] == 0 and iloc[4:6] == b"\x44\x40", "version 0, all of four bytes"
    moved, items, at = bytearray(iloc), list[int](), 8
    for _ in range(struct.unpack_from(">H", iloc, 6)[0]):
        item, extents = struct.unpack_from(">H6xH", iloc, at)
        items.append(item)
        for place in range(at + 10, at + 10 + 8 * extents, 8):
            struct.pack_into(">I", moved, place, struct.unpack_from(">I", iloc, place)[0] + more)
        at += 10 + 8 * extents
    return items, bytes(moved)


def _with_properties(iprp: bytes, further: dict[int, Sequence[bytes]]) -> bytes:
    """The properties of a file and of some of its items."""
    (_, ipco), (_, ipma) = boxes(iprp)
    assert ipma[:4] == bytes(4), "items of two bytes, indices of one"
    number, rows, at = len(list(boxes(ipco))), ipma[:8], 8
    while at < len(ipma):
        (item,), count = struct.unpack_from(">H", ipma, at), ipma[at + 2]
        more = further.get(item, ())
        indices = ipma[at + 3 : at + 3 + count] + bytes(number + 1 + k for k in range(len(more)))
        rows += ipma[at : at + 2] + bytes([len(indices)]) + indices
        ipco, number, at = ipco + b"".join(more), number + len(more), at + 3 + count
    return box(b"ipco", ipco) + box(b"ipma", rows)


def with_group(
    whole: bytes, order: tuple[int, ...], kind: bytes = b"ster", further: Sequence[Sequence[bytes]] = ()
) -> bytes:
    """A HEIC file with a group of its images, counted from 0, and ``further`` properties of each of them."""
    parts = list(boxes(whole))
    meta = dict(parts)[b"meta"]
    items, _ = _located(dict(boxes(meta, 4))[b"iloc"], 0)
    own = {items[n]: properties for n, properties in enumerate(further)}
    members = b"".join(struct.pack(">I", items[n]) for n in order)
    group = box(b"grpl", full(kind, 0, struct.pack(">II", 77, len(order)) + members))

    def meta_moved_by(more: int) -> bytes:
        changed = meta[:4]
        for name, content in boxes(meta, 4):
            if name == b"iloc":
                content = _located(content, more)[1]
            if name == b"iprp":
                content = _with_properties(content, own)
            changed += box(name, content)
        return changed + group

    growth = len(meta_moved_by(0)) - len(meta)  # the data of the images follow
    return b"".join(box(name, meta_moved_by(growth) if name == b"meta" else data) for name, data in parts)


def write_spatial_photo(
    path: Path, images: tuple[np.ndarray, np.ndarray], K: np.ndarray, baseline_m: float
) -> None:
    """Both images ``(H, W, 3)`` uint8 with their cameras, as Apple's devices write them."""
    left, right = map(Image.fromarray, images)
    left.save(path, save_all=True, append_images=[right], quality=95)
    width, height = left.size
    camera = cmin(K[0, 0] / width, (K[0, 2] + 0.5) / width, (K[1, 2] + 0.5) / height)
    places = cmex(), cmex(round(1e6 * baseline_m))
    further = [(as_uuid(camera, CMIN), as_uuid(place, CMEX)) for place in places]
    path.write_bytes(with_group(path.read_bytes(), (0, 1), further=further))
