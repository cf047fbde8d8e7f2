"""Files of known depths: every kind gives the same metres, and what is none says so."""

from __future__ import annotations

import numpy as np
import pytest

from geodiff_plugin.formats import read_points, write_depth_mm_png, write_pfm

MAP = np.zeros((6, 8), np.float32)
MAP[1, 2], MAP[4, 5] = 1.25, 3.5
POINTS = np.array([[0.1, -0.2, 2.0], [0.4, 0.3, 5.5]], np.float32)


def test_maps_of_every_kind_are_the_same(tmp_path):
    write_depth_mm_png(tmp_path / "map.png", MAP)
    write_pfm(tmp_path / "map.pfm", np.where(MAP > 0, MAP, np.inf))
    np.save(tmp_path / "map.npy", np.where(MAP > 0, MAP, np.nan).astype(np.float64))
    for name in ("map.png", "map.pfm", "map.npy"):
        read = read_points(tmp_path / name)
        assert read.dtype == np.float32
        np.testing.assert_allclose(read, MAP, atol=5e-4)


def test_lists_of_points(tmp_path):
    np.save(tmp_path / "points.npy", POINTS)
    np.savetxt(tmp_path / "points.txt", POINTS, header="x y z")
    np.savetxt(tmp_path / "one.xyz", POINTS[:1])
    np.testing.assert_allclose(read_points(tmp_path / "points.npy"), POINTS)
    np.testing.assert_allclose(read_points(tmp_path / "points.txt"), POINTS, rtol=1e-6)
    assert read_points(tmp_path / "one.xyz").shape == (1, 3)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("words.txt", b"lidar\n"),
        ("cut.npy", b"\x93NUMPY\x01"),
        ("pickle.npy", b"\x80\x04K\x01."),
        ("binary.xyz", b"\xff\xfe\x00"),
    ],
)
def test_what_is_none_is_named_with_what_would_be(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"--points must be .*metres.*{name}"):
        read_points(tmp_path / name, "--points")


def test_a_cube_is_no_map(tmp_path):
    np.save(tmp_path / "cube.npy", np.zeros((2, 3, 4)))
    with pytest.raises(ValueError, match=r"map \(H, W\) or points \(N, 3\)"):
        read_points(tmp_path / "cube.npy")
