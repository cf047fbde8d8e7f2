"""Stereo JPEG: which part of the image shows the left view, and whether the views are squeezed."""

import io
import struct

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.jps import read_jps


def head(flags: int, layout: int, kind: int, separation: int = 7) -> bytes:
    """A JPS header: block length, marker, separation, flags, layout and type."""
    return b"\xff\xd8\xff\xe3\x00\x10_JPSJPS_\x00\x04" + bytes([separation, flags, layout, kind])


@pytest.mark.parametrize(
    ("flags", "layout", "kind", "right_first", "expected"),
    [
        (4, 2, 1, False, "full"),
        (0, 2, 1, True, "full"),
        (6, 2, 1, False, "half"),
        (5, 2, 1, False, "full"),
        (0b11111011, 2, 1, True, "half"),
        (0b1100, 2, 1, False, "full"),
        (4, 3, 1, False, "over-under"),
        (1, 3, 1, True, "half-over-under"),
        (2, 3, 1, True, "over-under"),
        (4, 3, 0, False, None),
        (0, 1, 2, True, None),
        (4, 9, 1, False, None),
    ],
)
def test_the_header_states_the_layout_and_which_view_is_first(
    tmp_path, flags, layout, kind, right_first, expected
):
    for name in ("a.jps", "b.PNS"):
        (tmp_path / name).write_bytes(head(flags, layout, kind) + bytes(100))
        assert read_jps(tmp_path / name, "LEFT") == (right_first, expected)
    (tmp_path / "a.jpg").write_bytes(head(0, 2, 1))
    assert read_jps(tmp_path / "a.jpg", "LEFT") == (False, None)


@pytest.mark.parametrize(
    ("layout", "reported"), [(1, "interleaved rows"), (4, "an anaglyph without full colours")]
)
def test_other_layouts_are_rejected(tmp_path, layout, reported):
    (tmp_path / "a.jps").write_bytes(head(4, layout, 1))
    with pytest.raises(
        InputError,
        match=rf"\ALEFT must be both views next to or above each other; got .*a\.jps, which has {reported}\. "
        r"Pass two images as LEFT and RIGHT\.\Z",
    ):
        read_jps(tmp_path / "a.jps", "LEFT")


def test_images_without_a_header_have_the_right_view_first(tmp_path):
    (tmp_path / "a.jps").write_bytes(b"\xff\xd8" + bytes(100))
    assert read_jps(tmp_path / "a.jps", "LEFT") == (True, None)
    (tmp_path / "a.jps").write_bytes(bytes(70000) + head(4, 2, 1))
    assert read_jps(tmp_path / "a.jps", "LEFT") == (True, None)


def test_the_header_is_found_in_a_whole_file(tmp_path):
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(buffer, "JPEG")
    body = b"_JPSJPS_" + struct.pack(">H4B", 4, 0, 6, 2, 1) + struct.pack(">H", 5) + b"scene"
    segment = b"\xff\xe3" + struct.pack(">H", len(body) + 2) + body
    (tmp_path / "a.jps").write_bytes(buffer.getvalue()[:2] + segment + buffer.getvalue()[2:])
    assert read_jps(tmp_path / "a.jps", "LEFT") == (False, "half")
