"""Grey images, their levels, and the cost of two census descriptors."""

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.matching.census import GREY_LEVELS, census, census_cost, grey, grey_levels
from tests.unit.matching import references as ref


def test_grey_is_the_luma_that_pillow_computes_for_each_image_of_a_batch():
    colours = np.random.default_rng(0).integers(0, 256, (2, 3, 9, 14), dtype=np.uint8)
    found = grey(torch.from_numpy(colours).double() / 255)
    assert found.dtype == torch.float32 and found.shape == (2, 1, 9, 14)
    for image, luma in zip(colours, found, strict=True):
        expected = np.asarray(Image.fromarray(image.transpose(1, 2, 0)).convert("L"))
        np.testing.assert_allclose(255 * luma[0].numpy(), expected, atol=0.51)
    again = grey(found.double())
    assert again.dtype == torch.float32
    torch.testing.assert_close(again, found)


def test_six_grey_levels_are_seven_votes():
    levels = grey_levels(torch.tensor([0.0, 6 / 255, 12 / 255, 1.0]))
    assert levels.dtype == torch.int16 and levels.tolist() == [0, 7, 14, 298] and GREY_LEVELS == 297.5


@pytest.mark.parametrize("dtype", [torch.int8, torch.int16])
def test_a_cost_is_the_sum_of_differences_up_to_224_and_may_be_worked_out_in_place(dtype):
    images = np.random.default_rng(1).random((2, 15, 19))
    images[0] = np.where(np.mgrid[:15, :19].sum(0) % 4 < 2, 0.0, 1.0)
    expected = ref.cost(*(ref.votes(image) for image in images))
    buffer = torch.zeros(16, 9, 13, dtype=torch.int16)
    left = census(grey_levels(torch.from_numpy(images[0]).float()), buffer)
    assert left.data_ptr() == buffer.data_ptr()
    left, right = left.to(dtype), census(grey_levels(torch.from_numpy(images[1]).float())).to(dtype)
    opposite = census_cost(torch.full_like(left, 7), torch.full_like(left, -7))
    assert (opposite == 224).all()
    for out in (None, torch.empty_like(left), left):
        found = census_cost(left.clone() if out is None else left, right, out)
        assert found.dtype == torch.uint8
        np.testing.assert_array_equal(found, expected)
