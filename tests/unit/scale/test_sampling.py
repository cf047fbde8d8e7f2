"""How many pixels, matches and points take part."""

from types import SimpleNamespace

import torch

from geodiff_plugin.scale import sampling


def test_points_are_thinned_evenly_and_matches_are_not_thinned_below_their_bound():
    for count, basin, fit in (
        (1, 1, 1),
        (1500, 1, 1),
        (1501, 2, 1),
        (3001, 3, 1),
        (8000, 6, 1),
        (15999, 11, 1),
        (16000, 11, 2),
    ):
        at = torch.arange(count)
        assert (sampling.basin_stride(at), sampling.sampling_stride(at)) == (basin, fit)
    assert sampling.basin_stride(torch.arange(0)) == sampling.sampling_stride(torch.arange(0)) == 1


def test_pixels_come_in_as_many_groups_as_there_may_be():
    for pixels, each in ((1, 1), (512, 1), (513, 2), (1024, 2), (1025, 3), (6000, 12)):
        assert sampling.group_size(pixels) == each


def test_the_least_part_in_view_depends_on_the_rig():
    assert sampling.min_in_view(SimpleNamespace(rectified=True)) == 0.6
    assert sampling.min_in_view(SimpleNamespace(rectified=False)) == 0.25
