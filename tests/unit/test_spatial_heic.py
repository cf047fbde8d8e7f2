"""Spatial photographs: HEIC files whose entity group ``ster`` names the left and the right picture."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats.images import pages_of_both
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from tests.fuzz.test_fuzz import EXAMPLES, damaged, survives

pillow_heif = pytest.importorskip("pillow_heif", minversion="1.8")
CAMERA = {"fx": 60.0, "baseline": 0.12}


def boxes(data: bytes, start: int, stop: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the boxes of a file."""
    while start < stop:
        size, kind = struct.unpack_from(">I4s", data, start)
        yield kind, start, start + size
        start += size


def with_group(whole: bytes, kind: bytes, order: tuple[int, ...]) -> bytes:
    """A HEIC file with a box ``grpl`` of one group of its pictures, counted from 0, after the standard."""
    data = bytearray(whole)
    start, stop = next((a, b) for name, a, b in boxes(data, 0, len(data)) if name == b"meta")
    at = next(a for name, a, _ in boxes(data, start + 12, stop) if name == b"iloc")
    assert data[at + 8] == 0 and data[at + 12 : at + 14] == b"\x44\x40"  # version 0, all of four bytes
    (count,) = struct.unpack_from(">H", data, at + 14)
    items, places, at = [], [], at + 16
    for _ in range(count):
        number, extents = struct.unpack_from(">H6xH", data, at)
        items.append(number)
        places += [at + 10 + 8 * extent for extent in range(extents)]
        at += 10 + 8 * extents
    members = b"".join(struct.pack(">I", items[picture]) for picture in order)
    group = struct.pack(">I4sIII", 20 + len(members), kind, 0, 77, len(order)) + members
    group = struct.pack(">I4s", 8 + len(group), b"grpl") + group
    for place in places:  # pictures lie behind it
        struct.pack_into(">I", data, place, struct.unpack_from(">I", data, place)[0] + len(group))
    struct.pack_into(">I", data, start, stop - start + len(group))
    return bytes(data[:stop] + group + data[stop:])


@pytest.fixture
def views(textured_plane) -> list[Image.Image]:
    return [Image.fromarray(view) for view in (textured_plane.left, textured_plane.right)]


def spatial(path: Path, views, kind: bytes = b"ster", order: tuple[int, ...] = (1, 0)) -> Path:
    """The right picture first, as the main one, and then the left one."""
    pillow_heif.register_heif_opener()
    views[1].save(path, save_all=True, append_images=[views[0]], quality=-1)
    path.write_bytes(with_group(path.read_bytes(), kind, order))
    return path


def test_the_left_and_the_right_picture_are_those_that_the_group_names(tmp_path, views, textured_plane):
    path = spatial(tmp_path / "spatial.heic", views)
    assert pages_of_both(path, "LEFT") == (1, 0)
    pair = read_pair(DepthOptions(left=path, **CAMERA))
    right = pair.guidance.rights[0].permute(1, 2, 0).numpy()
    off = [
        [np.abs(got - view / 255).mean() for view in (textured_plane.left, textured_plane.right)]
        for got in (pair.left, right)
    ]
    # Colours are coded at half the resolution.
    assert max(off[0][0], off[1][1]) < 0.05 < 0.1 < min(off[0][1], off[1][0])
    path = spatial(tmp_path / "other.HEIC", views, order=(0, 1))
    assert pages_of_both(path, "LEFT") == (0, 1)


def test_a_file_without_a_stereo_pair_is_refused_with_the_cure(tmp_path, views):
    path = spatial(tmp_path / "burst.heic", views, b"altr")
    with pytest.raises(InputError, match="spatial HEIC file .*2 pictures.*Give the right view as RIGHT"):
        read_pair(DepthOptions(left=path, **CAMERA))


def test_one_heic_a_view_stays_a_pair(tmp_path, views):
    pillow_heif.register_heif_opener()
    for name, view in zip(("l.heic", "r.heic"), views, strict=True):
        view.save(tmp_path / name, quality=-1)
    pair = read_pair(DepthOptions(left=tmp_path / "l.heic", right=tmp_path / "r.heic", **CAMERA))
    assert np.abs(pair.left - np.asarray(views[0]) / 255).mean() < 0.05


def test_a_damaged_spatial_photograph_is_a_sentence_or_read(tmp_path, views):
    path = spatial(tmp_path / "spatial.heic", views)

    @EXAMPLES
    @given(data=damaged(path.read_bytes()))
    def check(data):
        path.write_bytes(data)
        survives(lambda: read_pair(DepthOptions(left=path, **CAMERA)))

    check()
