"""Repeated patterns are found in costs, and their matches are settled by a prior and the surroundings."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.matching import build_cost_volume, match_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.repetition import (
    CELL,
    MIN_PERIOD,
    _cells,
    _expected,
    _rise,
    _second_minimum,
    if_repeated,
    settle,
    with_repetition,
)
from tests.views import posed_of

SIZE, FOCAL, BASELINE = (96, 160), 100.0, 0.2
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 47.5], [0, 0, 1]])


def scene(period: int | None, seed: int = 0, disparity: int = 20):
    """Views of a wall at one disparity, whose columns repeat below a poster."""
    rng = np.random.default_rng(seed)
    width = SIZE[1] + 64
    texture = rng.random((SIZE[0], width))
    if period:
        texture = np.tile(rng.random((SIZE[0], period)), (1, width // period + 1))[:, :width]
    # A poster without a pattern at the same depth.
    texture[:24] = rng.random((24, width))
    left, right = texture[:, : SIZE[1]], texture[:, disparity : disparity + SIZE[1]]
    T = np.eye(4)
    T[0, 3] = -BASELINE
    as_image = [torch.from_numpy(each).float()[None].repeat(3, 1, 1) for each in (left, right)]
    posed = posed_of(as_image[0], K, (as_image[1], K, T))
    return build_cost_volume(posed, depth_range=(FOCAL * BASELINE / 50, 1e3))


def test_a_pattern_is_found_with_its_period_and_other_texture_is_left_alone_bit_for_bit():
    volume = scene(period=16)
    matches = match_volume(volume)
    found = with_repetition(matches, volume)
    pattern, poster = found.repeated[0, 40:, 50:-10], found.repeated[0, :14]
    assert (pattern > 0.9).float().mean() > 0.95 and (poster > 0.1).float().mean() < 0.2
    period_px = found.period[0, 40:, 50:-10].median() * FOCAL * BASELINE
    assert float(period_px) == pytest.approx(16, abs=1)
    marked = (found.repeated == 1) & (matches.confidence > 0)
    assert (found.confidence / matches.confidence)[marked].numpy() == pytest.approx(1 / 3)
    assert torch.equal(found.inverse_depth, matches.inverse_depth)
    volume = scene(period=None)
    matches = match_volume(volume)
    found = with_repetition(matches, volume)
    assert torch.equal(found.confidence, matches.confidence) and not found.repeated.any()
    dropped = if_repeated(found)
    assert dropped.repeated is None and settle(Matches.stack([dropped]), torch.ones(1, 1, *SIZE)) is None


def test_a_period_longer_than_the_search_is_no_ambiguity():
    volume = scene(period=64)
    assert not with_repetition(match_volume(volume), volume).repeated.any()


def test_minima_of_waves_a_plateau_and_noise():
    """A wave repeats with its nearest period; a plateau, as of a saturated sky, has no second minimum."""
    d = np.arange(60.0)
    wave = 100 - 40 * np.cos(2 * np.pi * (d - 10) / 15)
    deeper = wave - 10 * (np.abs(d - 40) < 4)
    plateau = np.where(d < 30, 20.0, 100.0)
    single = 100 - 60 * np.exp(-(((d - 25) / 3) ** 2))
    costs = torch.from_numpy(np.stack([wave, deeper, plateau, single], 1))[:, None].float()
    first, second, period = (each[0].numpy() for each in _second_minimum(costs))
    means = costs.mean(0)[0].numpy()
    assert first == pytest.approx(means - costs.numpy().min(0)[0])
    assert second[:2] == pytest.approx(first[:2] - [0, 10], rel=1e-4)
    assert second[2] == second[3] == 0.0
    assert period.tolist() == [15, 15, 0, 0]


def matches_of(inverse: np.ndarray, repeated: np.ndarray, period: float, confidence: float = 0.9) -> Matches:
    maps = [torch.from_numpy(np.asarray(x, np.float32))[None, None] for x in (inverse, repeated)]
    chance = confidence * (1 - maps[1] * (2 / 3))
    ones = torch.ones_like(maps[0])
    return Matches(maps[0], chance, torch.tensor([0.005]), ones, maps[1], period * ones)


def wall(size=(60, 80)):
    """Half of a wall at 2 m repeats with a period of 0.25 / m. Some matches are one period off."""
    inverse, repeated = np.full(size, 0.5), np.zeros(size)
    repeated[:, 40:] = 1.0
    inverse[:30, 50:] += 0.25
    return inverse, repeated


def noisy_prior(size, error: float, bias: float = 0.0, seed: int = 3) -> torch.Tensor:
    log_depth = np.log(2.0) + bias + error * np.random.default_rng(seed).normal(size=size)
    return torch.from_numpy(np.exp(log_depth).astype(np.float32))[None, None]


def test_matches_one_period_off_are_rejected_and_right_ones_restored():
    inverse, repeated = wall()
    matches = matches_of(inverse, repeated, 0.25)
    settled = settle(matches, noisy_prior(inverse.shape, 0.02))
    final = (matches.confidence * settled.weight)[0, 0]
    assert torch.equal(settled.weight[0, 0, :, :40], torch.ones(60, 40))
    assert (final[:30, 50:] < 0.1).all() and (final[30:, 50:] > 0.75).all() and final.max() <= 0.9 + 1e-6
    assert (settled.certainty > 0.85).all() and (settled.certainty <= 1).all()


def test_the_surroundings_correct_a_prior_and_a_poor_prior_decides_nothing():
    inverse, repeated = wall()
    matches = matches_of(inverse, repeated, 0.25)
    biased = settle(matches, noisy_prior(inverse.shape, 0.02, bias=-0.4))
    next_to_bars = (biased.weight * matches.confidence)[0, 0, 40:, 40:43]
    # Near matches without a pattern, although the prior alone prefers another period.
    assert (next_to_bars > 0.6).all()
    poor = settle(matches, noisy_prior(inverse.shape, 1.0))
    on_pattern = (poor.weight * matches.confidence)[0, 0][:, 50:]
    assert on_pattern.mean() < 0.5 and poor.certainty[..., 50:].mean() < 0.8


@pytest.mark.parametrize("factor", [0.01, 7.0])
def test_the_unit_of_length_changes_nothing(factor):
    inverse, repeated = wall()
    prior = noisy_prior(inverse.shape, 0.1)
    one = settle(matches_of(inverse, repeated, 0.25), prior)
    other = settle(matches_of(inverse / factor, repeated, 0.25 / factor), factor * prior)
    for name in one._fields:
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size", [(40, 80), (41, 86)], ids=["whole cells", "parts of cells"])
def test_the_surroundings_are_aligned_with_the_image(size):
    """The error of the prior changes along the rows, and the matches without a pattern show it."""
    columns = np.linspace(-0.2, 0.2, size[1]) * np.ones(size)
    inverse = 0.5 * np.exp(columns)
    repeated = np.zeros(size)
    repeated[:, -24:-16] = 1.0
    log_expected, _ = _expected(matches_of(inverse, repeated, 0.25), torch.full((1, 1, *size), 2.0))
    off = (log_expected[0, 0].numpy() - np.log(inverse))[:, -40:-8]
    assert np.abs(off).max() < 0.03


def test_a_candidate_beyond_infinity_is_none():
    inverse, repeated = np.full((20, 30), 0.1), np.ones((20, 30))
    repeated[:, :10] = 0.0
    settled = settle(matches_of(inverse, repeated, 0.25), torch.full((1, 1, 20, 30), 10.0))
    assert (settled.weight[..., 10:] * 0.3 > 0.8).all()
    volume = SimpleNamespace(levels=torch.full((30, 40, 60), 50, dtype=torch.uint8), size=(40, 60))
    flat = with_repetition(replace(matches_of(np.ones((40, 60)), np.zeros((40, 60)), 0.1)), volume)
    assert not flat.repeated.any()


def test_cells_are_square_and_cover_the_image():
    cells = _cells(torch.zeros(3, 5 * CELL, 7 * CELL - 1, dtype=torch.uint8))
    assert cells.shape == (3, 5, 7)


def test_a_flat_minimum_rises_alike_at_both_of_its_planes():
    away = torch.arange(4 * MIN_PERIOD).sub(2 * MIN_PERIOD).abs().float()
    costs = torch.cat([away[: 2 * MIN_PERIOD + 1], away[2 * MIN_PERIOD :]])
    rise = _rise(costs.view(-1, 1, 1)).flatten()
    assert rise[2 * MIN_PERIOD] == rise[2 * MIN_PERIOD + 1] == MIN_PERIOD - 1
    assert (rise > 0).sum() == 2
