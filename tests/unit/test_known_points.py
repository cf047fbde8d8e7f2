"""Known depths: files of every kind give the same metres; points and their confidence on the grid."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.evidence.inputs import as_points
from geodiff_plugin.formats import read_points, rig_from_parameters, write_depth_mm, write_pfm
from geodiff_plugin.formats.depth import depth_of_disparity, read_confidence
from geodiff_plugin.matching import points_to_matches, with_points
from geodiff_plugin.scale.points import depth_span

MAP = np.zeros((6, 8), np.float32)
MAP[1, 2], MAP[4, 5] = 1.25, 3.5
POINTS = np.array([[0.1, -0.2, 2.0], [0.4, 0.3, 5.5]], np.float32)


def test_maps_of_every_kind_are_the_same(tmp_path):
    write_depth_mm(tmp_path / "map.png", MAP)
    write_pfm(tmp_path / "map.pfm", np.where(MAP > 0, MAP, np.inf))
    np.save(tmp_path / "map.npy", np.where(MAP > 0, MAP, np.nan).astype(np.float64))
    for name in ("map.png", "map.pfm", "map.npy"):
        read = read_points(tmp_path / name)
        assert read.dtype == np.float32
        np.testing.assert_allclose(read, MAP, atol=5e-4)


TEXTS = {
    "commas": "0.1,-0.2,2.0\n0.4,0.3,5.5\n",
    "remarks": "# a remark\n0.1;-0.2;2.0\n\n0.4;0.3;5.5 # the last\n",
    "other order": "id,z,y,x\n0,2.0,-0.2,0.1\n1,5.5,0.3,0.4\n",
    "words in another column": "label;x[m];y[m];z[m]\ncar;0.1;-0.2;2\ntree;0.4;0.3;5.5\n",
    "quotes": '"X_m","Y_m","Z_m"\n"0.1","-0.2","2.0"\n"0.4","0.3","5.5"\n',
    "colours": "//X Y Z R G B\r\n0.1\t-0.2\t2.0\t255\t0\t0\r\n0.4\t0.3\t5.5\t0\t0\t9\r\n",
}


@pytest.mark.parametrize("kind", [*TEXTS, "Windows' shell"])
def test_text_as_people_have_it(tmp_path, kind):
    encoding = "utf-8" if kind in TEXTS else "utf-16"
    (tmp_path / "points.csv").write_text(TEXTS.get(kind, TEXTS["commas"]), encoding=encoding)
    np.testing.assert_allclose(read_points(tmp_path / "points.csv"), POINTS)


@pytest.mark.parametrize("columns", [3, 4, 6])
def test_points_may_have_an_intensity_or_a_colour_behind_them(columns):
    rows = np.column_stack([POINTS, np.full((2, 3), 200.0, np.float32)])[:, :columns]
    np.testing.assert_array_equal(as_points(rows, "points").numpy(), POINTS)


@pytest.mark.parametrize("unknown", [0.0, np.nan, -1.0])
def test_a_map_of_which_nothing_is_known_is_refused(unknown):
    with pytest.raises(InputError, match="at least one of them known; got none: all are 0"):
        as_points(np.full((6, 8), unknown, np.float32), "points")


PLY = "ply\nformat {kind} 1.0\ncomment by hand\nelement vertex 2\n{properties}{more}end_header\n"
PROPERTIES = "property double x\nproperty uchar red\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize("order", ["little", "big"])
def test_ply_in_binary_and_in_text(tmp_path, order):
    mark = "<" if order == "little" else ">"
    kinds = [("x", "f8"), ("red", "u1"), ("y", "f4"), ("z", "f4")]
    rows = np.zeros(2, np.dtype([(name, mark + kind) for name, kind in kinds]))
    for axis, name in enumerate("xyz"):
        rows[name] = POINTS[:, axis]
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    head = PLY.format(kind=f"binary_{order}_endian", properties=PROPERTIES, more=faces)
    (tmp_path / "points.ply").write_bytes(head.encode() + rows.tobytes() + b"\x03" + bytes(12))
    np.testing.assert_allclose(read_points(tmp_path / "points.ply"), POINTS, rtol=1e-6)
    (tmp_path / "points.ply").write_bytes(head.encode() + rows.tobytes()[:-1])
    with pytest.raises(ValueError, match="points must be a whole PLY file.*cut off"):
        read_points(tmp_path / "points.ply")
    head = PLY.format(kind="ascii", properties=PROPERTIES, more="")
    (tmp_path / "points.ply").write_text(head + "0.1 255 -0.2 2.0\n0.4 0 0.3 5.5\n")
    np.testing.assert_allclose(read_points(tmp_path / "points.ply"), POINTS)


XYZ = b"property float x\nproperty float y\nproperty float z\n"
BEGIN = b"ply\nformat ascii 1.0\n"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("binary.xyz", b"\xff\xfe\x00", "points must be .*metres.*binary.xyz"),
        ("cube.npy", np.zeros((2, 3, 4)), r"map \(H, W\) or points \(N, 3\)"),
        ("points.npy", (POINTS * 1000).astype(np.int32), "metres as floats; got .*int32. Divide millimetres"),
        ("cut.ply", BEGIN + b"element vertex 2\n", "PLY"),
        ("many.ply", BEGIN + b"element vertex 999999999999\n" + XYZ + b"end_header\n", "PLY"),
        ("few.ply", BEGIN + b"element vertex 2\n" + XYZ + b"end_header\n1 2 3\n", "PLY .* cut off"),
    ],
)
def test_what_is_none_is_named_with_what_would_be(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content) if isinstance(content, bytes) else np.save(
        tmp_path / name, content
    )
    with pytest.raises(ValueError, match=said):
        read_points(tmp_path / name)


def test_units_by_number(tmp_path):
    write_depth_mm(tmp_path / "map.png", MAP * 0.256)  # the integers of KITTI's 1/256 m
    np.testing.assert_allclose(read_points(tmp_path / "map.png", scale=256), MAP, atol=4e-3)
    np.save(tmp_path / "mm.npy", (1000 * MAP).astype(np.uint16))
    np.testing.assert_allclose(read_points(tmp_path / "mm.npy", scale=1000), MAP, atol=1e-3)
    np.save(tmp_path / "points.npy", 1000 * POINTS)
    np.testing.assert_allclose(read_points(tmp_path / "points.npy", scale=1000), POINTS, rtol=1e-5)
    with pytest.warns(UserWarning, match="points has depths of 2000 m and more.*--points-scale 1000"):
        GeometryGuidance.from_points(read_points(tmp_path / "points.npy"), np.eye(3))
    for scale in (0.0, float("nan")):
        with pytest.raises(ValueError, match="points-scale must be between"):
            read_points(tmp_path / "points.npy", scale=scale)


def test_confidence_from_files(tmp_path) -> None:
    values = np.random.default_rng(3).random(MAP.shape).astype(np.float32)
    np.save(tmp_path / "c.npy", values)
    write_pfm(tmp_path / "c.pfm", values)
    Image.fromarray(np.rint(values * 65535).astype(np.uint16)).save(tmp_path / "c.png")
    for name, atol in (("c.npy", 0), ("c.pfm", 0), ("c.png", 1e-5)):
        np.testing.assert_allclose(read_confidence(tmp_path / name), values, atol=atol)
    Image.new("RGB", (64, 48)).save(tmp_path / "rgb.png")
    with pytest.raises(ValueError, match="a grey PNG of 8 or 16 bits"):
        read_confidence(tmp_path / "rgb.png")


K = torch.tensor([[60.0, 0, 31.5], [0, 66.0, 23.5], [0, 0, 1]])
SIZE, GRID = (48, 64), (24, 32)


def test_the_nearest_point_of_a_cell_brings_its_confidence() -> None:
    """Against a loop over all points, with unequal sizes and anisotropic pixels."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, 300), rng.uniform(-0.8, 0.8, 300), rng.uniform(2, 9, 300)])
    weight = rng.uniform(0.1, 1.0, 300)
    given = as_points(points.astype(np.float32), "points", weight)
    matches, left_out = points_to_matches(given, K, SIZE, GRID)
    depth, expected, outside = np.full(GRID, np.inf), np.zeros(GRID), 0
    for (x, y, z), w in zip(points.astype(np.float32), weight, strict=True):
        u, v = 60.0 * x / z + 31.5, 66.0 * y / z + 23.5
        column, row = int(np.floor((u + 0.5) / 2)), int(np.floor((v + 0.5) / 2))
        if not (0 <= column < 32 and 0 <= row < 24):
            outside += 1
        elif z < depth[row, column]:
            depth[row, column], expected[row, column] = z, w
    assert left_out == outside > 0
    np.testing.assert_allclose(matches.confidence[0], expected, atol=1e-6)
    np.testing.assert_allclose(matches.inverse_depth[0], 1 / depth, rtol=1e-5)
    assert [float(m) for m in depth_span(matches)] == pytest.approx([depth.min(), depth[depth < 99].max()])


def test_points_outside_are_counted_and_none_left_is_an_error():
    points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0]])
    assert points_to_matches(points, K, SIZE, SIZE)[1] == 2
    with pytest.raises(ValueError, match="2 of 2 behind it or outside"):
        points_to_matches(points[1:], K, SIZE, SIZE)
    with pytest.raises(ValueError, match="points must be a map of the left image's 64x48 pixels"):
        points_to_matches(torch.ones(24, 32), K, SIZE, SIZE)


def test_points_take_the_place_of_matches_of_less_confidence() -> None:
    depth, confidence = np.zeros(SIZE, np.float32), np.zeros(SIZE)
    depth[0, :3], confidence[0, :3] = 4.0, (0.2, 0.9, 1.0)
    points, _ = points_to_matches(as_points(depth, "points", confidence), K, SIZE, SIZE)
    half = torch.full((1, *SIZE), 0.5)
    both = with_points(replace(points, inverse_depth=half, confidence=half), points)
    assert both.inverse_depth[0, 0, :4].tolist() == [0.5, 0.25, 0.25, 0.5]
    share = 48 * 64 / 3
    np.testing.assert_allclose(both.confidence[0, 0, :4], [0.5, 0.9 * share, share, 0.5], rtol=1e-5)
    assert torch.equal(with_points(None, points).inverse_depth, points.inverse_depth)


def test_what_is_no_confidence():
    for confidence, said in (
        (np.ones((3, 4)), r"must be of shape \(48, 64\), as the points; got shape \(3, 4\)"),
        (np.full(SIZE, 100), r"points_confidence must be in \[0, 1\]; got values from 100 to 100"),
        ("high", "points_confidence must be numbers"),
        (np.zeros(SIZE), "at least one of them known"),
    ):
        with pytest.raises(InputError, match=said):
            GeometryGuidance.from_points(np.ones(SIZE, np.float32), K, points_confidence=confidence)


def test_disparities_of_any_size_become_depths(tmp_path) -> None:
    rig = rig_from_parameters(60, 66, 31.5, 23.5, 0.12, cx_right=33.0)
    disparity = np.random.default_rng(2).uniform(1, 12, SIZE).astype(np.float32)
    disparity[0, 0], disparity[0, 1] = np.inf, 0.0
    finite = np.where(np.isfinite(disparity), disparity, 0)
    expected = np.where(finite > 0, 60 * 0.12 / (finite + 1.5), 0)
    write_pfm(tmp_path / "d.pfm", disparity)
    Image.fromarray((256 * finite).astype(np.uint16)).save(tmp_path / "d.png")
    np.testing.assert_allclose(depth_of_disparity(tmp_path / "d.pfm", rig, (64, 48)), expected, rtol=1e-6)
    np.testing.assert_allclose(depth_of_disparity(tmp_path / "d.png", rig, (64, 48)), expected, rtol=2e-3)
    np.save(tmp_path / "half.npy", disparity[::2, ::2] / 2)
    half = depth_of_disparity(tmp_path / "half.npy", rig, (64, 48))
    np.testing.assert_allclose(half[:2, 2:4], np.full((2, 2), expected[0, 2]), rtol=1e-6)
    with pytest.raises(InputError, match="of the shape of the left image, 64x60"):
        depth_of_disparity(tmp_path / "half.npy", rig, (64, 60))
    E = rig.E.copy()
    E[1, 3] = 0.05
    for other in (replace(rig, E=E), replace(rig, unit=None)):
        with pytest.raises(InputError, match="disparity must be of a r"):
            depth_of_disparity(tmp_path / "d.pfm", other, (64, 48))
