"""Every metric against a closed form on two or three pixels; the alignment against a known affine map."""

import kornia
import numpy as np
import pytest
import torch

from geodiff_plugin.evaluation.metrics import (
    FLOOR_M,
    MIN_DISPARITY,
    align,
    ause,
    confidence_deciles,
    counted,
    evaluate_depth,
    evaluate_disparity,
    least_squares,
)

ALL = np.ones((1, 2), bool)


def row(*values):
    return np.array([values], np.float64)


def test_depth_metrics_match_their_formulas():
    scores = evaluate_depth(row(1.1, 4.0), row(1.0, 2.0), ALL)
    assert scores["abs_rel"] == pytest.approx((0.1 / 1 + 2.0 / 2) / 2)
    assert scores["rmse"] == pytest.approx(np.sqrt((0.1**2 + 2.0**2) / 2))
    assert scores["log_rmse"] == pytest.approx(np.sqrt((np.log(1.1) ** 2 + np.log(2) ** 2) / 2))
    assert scores["silog"] == pytest.approx(100 * (np.log(2) - np.log(1.1)) / 2)
    assert (scores["delta1"], scores["delta2"], scores["delta3"]) == (0.5, 0.5, 0.5)
    assert (scores["coverage"], scores["pixels"]) == (1.0, 2.0)


@pytest.mark.parametrize("ratio, passed", [(1.2, 3), (1.3, 2), (1.6, 1), (2.0, 0)])
@pytest.mark.parametrize("too_far", [True, False])
def test_delta_counts_both_directions(ratio, passed, too_far):
    pred = row(ratio, ratio) if too_far else row(1 / ratio, 1 / ratio)
    scores = evaluate_depth(pred, row(1.0, 1.0), ALL)
    assert [scores[f"delta{k}"] for k in (1, 2, 3)] == [
        float(passed >= 3),
        float(passed >= 2),
        float(passed >= 1),
    ]


def test_silog_ignores_scale_and_abs_rel_does_not():
    truth = row(1.0, 3.0)
    scores = evaluate_depth(2 * truth, truth, ALL)
    assert scores["silog"] == pytest.approx(0, abs=1e-9)
    assert scores["abs_rel"] == pytest.approx(1)


def test_cap_drops_truth_and_clips_predictions():
    truth, pred = row(40.0, 100.0), row(160.0, 1.0)
    scores = evaluate_depth(pred, truth, ALL, cap_m=80.0)
    assert scores["pixels"] == 1
    assert scores["abs_rel"] == pytest.approx(1.0)  # 160 is clipped to 80
    assert evaluate_depth(pred, truth, ALL)["abs_rel"] == pytest.approx((3.0 + 0.99) / 2)


def test_holes_count_as_missing_not_as_wrong():
    scores = evaluate_depth(row(2.0, np.nan), row(2.0, 5.0), ALL)
    assert (scores["abs_rel"], scores["coverage"], scores["pixels"]) == (0.0, 0.5, 2.0)
    nothing = evaluate_depth(row(0.0, -np.inf), row(2.0, 5.0), ALL)
    assert np.isnan(nothing["abs_rel"]) and nothing["coverage"] == 0


def test_truth_that_cannot_count_is_an_error():
    with pytest.raises(ValueError, match="no valid pixel"):
        counted(row(100.0, 0.0), ALL, cap_m=80.0)
    with pytest.raises(ValueError, match="one shape"):
        evaluate_depth(row(1.0), row(1.0, 2.0), ALL)


def test_disparity_metrics_match_their_formulas():
    truth, pred = row(100.0, 10.0, 50.0, 5.0), row(104.0, 13.5, 50.5, np.inf)
    valid = np.ones((1, 4), bool)
    scores = evaluate_disparity(pred, truth, valid)
    assert scores["epe"] == pytest.approx((4 + 3.5 + 0.5) / 3)
    assert scores["bad1"] == scores["bad2"] == scores["bad3"] == pytest.approx(2 / 3)
    assert scores["d1"] == pytest.approx(1 / 3)  # 4 px of 100 is within 5 %


def test_coarse_truth_gives_no_fine_scores():
    scores = evaluate_disparity(row(1.0, 2.0), row(1.0, 2.0), ALL, step_px=1.5)
    assert scores["bad1"] is None
    assert (scores["bad2"], scores["bad3"], scores["d1"]) == (0, 0, 0)


def test_end_point_error_agrees_with_kornia():
    rng = np.random.default_rng(0)
    pred, truth = rng.uniform(0, 9, (2, 5, 6))
    flows = [torch.from_numpy(np.stack([d, np.zeros_like(d)], -1)) for d in (pred, truth)]
    expected = float(kornia.metrics.aepe(*flows))
    assert evaluate_disparity(pred, truth, np.ones((5, 6), bool))["epe"] == pytest.approx(expected)


def test_ause_is_zero_for_the_right_order_and_known_for_the_reversed_one():
    truth, pred = row(1.0, 1.0), row(1.0, 1.5)
    assert ause(pred, truth, ALL, row(0.0, 9.0), steps=2) == pytest.approx(0)
    # Reversed: all pixels 0.25 either way; without the "worst" one 0.5 is left instead of 0.
    assert ause(pred, truth, ALL, row(9.0, 0.0), steps=2) == pytest.approx((0 + 0.5) / 2)


@pytest.mark.parametrize("seed", range(3))
def test_ause_is_never_negative_and_scale_free_in_uncertainty(seed):
    rng = np.random.default_rng(seed)
    truth, pred, sigma = rng.uniform(1, 5, (3, 20, 20))
    valid = rng.random((20, 20)) > 0.3
    value = ause(pred, truth, valid, sigma)
    assert value > 0
    assert ause(pred, truth, valid, 7 * sigma) == pytest.approx(value)


@pytest.mark.parametrize("scale, shift", [(3.0, 0.5), (-2.0, 9.0)])
def test_least_squares_recovers_an_affine_map(scale, shift):
    x = np.random.default_rng(1).uniform(0, 1, (6, 7))
    mask = x > 0.2
    target = np.where(mask, scale * x + shift, 1e6)
    assert least_squares(x, target, mask) == pytest.approx((scale, shift))


@pytest.mark.parametrize("space", ["depth", "disparity", "log", "log1p", "sqrt_disparity"])
def test_alignment_is_exact_where_the_prediction_is_affine_in_its_space(space):
    truth = np.random.default_rng(2).uniform(1, 9, (6, 7))
    in_space = {"depth": truth, "disparity": 1 / truth, "sqrt_disparity": truth**-0.5}
    in_space |= {"log": np.log(truth), "log1p": np.log(truth + 1)}
    values = 0.7 * in_space[space] + 0.2
    np.testing.assert_allclose(align(values, truth, np.ones((6, 7), bool), space), truth, rtol=1e-9)


def test_aligned_disparity_is_clipped_before_it_is_inverted():
    truth = row(1.0, 2.0, 4.0)
    values = row(1.0, 0.5, -5.0)  # the last one is not positive: left out of the fit, then clipped
    aligned = align(values, truth, np.ones((1, 3), bool), "disparity")
    np.testing.assert_allclose(aligned, row(1.0, 2.0, 1 / MIN_DISPARITY))


def test_depth_sent_behind_the_camera_is_clipped_not_dropped():
    truth, values = row(1.0, 2.0, 3.0), row(1.0, 2.0, 3.0)
    outlier = np.concatenate([values, row(-4.0)], 1)
    valid = np.array([[True, True, True, False]])
    aligned = align(outlier, np.concatenate([truth, row(5.0)], 1), valid)
    assert aligned[0, 3] == FLOOR_M


def test_a_map_without_a_value_is_aligned_to_nothing():
    truth = np.full((4, 5), 2.0)
    for space, hole in (("depth", np.nan), ("disparity", 0.0)):
        assert np.isnan(align(np.full((4, 5), hole), truth, truth > 0, space)).all()


def test_alignment_names_an_unknown_space():
    with pytest.raises(ValueError, match="space must be one of depth, disparity"):
        align(row(1.0), row(1.0), np.ones((1, 1), bool), "inverse")


def test_confidence_deciles_closed_form():
    truth, valid = np.full((1, 4), 2.0), np.array([[True, True, True, False]])
    pred = np.array([[2.0, 2.1, 3.0, 9.0]])
    found = confidence_deciles(pred, truth, valid, np.array([[0.95, 1.0, 0.25, 0.25]]), within=0.1)
    assert [decile["share"] for decile in found] == pytest.approx([0, 0, 1 / 3, 0, 0, 0, 0, 0, 0, 2 / 3])
    assert found[9] == pytest.approx({"share": 2 / 3, "promised": 0.975, "kept": 1.0, "abs_rel": 0.025})
    assert found[2]["kept"] == 0.0 and found[2]["abs_rel"] == pytest.approx(0.5)
    assert found[5]["kept"] is None
