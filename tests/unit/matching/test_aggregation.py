"""Aggregation along four paths, for images with and without edges and of any shape."""

import numpy as np
import pytest
import torch

from geodiff_plugin.matching.aggregation import aggregate, jump_penalties
from geodiff_plugin.matching.volume import Buffers, empty_volume
from tests.unit.matching import references as ref

AXES = [(1, 0), (0, 1), (1, 1), (1, -1)]


@pytest.mark.parametrize("size", [(7, 11), (1, 5), (6, 1), (2, 2)])
def test_a_jump_costs_less_at_an_edge_of_the_image_along_any_axis(size):
    rng = np.random.default_rng(0)
    grey = 0.4 + 0.4 * rng.random(size) * (rng.random(size) < 0.6)
    found = jump_penalties(torch.from_numpy(grey).float(), AXES)
    assert found.dtype == torch.int16
    for penalty, axis in zip(found.numpy(), AXES, strict=True):
        np.testing.assert_allclose(penalty, ref.jump_penalties(grey, *axis), atol=1)
        assert (penalty == ref.jump_penalties(grey, *axis)).mean() > 0.97
    assert found.max() == 269 and found.min() >= 67


def test_no_path_runs_through_invalid_pixels():
    """Costs beyond a band of NaN do not change the sums on this side of it."""
    rng = np.random.default_rng(2)
    grey = torch.from_numpy(rng.random((9, 14))).float()
    grey[:, 6:8] = torch.nan
    levels = torch.from_numpy(rng.integers(0, 224, (13, 9, 14)).astype(np.uint8))
    levels[:, :, 6:8] = 78
    other = levels.clone()
    other[:, :, 8:] = torch.from_numpy(rng.integers(0, 224, (13, 9, 6)).astype(np.uint8))
    one, two = (aggregate(each, grey).clone() for each in (levels, other))
    assert torch.equal(one[..., :6], two[..., :6]) and not torch.equal(one[..., 8:], two[..., 8:])
    assert (jump_penalties(grey, AXES)[1][:, 6:9] == 0).all()


@pytest.mark.parametrize("size", [(13, 9, 14), (13, 14, 9), (3, 1, 6), (3, 6, 1), (1, 5, 4)])
def test_sums_over_four_paths_equal_a_walk_line_by_line(size):
    rng, buffers = np.random.default_rng(1), Buffers()
    aggregate(torch.full((15, 20, 20), 224, dtype=torch.uint8), torch.zeros(20, 20), buffers=buffers)
    grey = rng.random(size[1:]) ** 2
    # Smooth costs with a minimum that jumps, so that each kind of step is taken somewhere.
    best = np.where(grey > 0.3, 0.8, 0.2) * size[0] + rng.normal(0, 1, size[1:])
    levels = np.clip(15 * np.abs(np.arange(size[0])[:, None, None] - best) + rng.normal(0, 20, size), 0, 224)
    levels = levels.astype(np.uint8)
    expected = ref.aggregated(levels, np.float32(grey))
    found = aggregate(torch.from_numpy(levels), torch.from_numpy(grey).float(), buffers=buffers)
    np.testing.assert_array_equal(found, expected)


def test_buffers_are_given_by_name():
    with pytest.raises(TypeError, match="positional"):
        aggregate(torch.zeros(2, 3, 4, dtype=torch.uint8), torch.zeros(3, 4), Buffers())


def test_volumes_are_laid_out_for_paths_from_row_to_row_and_a_buffer_grows_only():
    like, buffers = torch.zeros(0, dtype=torch.int16), Buffers()
    for made in (
        empty_volume(5, (3, 4), torch.int16, like.device),
        buffers.empty("costs", 5, (3, 4), like),
    ):
        assert made.shape == (5, 3, 4) and made.dtype == torch.int16
        assert made.stride() == (4, 20, 1)  # the planes of a row are neighbours in memory
    first = buffers.empty("costs", 5, (3, 4), like)
    assert buffers.empty("costs", 2, (4, 4), like).data_ptr() == first.data_ptr()
    assert buffers.empty("sums", 5, (3, 4), like).data_ptr() != first.data_ptr()
    assert buffers.empty("costs", 6, (3, 4), like).shape == (6, 3, 4)
    assert buffers.empty("costs", 6, (3, 4), like).data_ptr() == buffers._held["costs"].data_ptr()
