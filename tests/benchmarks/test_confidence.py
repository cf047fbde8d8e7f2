"""Refitting what is promised: known coefficients come back, signs hold, and the other half judges."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.benchmarks.confidence import (
    TEXTURES,
    Observed,
    Wall,
    by_texture,
    calibrate,
    deciles,
    fit_log_odds,
    main,
    observe_emulated,
    of_walls,
    off_plane,
    promised,
    texture_of,
)

TRUE = (-0.5, 1.2, -0.7)


def _pair(seed: int, count: int = 4000) -> Observed:
    rng = np.random.default_rng(seed)
    evidence = np.column_stack([np.ones(count), 2.0 * rng.normal(size=count), rng.exponential(size=count)])
    return Observed(evidence, rng.uniform(size=count) < promised(evidence, TRUE))


def test_known_coefficients_come_back_whatever_the_half():
    coefficients, halves, _ = calibrate([_pair(i) for i in range(10)], (0, 1, -1))
    np.testing.assert_allclose(coefficients, TRUE, atol=0.06)
    for half in halves:
        np.testing.assert_allclose(half, TRUE, atol=0.09)


def test_weights_count_as_repetitions():
    pair, other = _pair(0), _pair(1, 500)
    evidence, right = (
        np.concatenate([pair.evidence, other.evidence]),
        np.concatenate([pair.right, other.right]),
    )
    weights = np.concatenate([np.ones(4000), np.full(500, 3.0)])
    repeated = np.repeat(np.arange(4500), weights.astype(int))
    weighted = fit_log_odds(evidence, right, weights, (0, 0, 0))
    counted = fit_log_odds(evidence[repeated], right[repeated], np.ones(len(repeated)), (0, 0, 0))
    np.testing.assert_allclose(weighted, counted, atol=1e-3)


def test_a_sign_holds_against_the_data():
    pair = _pair(0)
    found = fit_log_odds(pair.evidence, pair.right, np.ones(len(pair.right)), (0, 1, 1))
    assert found[2] == 0.0 and found[1] > 1.0


def test_the_half_that_was_not_fitted_on_judges():
    """Every second pair lies: each half promises what the other does not keep."""
    honest = [_pair(i) for i in range(6)]
    lying = [Observed(p.evidence, ~p.right) if i % 2 else p for i, p in enumerate(honest)]

    def gap(pairs):
        judged = np.concatenate(calibrate(pairs, (0, 0, 0))[2])
        right = np.concatenate([pair.right for pair in pairs])
        found = deciles(judged, right, np.ones(len(right)))
        return max(abs(d.promised - d.kept) for d in found if d.share > 0.02)

    assert gap(honest) < 0.05 and gap(lying) > 0.5


def test_deciles_of_a_promise_that_is_kept_by_half():
    found = deciles(np.array([0.05, 0.95, 0.95, 1.0]), np.array([0, 1, 0, 1]), np.array([1.0, 1.0, 1.0, 2.0]))
    assert [round(d.share, 2) for d in found] == [0.2, 0.8]
    assert found[1].kept == pytest.approx(0.75) and found[1].promised == pytest.approx(0.975)


def test_classes_of_texture_are_counted_apart():
    """A blank half that is right in 1 of 2 and a textured one in 3 of 4; only one of each is called sure."""
    right = np.array([1, 0, 1, 1, 0, 1], bool)
    stated = np.array([0.95, 0.4, 0.9, 0.5, 0.5, 0.1])
    texture = np.array([0.0, 0.0, 0.5, 0.5, 0.5, 0.5])
    rows = by_texture([Observed(np.ones((6, 1)), right, stated, texture)])
    assert len(rows) == len(TEXTURES) + 1 and np.isnan(rows[1].within)
    np.testing.assert_allclose(rows[0], (2 / 6, 0.5, 0.675, 0.5, 1.0))
    np.testing.assert_allclose(rows[-1], (4 / 6, 0.75, 0.5, 0.25, 1.0))


def test_walls_that_are_off_are_counted_apart():
    """Of four pixels one is off by 6 %, of two of a second pair one by 20 %; every pair weighs the same."""
    one = Wall(np.array([0.0, 0.01, 0.06, 0.04]), np.array([0.9, 0.8, 0.5, 0.4]))
    other = Wall(np.array([0.2, 0.0]), np.array([0.3, 0.6]))
    row = of_walls([one, other])
    np.testing.assert_allclose(row.off, (1 / 4 + 1 / 2) / 2)
    np.testing.assert_allclose(row.within, (1 / 4) / (1 / 4 + 1 / 2))
    np.testing.assert_allclose(row.of_off, (0.5 / 4 + 0.3 / 2) / (3 / 4))
    np.testing.assert_allclose(row.of_right, ((0.9 + 0.8 + 0.4) / 4 + 0.6 / 2) / (5 / 4))
    np.testing.assert_allclose(row.told_apart, 7 / 8)  # of eight pairs, .4 is below .5 alone
    # A normal error of this size is within 10 % with the median confidence.
    for spread, stated in ((row.spread_off, 0.4), (row.spread_right, 0.7)):
        np.testing.assert_allclose(math.erf(0.1 / spread / math.sqrt(2.0)), stated, rtol=1e-6)
    assert of_walls([Wall(np.zeros(3), np.ones(3))])[0] == 0.0


def test_planes_of_truth_are_found_and_their_edges_are_none():
    row, column = np.mgrid[:80, :120]
    depth_m = 1.0 / (0.2 + 0.001 * row + 0.0005 * column)
    depth_m[:, 70:] *= 1.3
    valid = np.ones(depth_m.shape, bool)
    valid[:, :10] = False
    off = off_plane(depth_m, valid)
    assert off[20:60, 26:54].max() < 1e-5 and off[20:60, 86:].max() < 1e-5
    assert off[20:60, 66:74].min() > 0.02
    assert np.isinf(off_plane(depth_m, np.zeros_like(valid))).all()


def test_texture_is_the_mean_step_of_brightness_along_rows():
    image = np.zeros((80, 120, 3), np.uint8)
    image[:, ::2] = 51  # a step of a fifth of white at every pixel
    np.testing.assert_allclose(texture_of(image)[:, 40:-40], 0.2, rtol=1e-6)
    np.testing.assert_allclose(texture_of(np.swapaxes(image, 0, 1)), 0.0, atol=1e-12)  # stripes along rows


@pytest.mark.slow
def test_the_command_prints_constants_that_can_be_pasted(capsys):
    main(data=["synthetic:2@160x120"], resolution=64)
    printed, names = capsys.readouterr().out, {}
    for line in printed.splitlines():
        if line.startswith(("LOG_ODDS", "BY_EVIDENCE")):
            exec(line, names)  # as pasted
    assert len(names["LOG_ODDS"]) == 4 and len(names["BY_EVIDENCE"]) == 6
    assert names["BY_EVIDENCE"][-1] == -15.0  # one member has no spread: the shipped number stays
    assert "largest gap between promised and kept" in printed and "plain walls" in printed


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"what": "deep"}, "what must be one of"),
        ({"strengths": "5%, 7%"}, "strengths must be one of"),
        ({"data": ["synthetic:1@64x48"], "what": "matches"}, "at least two pairs with truth; got 1"),
    ],
)
def test_options_that_would_fit_nothing_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        main(**{"data": ["synthetic:2@64x48"]} | options)


def test_emulated_priors_of_a_pair_are_observed_one_by_one():
    sample = load(find_pairs(Path("synthetic:1@64x96"))[0])
    strong, weak = observe_emulated(sample, ("2%", "20%"))
    assert strong.stated.mean() > weak.stated.mean()
    assert strong.right.mean() > weak.right.mean()
    sparse = replace(sample, valid=np.zeros_like(sample.valid))
    assert observe_emulated(sparse, ("2%",)) == []
