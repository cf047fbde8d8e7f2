"""Stereo JPEG: which half of the image shows the left view."""

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import jps


def head(flags: int, layout: int, kind: int, separation: int = 7) -> bytes:
    """A JPS header: block length, marker, separation, flags, layout and type."""
    return b"\xff\xd8\xff\xe3\x00\x10_JPSJPS_\x00\x04" + bytes([separation, flags, layout, kind])


@pytest.mark.parametrize(
    ("flags", "layout", "kind", "right_first"),
    [
        (4, 2, 1, False),
        (0, 2, 1, True),
        (0b11111011, 2, 1, True),
        (0b1100, 2, 1, False),
        (4, 3, 0, False),
        (0, 1, 2, True),
        (4, 9, 1, False),
    ],
)
def test_the_header_tells_which_view_is_first(tmp_path, flags, layout, kind, right_first):
    for name in ("a.jps", "b.PNS"):
        (tmp_path / name).write_bytes(head(flags, layout, kind) + bytes(100))
        assert jps.has_right_view_first(tmp_path / name, "LEFT") is right_first
    (tmp_path / "a.jpg").write_bytes(head(0, 2, 1))
    assert jps.has_right_view_first(tmp_path / "a.jpg", "LEFT") is False


@pytest.mark.parametrize(
    ("layout", "reported"),
    [
        (1, "interleaved rows"),
        (3, "one view above the other"),
        (4, "an anaglyph, whose views have lost their colours"),
    ],
)
def test_other_layouts_are_refused(tmp_path, layout, reported):
    (tmp_path / "a.jps").write_bytes(head(4, layout, 1))
    with pytest.raises(
        InputError,
        match=rf"\ALEFT must be both views side by side; got .*a\.jps, which holds {reported}\. "
        r"Give two pictures as LEFT and RIGHT\.\Z",
    ):
        jps.has_right_view_first(tmp_path / "a.jps", "LEFT")


def test_images_without_a_header_have_the_right_view_first(tmp_path):
    (tmp_path / "a.jps").write_bytes(b"\xff\xd8" + bytes(100))
    assert jps.has_right_view_first(tmp_path / "a.jps", "LEFT")
    (tmp_path / "a.jps").write_bytes(bytes(70000) + head(4, 2, 1))
    assert jps.has_right_view_first(tmp_path / "a.jps", "LEFT")
