"""Matches and known points on grids: batches whose images differ, and points in every form."""

import numpy as np
import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.matching import matches as module
from geodiff_plugin.matching.matches import (
    Matches,
    points_to_matches,
    read_above,
    with_points,
)
from tests.unit.matching import references as ref

SIZE = (12, 17)


def of_image(seed: int, deviates: bool = True, size=SIZE) -> Matches:
    rng = np.random.default_rng(seed)
    inverse, confidence, deviation = rng.random((3, 1, *size))
    confidence *= rng.random(size) < 0.7
    parts = [
        torch.from_numpy(x).float() for x in (inverse, confidence, np.array(0.01 * (1 + seed)), deviation)
    ]
    return Matches(*(parts if deviates else parts[:3]))


def test_a_chunk_has_the_values_of_each_image_and_deviations_only_if_all_have_them():
    images = [of_image(0), of_image(1), of_image(2)]
    chunk = Matches.stack(images)
    assert chunk.size == images[0].size == SIZE
    for b, image in enumerate(images):
        for name in ("inverse_depth", "confidence", "plane_step", "deviation"):
            assert torch.equal(getattr(chunk, name)[b], getattr(image, name))
    assert Matches.stack([images[0], of_image(1, False)]).deviation is None
    assert Matches.stack([of_image(0, False), images[1]]).deviation is None
    assert Matches.stack([images[0], None]) is None and Matches.stack([None]) is None
    assert Matches.stack(images[:1]).confidence.shape == (1, 1, *SIZE)


def test_each_image_keeps_its_matches_inside_its_own_mask_on_any_grid():
    valid = np.random.default_rng(3).random((3, 1, 24, 51)) < 0.5
    chunk = Matches.stack([of_image(b) for b in range(3)])
    found = chunk.within(torch.from_numpy(valid))
    # The mask at the centre of each match: of two rows the second, of three columns the second.
    inside = valid[..., 1::2, 1::3]
    np.testing.assert_array_equal(found.confidence, chunk.confidence.numpy() * inside)
    assert torch.equal(found.inverse_depth, chunk.inverse_depth) and found.deviation is chunk.deviation
    one = of_image(1).within(torch.from_numpy(valid[1]))
    assert torch.equal(one.confidence, found.confidence[1])


@pytest.mark.parametrize("launch_bound", [False, True])
def test_pixels_above_a_confidence_are_read_for_several_images_at_once_and_kept(monkeypatch, launch_bound):
    monkeypatch.setattr(module, "launch_bound", lambda _: launch_bound)
    images = [of_image(0), of_image(1), Matches(*(torch.zeros(1, *SIZE),) * 2, torch.tensor(0.1))]
    images[1].confidence[0, 3, 4] = 0.25
    read_above((images[0], 0.6), (images[1], 0.25), (images[2], 0.0))
    monkeypatch.setattr(module, "read_above", None)  # they are not read again
    for image, least in zip(images, (0.6, 0.25, 0.0), strict=True):
        np.testing.assert_array_equal(image.above(least), np.flatnonzero(image.confidence.numpy() > least))
    monkeypatch.undo()
    np.testing.assert_array_equal(images[0].above(0.9), np.flatnonzero(images[0].confidence.numpy() > 0.9))
    assert images[0].above(0.9) is images[0].above(0.9) is not images[0].above(0.6)


K = ref.matrix(40.0, 29.0, 17.5, 9.0, 1.5)
IMAGE, GRID = (20, 33), (7, 15)


def expected_on_grid(uv, z, weight) -> tuple[np.ndarray, np.ndarray, int]:
    """Inverse depth and confidence of the nearest point of every cell, and how many points are outside."""
    inverse, confidence, outside = np.zeros(GRID), np.zeros(GRID), 0
    for (u, v), depth, w in zip(uv, z, weight, strict=True):
        column = int(np.floor((u + 0.5) * GRID[1] / IMAGE[1]))
        row = int(np.floor((v + 0.5) * GRID[0] / IMAGE[0]))
        if depth <= 1e-4 or not (0 <= column < GRID[1] and 0 <= row < GRID[0]):
            outside += 1
        elif 1 / depth > inverse[row, column]:
            inverse[row, column], confidence[row, column] = 1 / depth, w
    return inverse, confidence, outside


@pytest.mark.parametrize("weighted", [False, True])
def test_points_and_maps_give_the_nearest_depth_of_every_cell(weighted):
    rng = np.random.default_rng(4)
    count = 150
    points = np.column_stack(
        [rng.uniform(-1.2, 1.0, count), rng.uniform(-0.8, 0.9, count), rng.uniform(1, 5, count)]
    )
    points[:5, 2] *= -1
    weight = rng.uniform(0.1, 1, count) if weighted else np.ones(count)
    u, v, _ = (K @ points.T) / points[:, 2]
    given = np.column_stack([points, weight]) if weighted else points
    found, left_out = points_to_matches(
        torch.from_numpy(given).float(), Camera(K, IMAGE[::-1]).single(), GRID
    )
    inverse, confidence, outside = expected_on_grid(zip(u, v, strict=True), points[:, 2], weight)
    assert left_out == outside > 10
    np.testing.assert_allclose(found.inverse_depth[0], inverse, rtol=1e-5)
    np.testing.assert_allclose(found.confidence[0], confidence, rtol=1e-5)
    known = np.sort(inverse[inverse > 0])
    assert float(found.plane_step) == pytest.approx(0.01 * known[(len(known) - 1) // 2], rel=1e-5)
    assert found.deviation is None and found.size == GRID

    depth = np.where(rng.random(IMAGE) < 0.2, rng.uniform(1, 5, IMAGE), 0.0)
    certain = rng.uniform(0.1, 1, IMAGE) if weighted else np.ones(IMAGE)
    given = np.stack([depth, certain], -1) if weighted else depth
    found, left_out = points_to_matches(
        torch.from_numpy(given).float(), Camera(K, IMAGE[::-1]).single(), GRID
    )
    rows, columns = np.nonzero(depth)
    pixels = zip(columns, rows, strict=True)
    inverse, confidence, outside = expected_on_grid(pixels, depth[rows, columns], certain[rows, columns])
    assert left_out == outside == 0
    np.testing.assert_allclose(found.inverse_depth[0], inverse, rtol=1e-5)
    np.testing.assert_allclose(found.confidence[0], confidence, rtol=1e-5)


def test_a_pixel_reaches_half_a_pixel_beyond_its_centre():
    straight = ref.matrix(40.0, 29.0, 17.5, 9.0)
    uv = np.array(
        [[-0.49, 3], [-0.51, 3], [32.49, 3], [32.51, 3], [5, -0.49], [5, -0.51], [5, 19.49], [5, 19.51]]
    )
    points = np.column_stack([np.linalg.inv(straight)[:2, :2] @ (uv - [17.5, 9.0]).T]).T
    points = torch.from_numpy(np.column_stack([points, np.ones(len(uv))])).float()
    for n, point in enumerate(points):
        if n % 2:
            with pytest.raises(InputError, match="1 of 1 behind it or outside"):
                points_to_matches(point[None], Camera(straight, IMAGE[::-1]), GRID)
        else:
            found, left_out = points_to_matches(point[None], Camera(straight, IMAGE[::-1]), GRID)
            assert left_out == 0 and int((found.confidence > 0).sum()) == 1


@pytest.mark.parametrize("shape", [(33, 20), (20, 34), (21, 33), (33, 20, 2)])
def test_a_map_of_another_size_is_rejected_with_both_sizes(shape):
    with pytest.raises(InputError, match=f"left image's 33x20 pixels; got {shape[1]}x{shape[0]}"):
        points_to_matches(torch.ones(shape), Camera(K, IMAGE[::-1]).single(), GRID)


def test_points_of_a_batch_replace_less_confident_matches_and_stand_for_the_pixels_between_them():
    rng = np.random.default_rng(5)
    shape = (2, 1, *SIZE)
    points_of = rng.random(shape) < np.array([0.05, 0.3]).reshape(2, 1, 1, 1)
    given = np.where(points_of, rng.choice([0.2, 0.6, 1.0], shape), 0.0)
    matched = np.where(rng.random(shape) < 0.5, rng.choice([0.4, 0.6, 0.8, 3.0], shape), 0.0)
    inverse, known, deviation = rng.random(shape), rng.random(shape), rng.uniform(2, 5, shape)

    def tensors(*parts) -> list[torch.Tensor]:
        return [torch.from_numpy(np.asarray(part)).float() for part in parts]

    matches = Matches(*tensors(inverse, matched, [0.01, 0.02], deviation))
    points = Matches(*tensors(known, given, [0.03, 0.04]))
    found, alone = with_points(matches, points), with_points(None, points)
    for b in range(2):
        number = matched[b].size / points_of[b].sum()
        put = points_of[b] & ((given[b] >= 1) | (given[b] >= matched[b]))
        assert (points_of[b] & ~put).any()
        np.testing.assert_allclose(
            found.confidence[b], np.where(put, given[b] * number, matched[b]), rtol=1e-5
        )
        np.testing.assert_allclose(found.inverse_depth[b], np.where(put, known[b], inverse[b]), rtol=1e-6)
        np.testing.assert_allclose(found.deviation[b], np.where(put, 1.0, deviation[b]), rtol=1e-6)
        np.testing.assert_allclose(alone.confidence[b], given[b] * number, rtol=1e-5)
    assert found.plane_step is matches.plane_step and alone.plane_step is points.plane_step
    assert alone.inverse_depth is points.inverse_depth and alone.deviation is None
    none = with_points(None, Matches(*tensors(known, 0 * given, [0.03, 0.04])))
    assert (none.confidence == 0).all()
    plain = Matches(*tensors(inverse, matched, [0.01, 0.02]))
    assert with_points(plain, points).deviation is None
