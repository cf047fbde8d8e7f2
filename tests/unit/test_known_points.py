"""Known points on the grid of the losses, their confidence, and what contradicts the views."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import rig_from_parameters, write_pfm
from geodiff_plugin.formats.depth import depth_of_disparity
from geodiff_plugin.guidance.inputs import as_points
from geodiff_plugin.matching import points_to_matches, with_points
from geodiff_plugin.scale.points import depth_span

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


@pytest.mark.parametrize(
    ("confidence", "said"),
    [
        (np.ones((3, 4)), r"must be of shape \(48, 64\), as the points; got shape \(3, 4\)"),
        (np.full(SIZE, 100), r"points_confidence must be in \[0, 1\]; got values from 100 to 100"),
        ("high", "points_confidence must be numbers"),
        (np.zeros(SIZE), "at least one of them known"),
    ],
)
def test_what_is_no_confidence(confidence, said) -> None:
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
