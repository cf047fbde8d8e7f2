"""Metrics against plain loops over pixels, and alignment against known affine maps."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geodiff_plugin.evaluation import metrics

NAN = float("nan")


def maps(seed, size=(7, 11)):
    """Truth from 0.1 m to 300 m with unknown pixels, and a prediction with holes of every kind."""
    rng = np.random.default_rng(seed)
    ground_truth = np.exp(rng.uniform(-2.3, 5.7, size))
    pred = ground_truth * np.exp(rng.normal(0, 0.4, size))
    pred[rng.random(size) > 0.8] = rng.choice([NAN, np.inf, 0.0, -1.0])
    ground_truth[0, 0], pred[1, 1] = 2.0, 3.0
    return pred, ground_truth, rng.random(size) > 0.2


@given(seed=st.integers(0, 200), cap=st.sampled_from([None, 20.0, 80.0]))
def test_depth_metrics_pixel_by_pixel(seed, cap):
    pred, ground_truth, valid = maps(seed)
    valid[0, 0], pred[0, 0] = True, 1.0
    triples = zip(pred.flat, ground_truth.flat, valid.flat, strict=True)
    known = [(p, t) for p, t, v in triples if v and (not cap or t < cap)]
    pairs = [(min(p, cap or p), t) for p, t in known if math.isfinite(p) and p > 0]
    n, logs = len(pairs), [math.log(p) - math.log(t) for p, t in pairs]
    squares = sum(log**2 for log in logs) / n
    expected = {"pixels": len(known), "coverage": n / len(known)}
    expected["abs_rel"] = sum(abs(p - t) / t for p, t in pairs) / n
    expected["rmse"] = math.sqrt(sum((p - t) ** 2 for p, t in pairs) / n)
    expected["log_rmse"] = math.sqrt(squares)
    expected["silog"] = 100 * math.sqrt(max(squares - (sum(logs) / n) ** 2, 0.0))
    for k in (1, 2, 3):
        expected[f"delta{k}"] = sum(max(p / t, t / p) < 1.25**k for p, t in pairs) / n
    expected["inliers"] = sum(max(p / t, t / p) < 1.03 for p, t in pairs) / n
    for mask in (valid, valid.astype(np.uint8)):
        assert metrics.evaluate_depth(pred, ground_truth, mask, cap) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("step_px", [0.0, 1.5, 4.0])
def test_disparity_metrics_pixel_by_pixel(step_px):
    ground_truth, pred = (
        np.array([[100.0, 10.0, 50.0, 5.0, 9.0]]),
        np.array([[104.0, 13.5, 50.5, np.inf, 9.0]]),
    )
    valid = np.array([[True, True, True, True, False]])
    expected = {"epe": 8 / 3, "bad1": 2 / 3, "bad2": 2 / 3, "bad3": 2 / 3, "d1": 1 / 3}  # 4 of 100 are no 5 %
    coarse = {name for name, least in (("bad1", 1), ("bad2", 2), ("bad3", 3), ("d1", 3)) if step_px > least}
    expected |= dict.fromkeys(coarse)
    assert metrics.evaluate_disparity(pred, ground_truth, valid, step_px) == pytest.approx(expected)
    assert math.isnan(metrics.evaluate_disparity(np.full((1, 5), NAN), ground_truth, valid, step_px)["epe"])


@settings(deadline=None)
@given(seed=st.integers(0, 200), steps=st.integers(1, 30))
def test_ause_pixel_by_pixel(seed, steps):
    pred, ground_truth, valid = maps(seed)
    valid[1, 1] = True
    sigma = (
        np.random.default_rng(seed).permutation(ground_truth.size).reshape(ground_truth.shape).astype(float)
    )
    pixels = zip(pred.flat, ground_truth.flat, sigma.flat, valid.flat, strict=True)
    kept = [(abs(p - t) / t, s) for p, t, s, v in pixels if v and math.isfinite(p) and p > 0]

    def curve(key):
        ordered = [error for error, _ in sorted(kept, key=key, reverse=True)]
        left = [ordered[k * len(ordered) // steps :] for k in range(steps)]
        return np.array([sum(rest) / len(rest) for rest in left])

    best, mean = curve(lambda e: e[0]), sum(e for e, _ in kept) / len(kept)
    expected = np.mean(curve(lambda e: e[1]) - best)
    orders = ((sigma, expected), (7 * sigma, expected), (None, mean - best.mean()))
    for uncertainty, area in orders:
        assert metrics.ause(pred, ground_truth, valid, uncertainty, steps) == pytest.approx(area, abs=1e-9)
    found = metrics.risk_coverage(pred, ground_truth, valid, sigma, steps)
    np.testing.assert_allclose(found.risk, curve(lambda e: e[1]), atol=1e-12)
    np.testing.assert_allclose(found.oracle, best, atol=1e-12)
    np.testing.assert_allclose(found.coverage, [1 - k / steps for k in range(steps)])
    assert found.risk[0] == pytest.approx(mean) and (found.risk >= found.oracle - 1e-12).all()


def test_confidence_deciles_closed_form():
    ground_truth, valid = np.full((1, 4), 2.0), np.array([[True, True, True, False]])
    pred = np.array([[2.0, 2.1, 3.0, 9.0]])
    classes = metrics.confidence_deciles(
        pred, ground_truth, valid, np.array([[0.95, 1.0, 0.25, 0.25]]), within=0.1
    )
    assert [decile["fraction"] for decile in classes] == pytest.approx([0, 0, 1 / 3, 0, 0, 0, 0, 0, 0, 2 / 3])
    assert classes[9] == pytest.approx(
        {"fraction": 2 / 3, "predicted": 0.975, "observed": 1.0, "abs_rel": 0.025}
    )
    assert classes[2]["observed"] == 0.0 and classes[2]["abs_rel"] == pytest.approx(0.5)
    assert classes[5]["observed"] is None


@pytest.mark.parametrize("scale", [0.7, -2.0])
@pytest.mark.parametrize("space", ["depth", "disparity", "log", "log1p", "sqrt_disparity"])
def test_alignment_is_exact_where_the_prediction_is_affine_in_its_space(space, scale):
    ground_truth = np.random.default_rng(2).uniform(1, 90, (6, 7))
    in_space = {"depth": ground_truth, "disparity": 1 / ground_truth, "sqrt_disparity": ground_truth**-0.5}
    in_space |= {"log": np.log(ground_truth), "log1p": np.log(ground_truth + 1)}
    values, valid = scale * in_space[space] + 9.0, ground_truth > 2
    values[~valid] = 1e3  # is no part of the fit
    np.testing.assert_allclose(
        metrics.align(values, ground_truth, valid, space)[valid], ground_truth[valid], rtol=1e-8
    )


def test_alignment_clips_what_lies_behind_the_camera_or_too_far_and_keeps_holes():
    ground_truth, values = np.array([[1.0, 2.0, 4.0]]), np.array([[1.0, 0.5, -5.0]])
    aligned = metrics.align(
        values, ground_truth, ground_truth > 0, "disparity"
    )  # the last is no part of the fit
    np.testing.assert_allclose(aligned, [[1.0, 2.0, metrics.MAX_ALIGNED_M]])
    behind = metrics.align(np.array([[1.0, 2.0, -4.0]]), ground_truth, np.array([[True, True, False]]))
    assert behind[0, 2] == metrics.FLOOR_M
    for space, hole in (("depth", NAN), ("disparity", 0.0)):
        assert np.isnan(metrics.align(np.full((1, 3), hole), ground_truth, ground_truth > 0, space)).all()


def test_no_ground_truth_and_no_uncertainty_are_rejected():
    one = np.ones((1, 1))
    with pytest.raises(ValueError, match="no valid pixel"):
        metrics.counted(np.array([[100.0, 0.0]]), np.ones((1, 2), bool), 80.0)
    with pytest.raises(ValueError, match="uncertainty must be finite"):
        metrics.ause(NAN * one, one, one > 0, one)


def steps(seed, size=(17, 23)):
    """True disparity with steps, a noisy copy, and holes, at a size that is no multiple of anything."""
    rng = np.random.default_rng(seed)
    ground_truth = 5.0 + 8.0 * (rng.random(size) > 0.97).cumsum(axis=1) % 24 + 0.1 * rng.random(size)
    return ground_truth, ground_truth + rng.normal(0, 2, size), rng.random(size) > 0.15


@pytest.mark.parametrize("seed", range(2))
def test_steps_reach_four_pixels_and_hide_what_something_nearer_covers(seed):
    ground_truth, _, valid = steps(seed)
    apart = []
    for (r, c), d in np.ndenumerate(ground_truth):
        for q in ((r, c + 1), (r + 1, c)):
            if q[0] < ground_truth.shape[0] and q[1] < ground_truth.shape[1] and valid[r, c] and valid[q]:
                apart += [(r, c), q] if abs(ground_truth[q] - d) > 3 else []
    near, hidden = np.zeros(ground_truth.shape, bool), np.zeros(ground_truth.shape, bool)
    for r, c in zip(*np.nonzero(valid), strict=True):
        near[r, c] = any(np.hypot(r - y, c - x) <= 4 for y, x in apart)
        column = round(c - ground_truth[r, c])
        others = [
            ground_truth[r, k] for k in np.flatnonzero(valid[r]) if round(k - ground_truth[r, k]) == column
        ]
        hidden[r, c] = 0 <= column < ground_truth.shape[1] and max(others) > ground_truth[r, c] + 1
    np.testing.assert_array_equal(metrics.near_disparity_steps(ground_truth, valid), near)
    np.testing.assert_array_equal(metrics.occluded_by_ground_truth(ground_truth, valid), hidden)
    assert not metrics.near_disparity_steps(np.full((5, 6), 9.0), np.ones((5, 6), bool)).any()


@pytest.mark.parametrize("seed", range(2))
def test_boundary_f1_by_direction_and_threshold(seed):
    ground_truth, pred, valid = steps(seed)
    ground_truth, pred = 100.0 / ground_truth, 100.0 / np.abs(pred)
    known = valid & np.isfinite(pred)
    height, width = ground_truth.shape
    total = weights = 0.0
    for t in np.linspace(1.05, 1.25, 10):
        recall = precision = 0.0
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            hits = drawn = true = 0
            for r, c in np.ndindex(height, width):
                q = (r + dy, c + dx)
                if 0 <= q[0] < height and 0 <= q[1] < width and known[r, c] and known[q]:
                    a, b = pred[q] / pred[r, c] > t, ground_truth[q] / ground_truth[r, c] > t
                    hits, drawn, true = hits + (a and b), drawn + a, true + b
            recall, precision = recall + hits / max(true, 1) / 4, precision + hits / max(drawn, 1) / 4
        total += t * 2 * recall * precision / (recall + precision) if recall + precision else 0
        weights += t
    assert metrics.boundary_f1(pred, ground_truth, valid) == pytest.approx(total / weights)
    assert metrics.boundary_f1(7.0 * pred, ground_truth, valid) == pytest.approx(total / weights)
    assert np.isnan(metrics.boundary_f1(pred, np.ones_like(ground_truth), valid))


@pytest.mark.parametrize("moved", [0, 3, 6])
def test_boundary_errors_are_distances_of_parallel_edges(moved):
    ground_truth, pred = (np.where(np.arange(60)[None] < c, 2.0, 7.0).repeat(40, 0) for c in (30, 30 + moved))
    errors = metrics.boundary_errors(3.0 * pred, ground_truth, np.ones(ground_truth.shape, bool))
    assert errors == pytest.approx({"dbe_acc": moved, "dbe_comp": moved}, abs=0.2)


@pytest.mark.parametrize(("least", "most", "first"), [(0.02, 0.12, 11), (0.02, 0.09, None), (0.1, 0.15, 0)])
def test_weak_edges_count_where_they_are_connected_to_a_strong_one(least, most, first):
    """A step whose height grows with the rows, next to one of height 1, and 3 px away from ground truth.

    Behind a blur of sqrt(2) px Sobel's filter answers a step with 2.1 times its height, so that an edge is
    weak from a height of about 0.048 on and strong from 0.095 on.
    """
    rows, heights = 40, np.linspace(least, most, 40)[:, None]
    columns = np.arange(100)[None]
    ground_truth, pred = (1.0 * (columns >= 20) - heights * (columns >= at) + 1.0 for at in (60, 63))
    found = metrics.boundary_errors(pred, ground_truth, np.ones(ground_truth.shape, bool))
    drawn = 0 if first is None else rows - first
    expected = 3 * drawn / (rows + drawn)
    assert found == pytest.approx({"dbe_acc": expected, "dbe_comp": expected}, abs=0.12)


def test_the_sparsification_error_takes_a_hundred_steps():
    pred, ground_truth, valid = maps(0, (20, 30))
    sigma = np.random.default_rng(1).random(ground_truth.shape)
    areas = [metrics.ause(pred, ground_truth, valid, sigma, steps) for steps in (99, 100, 101)]
    assert metrics.ause(pred, ground_truth, valid, sigma) == areas[1] and len(set(areas)) == 3


def test_holes_are_bad_pixels_and_an_empty_mask_has_no_fraction():
    ground_truth = np.full((2, 4), 10.0)
    pred = np.array([[10.0, 12.0, 12.5, np.nan], [np.inf, 7.9, 8.0, 99.0]])
    mask = np.ones((2, 4), bool)
    mask[1, 3] = False
    # Errors 0, 2, 2.5, hole, hole, 2.1, 2 in the mask: only errors above 2 are bad.
    assert metrics.bad_fraction(pred, ground_truth, mask, 2.0) == pytest.approx(4 / 7)
    assert metrics.bad_fraction(pred, ground_truth, mask, 1.0) == pytest.approx(6 / 7)
    assert metrics.bad_fraction(pred, ground_truth, np.zeros((2, 4), bool), 1.0) is None


def test_inliers_are_within_three_per_cent_either_way():
    ground_truth = np.full((1, 6), 2.0)
    pred = ground_truth * [[1.0, 1.029, 1.031, 1 / 1.029, 1 / 1.031, 0]]
    scores = metrics.evaluate_depth(pred, ground_truth, ground_truth > 0)
    assert scores["inliers"] == pytest.approx(3 / 5)


def test_values_that_are_not_finite_stay_holes():
    truth = np.linspace(1.0, 4.0, 24).reshape(4, 6)
    for space in metrics.SPACES:
        values = metrics.to_space(truth, space)
        values[0, :3] = np.nan, np.inf, -np.inf
        aligned = metrics.align(values, truth, np.ones(truth.shape, bool), space)
        assert np.isnan(aligned[0, :3]).all()
        np.testing.assert_allclose(aligned[1:], truth[1:], rtol=1e-6)
