"""One file with both views: stereo JPEG by its head, MPO by the kinds of its pictures."""

import io
import struct

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats.images import pages_of_both
from geodiff_plugin.formats.jps import has_right_view_first


def jpeg(head: bytes = b"") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((8, 16, 3), np.uint8)).save(buffer, "JPEG")
    whole = buffer.getvalue()
    return whole[:2] + head + whole[2:]


def jps(flags: int, layout: int, kind: int = 1) -> bytes:
    """APP3 of a stereo JPEG: mark, length of the block, separation, flags, layout, kind, and a comment."""
    body = b"_JPSJPS_" + struct.pack(">H4B", 4, 0, flags, layout, kind) + struct.pack(">H", 5) + b"scene"
    return b"\xff\xe3" + struct.pack(">H", len(body) + 2) + body


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.jps", jpeg(jps(4, 2)), False),
        ("a.jps", jpeg(jps(0, 2)), True),
        ("a.JPS", jpeg(jps(6, 2)), False),
        ("a.jps", jpeg(), True),
        ("a.pns", b"\x89PNG", True),
        ("a.jpg", jpeg(), False),
        ("a.png", b"\x89PNG", False),
    ],
)
def test_which_half_shows_the_left_view(tmp_path, name, data, expected):
    (tmp_path / name).write_bytes(data)
    assert has_right_view_first(tmp_path / name, "LEFT") is expected


@pytest.mark.parametrize(("layout", "said"), [(1, "interleaved"), (3, "above the other"), (4, "an anaglyph")])
def test_layouts_that_are_not_side_by_side_are_named(tmp_path, layout, said):
    (tmp_path / "a.jps").write_bytes(jpeg(jps(4, layout)))
    with pytest.raises(InputError, match=f"both views side by side; got .*{said}.*LEFT and RIGHT"):
        has_right_view_first(tmp_path / "a.jps", "LEFT")


#: Kinds of CIPA DC-007 as the index of an MPO file holds them.
PREVIEW, OTHER_VIEW = 0x010002, 0x020002


@pytest.mark.parametrize("kind", [PREVIEW, OTHER_VIEW])
def test_a_preview_in_an_mpo_file_is_no_second_view(tmp_path, kind):
    left, right = (Image.fromarray(np.full((8, 12, 3), grey, np.uint8)) for grey in (90, 120))
    path = tmp_path / "pair.mpo"
    left.save(path, "MPO", save_all=True, append_images=[right])
    data = bytearray(path.read_bytes())
    second = data.index(b"MPF\0") + 4 + 50 + 16  # of the entries, 16 bytes each, behind those of the head
    data[second : second + 4] = struct.pack("<I", kind)
    path.write_bytes(data)
    if kind == OTHER_VIEW:
        assert pages_of_both(path, "LEFT") == (0, 1)
        return
    with pytest.raises(InputError, match="an MPO file of two views; got .* of one view and its preview"):
        pages_of_both(path, "LEFT")
