"""Where a given map is wrong, against NumPy, and in a scene with a wrong patch, glass and wrong matches."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from geodiff_plugin.algorithm.map_error import regional_error
from geodiff_plugin.algorithm.match_fitting import MeasuredError
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.volume import CostVolume
from tests.unit.algorithm.references import drawn

GRID, PLANES = (40, 60), 12
#: 1/m of the first plane, and of a step.
FIRST, STEP = 0.2, 0.05


def volume_of(levels: torch.Tensor, in_view: torch.Tensor | None = None) -> CostVolume:
    """A volume with these costs and visibility ``(D, H, W)``; nothing else of it is read."""
    inverse_depth = FIRST + STEP * torch.arange(len(levels))
    image = torch.zeros(1, *levels.shape[1:])
    in_view = levels < 255 if in_view is None else in_view
    return CostVolume(levels, in_view, inverse_depth, image, (), (), True)


def test_a_cost_is_the_lower_one_of_the_planes_around_a_depth():
    levels = (255 * drawn(PLANES, 5, 7, seed=1)).to(torch.uint8).clamp_max(224)
    position = -2.0 + (PLANES + 4) * drawn(1, 5, 7, seed=2)
    in_view = drawn(PLANES, 5, 7, seed=3) > 0.3
    found, seen = volume_of(levels, in_view).cost_at(FIRST + STEP * position)
    for row, column in np.ndindex(5, 7):
        below = min(max(int(np.floor(position[0, row, column].item())), 0), PLANES - 2)
        costs = levels[below : below + 2, row, column].double() / 224.0
        assert found[0, row, column].item() == pytest.approx(costs.min().item())
        assert seen[0, row, column] == in_view[below : below + 2, row, column].all()
    assert 0.2 < seen.float().mean() < 0.8


def ramp(x, low, high):
    return np.clip((x - low) / (high - low), 0, 1)


def window(values: np.ndarray) -> np.ndarray:
    """Mean over the window of 2 pixels around every pixel, 4 % of 60, inside the image."""
    sums, count = (
        ndimage.uniform_filter(each, 5, mode="constant") for each in (values, np.ones_like(values))
    )
    return sums / count


def test_the_error_is_raised_as_in_its_formula():
    """Two samples; matches contradict the map in both directions, and the second one mostly behind it."""
    deviation = 0.6 * (drawn(2, 1, *GRID, seed=1) - torch.tensor([0.5, 0.2]).view(2, 1, 1, 1))
    deviation = deviation * (torch.arange(60) < 35)  # the map is right elsewhere
    target = Matches(0.3 + 0.4 * drawn(2, 1, *GRID, seed=2), 1.3 * drawn(2, 1, *GRID, seed=3), torch.ones(2))
    levels = [(140 * drawn(PLANES, *GRID, seed=4 + b) ** 2).to(torch.uint8) for b in range(2)]
    volumes = [volume_of(each, drawn(PLANES, *GRID, seed=6) > 0.02) for each in levels]
    error = torch.tensor([0.02, 0.07]).view(2, 1, 1, 1)
    found = regional_error(MeasuredError(error, deviation), target, volumes)
    for b in range(2):
        e, confidence = (
            deviation[b, 0].double().numpy(),
            target.confidence[b, 0].clamp_max(1).double().numpy(),
        )
        match = target.inverse_depth[b]
        cost, seen = volumes[b].cost_at(match * deviation[b].exp())
        excess = (cost - volumes[b].cost_at(match)[0])[0].double().numpy()
        against = confidence * ramp(excess, 0.03, 0.1) * seen[0].numpy()
        total = window(confidence) + 0.2
        local = np.clip(
            np.sqrt(np.pi / 2) * window(against * np.abs(e)) / np.maximum(window(against), 1e-6), 0.01, 0.5
        )
        sides = (against, against * (e < 0), against * (e >= 0))
        larger = ramp(local / float(error[b]), 2.0, 4.0)
        every, front, behind = (larger * ramp(window(side) / total, 0.25, 0.5) for side in sides)
        areas = [(side * confidence).mean() for side in (front, behind)]
        counted = min(areas[0] / max(0.5 * areas[1], 1e-6), 1.0)
        wrong = np.where(behind > front, every * counted, every)
        e_0 = float(error[b])
        np.testing.assert_allclose(found[b, 0], e_0 * np.maximum(local / e_0, 1) ** wrong, rtol=1e-3)
    assert (found > 1.01 * error).any() and (found >= 0.999 * error).all()


def scene(deviation: torch.Tensor, rise=60.0, best=5.0, error=0.01, in_view=None) -> torch.Tensor:
    """Errors of a map that deviates from matches at plane 5, with costs that rise from the plane ``best``."""
    match = torch.full_like(deviation, FIRST + 5 * STEP)
    target = Matches(match, torch.full_like(match, 0.9), torch.tensor([STEP]))
    planes = torch.arange(PLANES).view(-1, 1, 1)
    levels = (rise * (planes - best).abs()).clamp_max(220).to(torch.uint8)
    levels = levels.expand(-1, *deviation.shape[2:])
    measured = MeasuredError(torch.tensor(error).view(1, 1, 1, 1), deviation)
    return regional_error(measured, target, [volume_of(levels.contiguous(), in_view)])


def patch(value: float, columns: slice = slice(20, 40)) -> torch.Tensor:
    deviation = torch.zeros(1, 1, *GRID)
    deviation[..., 10:30, columns] = value
    return deviation


@pytest.mark.parametrize("factor", [1, 4], ids=["a cell per pixel", "cells of two pixels"])
def test_a_wrong_patch_has_its_own_error_and_the_rest_keeps_the_maps(factor):
    large = scene(patch(-0.4).repeat_interleave(factor, 2).repeat_interleave(factor, 3))
    assert large.shape == (1, 1, GRID[0] * factor, GRID[1] * factor)
    found = large[..., ::factor, ::factor]
    assert found[..., 13:27, 23:37].numpy() == pytest.approx(0.4 * np.sqrt(np.pi / 2), rel=0.01)
    outside = torch.ones(GRID, dtype=torch.bool)
    outside[7:33, 17:43] = False
    assert (found[0, 0][outside] == 0.01).all()


@pytest.mark.parametrize(
    "costs",
    [{"rise": 0.0}, {"best": 5.0 - 3.0 * (patch(-0.4)[0] != 0)}],
    ids=["textureless", "the map explains the images better"],
)
def test_matches_that_explain_the_images_no_better_than_the_map_change_nothing(costs):
    assert (scene(patch(-0.4), **costs) == 0.01).all()


def test_matches_behind_the_map_count_only_if_others_are_in_front():
    """What is behind glass explains the images better than the glass."""
    glass = scene(patch(0.4))
    assert (glass == 0.01).all()
    both = scene(patch(0.4, slice(5, 25)) + patch(-0.4, slice(32, 52)))
    assert both[0, 0, 20, 15] > 0.4 and both[0, 0, 20, 42] > 0.4


def test_an_error_below_twice_the_maps_changes_nothing():
    assert (scene(patch(-0.4), error=0.26) == 0.26).all()  # of at most 0.5 in the patch


def test_a_map_outside_the_view_is_not_contradicted():
    assert (scene(patch(-0.4), in_view=torch.zeros(PLANES, *GRID, dtype=torch.bool)) == 0.01).all()


def test_a_thin_strip_changes_nothing():
    assert (scene(patch(-0.4, slice(30, 31))) == 0.01).all()
