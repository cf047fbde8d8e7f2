"""Fitting confidence: known coefficients are recovered, signs hold, and the other half is evaluated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.benchmarks.confidence import (
    TEXTURES,
    ConfidenceOptions,
    Observed,
    Wall,
    by_texture,
    calibrate,
    coverage_of_sigma,
    deciles,
    fit_log_odds,
    main,
    observe_emulated,
    of_walls,
    off_plane,
    promised,
    risk_by_coverage,
    texture_of,
)

pytestmark = pytest.mark.end_to_end

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
        return max(abs(d.promised - d.kept) for d in found if d.fraction > 0.02)

    assert gap(honest) < 0.05 and gap(lying) > 0.5


def test_deciles_of_a_promise_that_is_kept_by_half():
    found = deciles(np.array([0.05, 0.95, 0.95, 1.0]), np.array([0, 1, 0, 1]), np.array([1.0, 1.0, 1.0, 2.0]))
    assert [round(d.fraction, 2) for d in found] == [0.2, 0.8]
    assert found[1].kept == pytest.approx(0.75) and found[1].promised == pytest.approx(0.975)


def test_classes_of_texture_are_counted_separately():
    """A blank half that is right in 1 of 2 and a textured one in 3 of 4; only one of each is called sure."""
    right = np.array([1, 0, 1, 1, 0, 1], bool)
    stated = np.array([0.95, 0.4, 0.9, 0.5, 0.5, 0.1])
    texture = np.array([0.0, 0.0, 0.5, 0.5, 0.5, 0.5])
    rows = by_texture([Observed(np.ones((6, 1)), right, stated, texture)])
    assert len(rows) == len(TEXTURES) + 1 and np.isnan(rows[1].within)
    np.testing.assert_allclose(rows[0], (2 / 6, 0.5, 0.675, 0.5, 1.0))
    np.testing.assert_allclose(rows[-1], (4 / 6, 0.75, 0.5, 0.25, 1.0))


def test_walls_that_are_off_are_counted_separately():
    """Of four pixels one is off by 6 %, of two of a second pair one by 20 %; every pair weighs the same."""
    one = Wall(
        np.array([0.0, 0.01, 0.06, 0.04]), np.array([0.9, 0.8, 0.5, 0.4]), np.array([0.01, 0.02, 0.3, 0.04])
    )
    other = Wall(np.array([0.2, 0.0]), np.array([0.3, 0.6]), np.array([0.1, 0.05]))
    row = of_walls([one, other])
    np.testing.assert_allclose(row.off, (1 / 4 + 1 / 2) / 2)
    np.testing.assert_allclose(row.within, (1 / 4) / (1 / 4 + 1 / 2))
    np.testing.assert_allclose(row.of_off, (0.5 / 4 + 0.3 / 2) / (3 / 4))
    np.testing.assert_allclose(row.of_right, ((0.9 + 0.8 + 0.4) / 4 + 0.6 / 2) / (5 / 4))
    np.testing.assert_allclose(row.auroc, 7 / 8)  # of eight pairs, .4 is below .5 alone
    np.testing.assert_allclose((row.spread_off, row.spread_right), (0.2, 0.03))
    assert of_walls([Wall(np.zeros(3), np.ones(3), np.ones(3))])[0] == 0.0


def test_coverage_of_normal_errors_is_that_of_their_intervals_by_texture_and_pairs_weigh_the_same():
    rng, pairs = np.random.default_rng(0), []
    for count, factor in ((30_000, 1.0), (10_000, 2.0)):  # the second pair understates its errors by half
        texture = np.where(np.arange(count) % 2 == 0, 0.001, 0.5)
        deviation = np.abs(rng.normal(size=count)) * np.where(texture > 0.1, factor, 1.0)
        blank = np.zeros(count)
        sigma = np.where(texture > 0.1, 0.02, 0.05)
        pairs.append(Observed(np.ones((count, 1)), blank > 1, blank, texture, blank, blank, sigma, deviation))
    rows = coverage_of_sigma(pairs)
    assert len(rows) == len(TEXTURES) + 2
    plain, textured, every = rows[0], rows[-2], rows[-1]
    assert rows[1].fraction == 0 and np.isnan(rows[1].within).all()
    np.testing.assert_allclose(plain.within, (0.683, 0.95), atol=0.006)
    np.testing.assert_allclose(textured.within, ((0.683 + 0.383) / 2, (0.95 + 0.673) / 2), atol=0.008)
    np.testing.assert_allclose(every.within, np.mean([plain.within, textured.within], 0), atol=1e-9)
    assert (plain.sigma, textured.sigma, every.fraction) == (0.05, 0.02, 1.0)


def test_risk_by_coverage_sorts_each_pair_by_itself():
    errors = np.array([0.4, 0.1, 0.3, 0.2]), np.array([0.0, 0.8, 0.4, 0.4])
    stated = np.array([0.1, 0.9, 0.3, 0.8]), np.array([0.2, 0.9, 0.5, 0.5])  # perfect, and the worst order
    pairs = [
        Observed(np.ones((4, 1)), error < 0.1, sure, np.zeros(4), error, np.zeros(4), -sure, error)
        for error, sure in zip(errors, stated, strict=True)
    ]
    rows = risk_by_coverage(pairs)
    assert list(rows) == ["confidence", "sigma", "random", "error"]
    assert rows["confidence"] == rows["sigma"] and rows["error"].ause == 0.0
    # All, (0.9: four of four,) three, two and one of the pixels of both pairs.
    np.testing.assert_allclose(
        rows["error"].risk, np.add((0.25, 0.25, 0.2, 0.15, 0.1), (0.4, 0.4, 4 / 15, 0.2, 0)) / 2
    )
    np.testing.assert_allclose(rows["confidence"].risk[-1], (0.1 + 0.8) / 2)
    assert rows["confidence"].ause > rows["random"].ause * 0.5 > 0
    assert len(set(rows["random"].risk)) == 1


def test_planes_of_ground_truth_are_found_without_their_edges():
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
    main(ConfidenceOptions(data=("synthetic:2@160x120",), resolution=64))
    printed, names = capsys.readouterr().out, {}
    for line in printed.splitlines():
        if line.startswith(("LOG_ODDS", "DEPTH_LOG_ODDS")):
            exec(line, names)  # as pasted
    assert len(names["LOG_ODDS"]) == 4 and len(names["DEPTH_LOG_ODDS"]) == 6
    assert names["DEPTH_LOG_ODDS"][-1] == -15.0  # one member has no spread: the shipped number stays
    assert "largest gap between predicted and observed" in printed and "plain walls" in printed
    assert "coverage of sigma" in printed and "risk and coverage" in printed


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"what": "deep"}, "what must be one of"),
        ({"strengths": ("5%", "7%")}, "strengths must be one of"),
        ({"data": ("synthetic:1@64x48",), "what": "matches"}, "at least two pairs with truth; got 1"),
    ],
)
def test_options_that_would_fit_nothing_are_named(options, said):
    with pytest.raises(ValueError, match=said):
        main(ConfidenceOptions(**{"data": ("synthetic:2@64x48",)} | options))


def test_emulated_priors_of_a_pair_are_observed_one_by_one():
    sample = load(find_pairs(Path("synthetic:1@64x96"))[0])
    strong, weak = observe_emulated(sample, ("2%", "20%"))
    assert strong.stated.mean() > weak.stated.mean()
    assert strong.right.mean() > weak.right.mean()
    sparse = replace(sample, valid=np.zeros_like(sample.valid))
    assert observe_emulated(sparse, ("2%",)) == []
