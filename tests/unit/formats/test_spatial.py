"""Cameras of spatial photos, from files in the layout that Apple's devices write: tiles, then two grids."""

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin import InputError
from geodiff_plugin.formats import read_calibration
from tests.unit.formats.heic_files import CMEX, CMIN, as_uuid, box, cmex, cmin, full

#: Focal length and principal point relative to the image.
FOCAL, CENTRE = 0.59588, (0.5, 0.48)
LEFT, RIGHT = 26, 52
LENS = cmin(FOCAL, *CENTRE)


SIZE = full(b"ispe", 0, struct.pack(">II", 2560, 1920))


def photo(
    path: Path, left: list[bytes], right: list[bytes], group: bytes = b"ster", wide: bool = False
) -> Path:
    """A file without pixels. A tile has a property of its own; all properties are marked as essential."""
    tile = full(b"ispe", 0, struct.pack(">II", 512, 512))
    every = [tile, *left, *right]
    places = {1: [1], LEFT: range(2, 2 + len(left)), RIGHT: range(2 + len(left), 2 + len(left) + len(right))}
    rows = b""
    for item, indices in places.items():
        rows += struct.pack(">I" if wide else ">H", item) + bytes([len(indices)])
        rows += b"".join(struct.pack(">H", 0x8000 | i) if wide else bytes([0x80 | i]) for i in indices)
    flags = 0x01000001 if wide else 0
    ipma = full(b"ipma", flags, struct.pack(">I", len(places)) + rows)
    members = struct.pack(">IIII", 53, 2, LEFT, RIGHT)
    parts = [
        full(b"hdlr", 0, bytes(21)),
        full(b"pitm", 0, struct.pack(">H", LEFT)),
        box(b"iprp", box(b"ipco", b"".join(every)) + ipma),
        box(b"grpl", full(group, 0, members)),
    ]
    path.write_bytes(
        box(b"ftyp", b"heic" + bytes(12)) + full(b"meta", 0, b"".join(parts)) + box(b"mdat", bytes(99))
    )
    return path


def pair(x_um: int = 63807, uuids: bool = True) -> tuple[list[bytes], list[bytes]]:
    cameras = [(LENS, cmex()), (LENS, cmex(x_um))]
    if uuids:
        cameras = [(as_uuid(each[0], CMIN), as_uuid(each[1], CMEX)) for each in cameras]
    return [SIZE, *cameras[0]], [SIZE, *cameras[1]]


@pytest.mark.parametrize("uuids", [True, False])
@pytest.mark.parametrize("wide", [True, False])
def test_cameras_are_read_from_both_images(tmp_path, uuids, wide):
    rig = read_calibration(photo(tmp_path / "pair.HEIC", *pair(uuids=uuids), wide=wide))
    K = [[FOCAL * 2560, 0, 1279.5], [0, FOCAL * 2560, 0.48 * 1920 - 0.5], [0, 0, 1]]
    for found in (rig.K_left, rig.K_right):
        np.testing.assert_allclose(found, K, atol=1e-5)
    expected = np.eye(4)
    expected[0, 3] = 0.063807
    np.testing.assert_allclose(rig.E, expected, atol=1e-12)
    assert rig.size_left == rig.size_right == (2560, 1920) and rig.unit == "m" and not rig.rectified


def test_focal_lengths_along_x_and_y_may_differ(tmp_path):
    left, right = pair()
    left[1] = right[1] = cmin(FOCAL, *CENTRE, fy=0.6)
    rig = read_calibration(photo(tmp_path / "pair.heif", left, right))
    assert rig.K_left[0, 0] == pytest.approx(FOCAL * 2560) and rig.K_left[1, 1] == pytest.approx(0.6 * 1920)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            {"right": [SIZE, LENS, cmex(63807, 2)]},
            "cameras that are rotated, or not next to each other",
        ),
        (
            {"right": [SIZE, LENS, cmex(63807, 8)]},
            "cameras that are rotated, or not next to each other",
        ),
        ({"right": [SIZE, LENS]}, "no box cmex"),
        ({"left": [SIZE]}, "no box cmin"),
        ({"right": [SIZE, LENS, cmex(5), box(b"irot", b"\x01")]}, "a rotation of its images"),
        ({"right": [SIZE, LENS, cmex(5), box(b"clap", bytes(32))]}, "a crop of its images"),
        ({"group": b"altr"}, "no stereo pair"),
        ({"right": [SIZE, LENS, cmex()]}, "must be different; got the same"),
        ({"right": [SIZE, LENS, cmex(-63807)]}, "the baseline must be positive"),
    ],
)
def test_files_without_cameras_that_can_be_used_say_why(tmp_path, more, message):
    left, right = pair()
    with pytest.raises(InputError, match=message):
        read_calibration(photo(tmp_path / "pair.heic", **{"left": left, "right": right} | more))


def test_an_angle_of_0_is_no_rotation(tmp_path):
    left, right = pair()
    plain = box(b"irot", b"\0")
    assert read_calibration(photo(tmp_path / "pair.heic", [*left, plain], [*right, plain])).E[0, 3] > 0


def test_damaged_files_raise_an_input_error(tmp_path):
    path = photo(tmp_path / "pair.heic", *pair())
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for n in range(300):
        changed = bytearray(data[: int(rng.integers(len(data)))] if n % 2 else data)
        for _ in range(3 if changed else 0):
            changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
        path.write_bytes(changed)
        with contextlib.suppress(InputError):
            read_calibration(path)
