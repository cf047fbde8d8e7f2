"""Known depths from files: columns, units and unknown values."""

import sys

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import points as module
from geodiff_plugin.formats import read_points

POINTS = np.array([[0.25, -0.5, 1.5], [-1.25, 0.75, 2.25], [0.125, 0.375, 4.0], [9.0, -3.0, 5.5]])


def text(values, between=" ") -> str:
    return "\n".join(between.join(map(str, row)) for row in values) + "\n"


@pytest.mark.parametrize(
    ("heading", "order"),
    [
        ("x y z", "xyz"),
        ("z x y", "zxy"),
        ("X[m],Y[m],Z[m],i", "xyzi"),
        ("i z_m y_m x_m", "izyx"),
        ("", "xyz"),
        ("", "xyzi"),
        ("", "xyziii"),
        ("some words", "xyz"),
        ("// x y", "xyz"),
    ],
)
def test_text_columns_follow_the_heading(tmp_path, heading, order):
    columns = {"x": POINTS[:, 0], "y": POINTS[:, 1], "z": POINTS[:, 2], "i": np.arange(7.0, 11.0)}
    rows = np.column_stack([columns[axis] for axis in order])
    (tmp_path / "p.csv").write_text((f"{heading}\n" if heading else "") + text(rows, ", "))
    read = read_points(tmp_path / "p.csv")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, POINTS)
    np.testing.assert_allclose(read_points(path=tmp_path / "p.csv", scale=4.0), POINTS / 4)
    with pytest.raises(TypeError, match="positional"):
        read_points(tmp_path / "p.csv", "known", 4.0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            "a b z\n1 2 3\n",
            r"\Aknown must be points with columns x, y and z, in metres; got .*p\.txt with a, b, z\. Save",
        ),
        ("x x z\n1 2 3\n", r"with x, x, z\. Save points"),
        (
            "1 2 3\n1 2\n",
            r"\Aknown must be points in metres, one per line, with at most one heading; got "
            r".*p\.txt with words, "
            r"or rows of \[2, 3\] numbers\.",
        ),
        ("x y z\nq y z\n1 2 3\n", r"with words, or rows of \[3\] numbers\."),
    ],
)
def test_malformed_text_is_rejected(tmp_path, content, words):
    (tmp_path / "p.txt").write_text(content)
    with pytest.raises(InputError, match=words):
        read_points(tmp_path / "p.txt", "known")


@pytest.mark.parametrize("columns", [2, 3, 4, 5, 6, 7])
def test_arrays_of_three_four_or_six_columns_are_points(tmp_path, columns):
    values = np.random.default_rng(0).uniform(1, 2, (9, columns))
    values[0, 0] = np.nan
    np.save(tmp_path / "p.npy", values)
    read = read_points(tmp_path / "p.npy")
    if columns in (3, 4, 6):
        np.testing.assert_array_equal(read, values[:, :3].astype(np.float32))
    else:  # a map, 0 where unknown
        np.testing.assert_array_equal(read, np.nan_to_num(values).astype(np.float32))


@pytest.mark.parametrize("shape", [(3,), (2, 3, 3), (0, 3), (3, 0)])
def test_arrays_of_other_shapes_are_rejected(tmp_path, shape):
    np.save(tmp_path / "p.npy", np.ones(shape))
    with pytest.raises(
        InputError, match=r"\Aknown must be a map \(H, W\) or points \(N, 3\) of numbers; got .* of shape"
    ):
        read_points(tmp_path / "p.npy", "known")


def test_integers_need_a_scale(tmp_path):
    np.save(tmp_path / "p.npy", np.full((4, 5), 1500))
    with pytest.raises(InputError, match=r"\Aknown must be metres as floats; got .*p\.npy of int64\."):
        read_points(tmp_path / "p.npy", "known")
    np.testing.assert_array_equal(
        read_points(tmp_path / "p.npy", scale=1000), np.full((4, 5), 1.5, np.float32)
    )
    for scale, fits in ((1e-9, True), (9e-10, False), (1e9, True), (1.1e9, False)):
        if fits:
            read_points(tmp_path / "p.npy", scale=scale)
            continue
        with pytest.raises(InputError, match=r"\Aknown-scale must be between 1e-09 and 1000000000; got "):
            read_points(tmp_path / "p.npy", "known", scale=scale)
    with np.errstate(all="raise"):
        np.save(tmp_path / "p.npy", np.full((4, 5), 1e38))
        assert np.isinf(read_points(tmp_path / "p.npy", scale=1e-5)).sum() == 0


@pytest.mark.parametrize(("kind", "factor"), [(np.uint16, 1000.0), (np.float32, 1.0)])
def test_integer_images_are_millimetres_and_float_images_metres(tmp_path, kind, factor):
    values = np.array([[0, 500, 65535], [1250, 3, 0]], kind)
    if kind == np.float32:
        values = values / 1000
        values[0, 2], values[1, 2] = np.nan, -1.0
    path = tmp_path / ("d.png" if kind == np.uint16 else "d.tiff")
    cv2.imwrite(str(path), values)
    read = read_points(path)
    expected = np.array([[0, 0.5, 65.535], [1.25, 0.003, 0]], np.float32)
    if kind == np.float32:
        expected[0, 2] = 0
    np.testing.assert_allclose(read, expected, rtol=1e-6)
    np.testing.assert_allclose(read_points(path, scale=256.0), expected * factor / 256, rtol=1e-6)
    assert read.dtype == np.float32


@pytest.mark.parametrize(
    ("sideways", "fits"), [((9e4, 1), True), ((1.1e5, 1), False), ((1, -1.1e5), False), ((-9e4, 9e4), True)]
)
def test_map_coordinates_are_rejected(tmp_path, sideways, fits):
    """The median decides, so outliers do not matter, and lengths are compared in metres."""
    rows = np.column_stack([np.tile(sideways, (5, 1)), np.full(5, 300.0)])
    rows[:2, :2] = (1e7, -1e7) if fits else (0, 0)
    for scale in (None, 1000.0):
        np.save(tmp_path / "p.npy", rows * (scale or 1.0))
        if fits:
            assert len(read_points(tmp_path / "p.npy", scale=scale)) == 5
            continue
        got = f"{abs(sideways[0]):.0f} and {abs(sideways[1]):.0f} m \\(map coordinates\\)"
        sentence = (
            r"\Apoints must be points in the frame of the left camera \(x right, y down, z "
            r"forward\); got .* with "
        )
        with pytest.raises(InputError, match=rf"{sentence}x and y of {got}\. Transform them with"):
            read_points(tmp_path / "p.npy", scale=scale)


def write_ply(path, binary: bool) -> None:
    import trimesh

    trimesh.PointCloud(POINTS).export(path, encoding="binary" if binary else "ascii")


@pytest.mark.parametrize("binary", [True, False])
def test_ply_vertices_are_points(tmp_path, binary):
    write_ply(tmp_path / "p.ply", binary)
    np.testing.assert_allclose(read_points(tmp_path / "p.ply"), POINTS)
    assert module.read_ply_points(tmp_path / "p.ply").dtype == np.float64
    data = (tmp_path / "p.ply").read_bytes()
    for damaged in (
        data[:-20],
        data.replace(b"element vertex 4", b"element vertex 5"),
        b"ply\n",
        data.replace(b"element vertex 4", b"element point 4"),
    ):
        (tmp_path / "q.ply").write_bytes(damaged)
        with pytest.raises(
            InputError, match=r"\Aknown must be a whole PLY file whose vertices have x, y and z; got .*q\.p"
        ):
            read_points(tmp_path / "q.ply", "known")


def test_las_points_are_read(tmp_path):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.array([0.001, 0.001, 0.001]), np.array([1.0, 2, 3])
    las = laspy.LasData(header)
    las.x, las.y, las.z = POINTS.T
    las.write(tmp_path / "p.LAS")
    np.testing.assert_allclose(read_points(tmp_path / "p.LAS"), POINTS, atol=1e-6)
    np.testing.assert_allclose(read_points(tmp_path / "p.LAS", scale=2.0), POINTS / 2, atol=1e-6)


def test_las_errors_name_the_missing_package(tmp_path, monkeypatch):
    laspy = pytest.importorskip("laspy")
    (tmp_path / "q.laz").write_bytes(b"LASF")
    run = (
        r"Install it with: pip install 'laspy\[lazrs\]', or convert the file: pdal translate FILE out\.ply\."
    )

    def refused(words):
        with pytest.raises(InputError, match=rf"\Aknown must be {words}\Z"):
            read_points(tmp_path / "q.laz", "known")

    def fail(error):
        def read(path):
            raise error

        monkeypatch.setattr(laspy, "read", read)

    fail(laspy.LaspyException("bad"))
    for backends, words in (
        ((1,), r"a whole LAS file; got .*q\.laz \(bad\)\. It may be truncated\."),
        ((), rf"a LAS file, or LAZ with laspy's lazrs; got .*q\.laz \(bad\)\. {run}"),
    ):
        monkeypatch.setattr(laspy.LazBackend, "detect_available", lambda backends=backends: backends)
        refused(words)
    fail(ValueError("odd"))
    refused(r"a whole LAS file; got .*q\.laz \(odd\)\. It may be truncated\.")
    monkeypatch.setitem(sys.modules, "laspy", None)
    refused(rf"a map \(16-bit PNG .*\); got .*q\.laz\. {run}")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "p.bin",
            r"got .*p\.bin, points of a lidar in its own frame \(KITTI's velodyne\)\. Pass",
        ),
        ("p.h5", r"got .*p\.h5, an HDF5 or MATLAB file\. Save its map"),
        ("p.HDF5", r"got .*p\.HDF5, an HDF5 or MATLAB file\. Save its map"),
        ("p.mat", r"got .*p\.mat, an HDF5 or MATLAB file\. Save its map"),
    ],
)
def test_unsupported_suffixes_are_named(tmp_path, name, words):
    (tmp_path / name).write_text("x")
    with pytest.raises(InputError, match=rf"\Aknown must be a map \(16-bit PNG .*\.las\); {words}"):
        read_points(tmp_path / name, "known")
