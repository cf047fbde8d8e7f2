"""Files that are nearly right, values that are nearly right, and the one property that all must have."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from PIL import Image

from geodiff_plugin._checks import InputError

__all__ = [
    "EXAMPLES",
    "MANY",
    "damaged",
    "file_names",
    "image_bytes",
    "junk",
    "point_files",
    "survives",
]

COMMON: dict[str, Any] = {
    "deadline": None,
    "database": None,
    "derandomize": True,
    "suppress_health_check": list(HealthCheck),
}
EXAMPLES = settings(max_examples=25, **COMMON)
MANY = settings(max_examples=int(os.environ.get("GEODIFF_FUZZ", "1500")), **COMMON)

WORDS = b"nan inf -inf 1e999 -1 0 1e-300 [ ] { } : , ; = < > 1e5 # rows:"
TOKENS = [
    *WORDS.split(),
    b"\n",
    b" ",
    b'"',
    b"\0",
    b"\xff\xfe",
    b"9" * 400,
    b"[" * 3000,
    b"rows: 99999999999",
]


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A file with a few of its pieces cut out, doubled, overwritten or spoiled."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(0, 4))):
        start = draw(st.integers(0, max(0, len(data))))
        stop = min(len(data), start + draw(st.sampled_from([0, 1, 2, 8, 64, len(whole)])))
        kind = draw(st.sampled_from(["cut", "token", "bytes", "double"]))
        piece = {
            "cut": b"",
            "token": draw(st.sampled_from(TOKENS)),
            "bytes": draw(st.binary(max_size=8)),
            "double": bytes(data[start:stop]) * 2,
        }[kind]
        data[start:stop] = piece
    return bytes(data)


def image_bytes() -> dict[str, bytes]:
    """A small image in every format that people send."""
    pixels = np.random.default_rng(0).integers(0, 255, (40, 48, 3), dtype=np.uint8)
    found = {}
    for kind in ("PNG", "JPEG", "BMP", "TIFF", "GIF", "WEBP", "PPM", "TGA"):
        with contextlib.suppress(OSError, KeyError):  # Pillow without that codec
            buffer = io.BytesIO()
            Image.fromarray(pixels).save(buffer, format=kind)
            found[kind.lower()] = buffer.getvalue()
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0xA405: 28, 0x920A: 4.2, 0xA002: 48, 0xA003: 40, 0xA20E: 9000.0})
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", exif=exif)
    found["exif.jpeg"] = buffer.getvalue()
    buffer = io.BytesIO()
    Image.fromarray(pixels[..., 0].astype(np.uint16) * 200).save(buffer, format="PNG")
    return found | {"grey16.png": buffer.getvalue()}


def point_files() -> dict[str, bytes]:
    """A whole file of known depths of every kind, by suffix."""
    table = np.random.default_rng(0).uniform(0.5, 5, (12, 3))
    buffer = io.BytesIO()
    np.save(buffer, table)
    head = "ply\nformat {} 1.0\nelement vertex 12\nproperty double x\nproperty double y\nproperty double z\n"
    text = "\n".join(" ".join(f"{v:.3f}" for v in row) for row in table)
    return {
        ".npy": buffer.getvalue(),
        ".txt": text.encode(),
        ".csv": ("x,y,z\n" + text.replace(" ", ",")).encode(),
        ".ply": (head.format("binary_little_endian") + "end_header\n").encode() + table.tobytes(),
        ".PLY": (head.format("ascii") + "end_header\n" + text + "\n").encode(),
        ".pfm": b"Pf\n4 3\n-1.0\n" + table[:, 0].astype("<f4").tobytes(),
        ".png": image_bytes()["grey16.png"],
        ".bin": np.random.default_rng(0).uniform(1, 9, (8, 4)).astype("<f4").tobytes(),
    }


def file_names() -> st.SearchStrategy[str]:
    """Names as a file system may have them, and longer ones."""
    text = st.text(st.characters(blacklist_characters="\0"), min_size=1, max_size=300)
    return st.one_of(
        text, st.sampled_from(["x" * 300, "a/" * 2500, "~", "-", "..", "/dev/null", "/dev/zero"])
    )


def _numbers() -> st.SearchStrategy[Any]:
    return st.one_of(st.floats(), st.integers(), st.integers(-(10**40), 10**40), st.booleans())


def junk() -> st.SearchStrategy[Any]:
    """Values of every kind that an argument may be given by mistake."""
    few = st.one_of(
        st.none(),
        _numbers(),
        st.text(max_size=5),
        st.binary(max_size=3),
        st.sampled_from([Path("x"), object()]),
    )
    shapes = st.sampled_from(
        [(3, 3), (4, 4), (3, 4), (40, 48, 3), (40, 48), (5, 3), (2, 2), (0,), (1, 3, 40, 48)]
    )
    kinds = st.sampled_from(["f4", "f8", "u1", "u2", "i8", "?", "c8", "O", "U3"])
    fills = st.sampled_from([0.0, 1.0, -1.0, 0.5, 300.0, np.nan, np.inf])

    def array(shape: tuple[int, ...], kind: str, fill: float) -> np.ndarray:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            finite = fill if kind[0] in "fcO" else float(np.nan_to_num(fill, posinf=9.0))
            return np.full(shape, finite).astype(kind)

    arrays = st.builds(array, shapes, kinds, fills)
    return st.recursive(
        st.one_of(few, arrays),
        lambda inner: st.one_of(
            st.lists(inner, max_size=3),
            st.lists(inner, max_size=3).map(tuple),
            st.dictionaries(st.text(max_size=4), inner, max_size=2),
        ),
        max_leaves=4,
    )


def _too_long(*_: Any) -> None:
    raise AssertionError("it took more than 20 seconds")


def survives(call: Callable[[], Any]) -> bool:
    """Whether the call understood its input; an error that is not one of our sentences is the test's."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(20)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
    except InputError as error:
        assert "\n" not in str(error).strip() and len(str(error)) < 2000, str(error)
        return False
    finally:
        signal.alarm(0)
    return True
