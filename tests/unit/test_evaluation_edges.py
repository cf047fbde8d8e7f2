"""Metrics of edges against plain loops over pixels, and against closed forms."""

import numpy as np
import pytest

from geodiff_plugin.evaluation.edges import (
    boundary_errors,
    boundary_f1,
    edge_error,
    hidden_by_truth,
    near_disparity_steps,
    surface_error,
)


def maps(seed, size=(17, 23)):
    """True disparity with steps, a noisy copy, and holes, at a size that is no multiple of anything."""
    rng = np.random.default_rng(seed)
    truth = 5.0 + 8.0 * (rng.random(size) > 0.97).cumsum(axis=1) % 24 + 0.1 * rng.random(size)
    return truth, truth + rng.normal(0, 2, size), rng.random(size) > 0.15


@pytest.mark.parametrize("seed", range(2))
def test_near_a_step_is_within_four_pixels_of_known_neighbours_apart(seed):
    truth, _, valid = maps(seed)
    steps = []
    for (r, c), d in np.ndenumerate(truth):
        for q in ((r, c + 1), (r + 1, c)):
            if q[0] < truth.shape[0] and q[1] < truth.shape[1] and valid[r, c] and valid[q]:
                steps += [(r, c), q] if abs(truth[q] - d) > 3 else []
    expected = np.zeros(truth.shape, bool)
    for r, c in np.ndindex(truth.shape):
        expected[r, c] = valid[r, c] and any(np.hypot(r - y, c - x) <= 4 for y, x in steps)
    np.testing.assert_array_equal(near_disparity_steps(truth, valid), expected)
    assert not near_disparity_steps(np.full((5, 6), 9.0), np.ones((5, 6), bool)).any()


@pytest.mark.parametrize("seed", range(2))
def test_hidden_is_what_something_nearer_covers(seed):
    truth, _, valid = maps(seed)
    expected = np.zeros(truth.shape, bool)
    for r, c in zip(*np.nonzero(valid), strict=True):
        column = round(c - truth[r, c])
        others = [truth[r, k] for k in np.flatnonzero(valid[r]) if round(k - truth[r, k]) == column]
        expected[r, c] = 0 <= column < truth.shape[1] and max(others) > truth[r, c] + 1
    np.testing.assert_array_equal(hidden_by_truth(truth, valid), expected)


@pytest.mark.parametrize("seed", range(2))
def test_boundary_f1_by_direction_and_threshold(seed):
    truth, pred, valid = maps(seed)
    truth, pred = 100.0 / truth, 100.0 / np.abs(pred)
    known = valid & np.isfinite(pred)
    height, width = truth.shape
    total = weights = 0.0
    for t in np.linspace(1.05, 1.25, 10):
        recall = precision = 0.0
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            hits = drawn = true = 0
            for r, c in np.ndindex(height, width):
                q = (r + dy, c + dx)
                if 0 <= q[0] < height and 0 <= q[1] < width and known[r, c] and known[q]:
                    a, b = pred[q] / pred[r, c] > t, truth[q] / truth[r, c] > t
                    hits, drawn, true = hits + (a and b), drawn + a, true + b
            recall, precision = recall + hits / max(true, 1) / 4, precision + hits / max(drawn, 1) / 4
        total += t * 2 * recall * precision / (recall + precision) if recall + precision else 0
        weights += t
    assert boundary_f1(pred, truth, valid) == pytest.approx(total / weights)
    assert boundary_f1(7.0 * pred, truth, valid) == pytest.approx(total / weights)
    assert np.isnan(boundary_f1(pred, np.ones_like(truth), valid))


@pytest.mark.parametrize("moved", [0, 3, 6])
def test_boundary_errors_are_distances_of_parallel_edges(moved):
    truth, pred = (np.where(np.arange(60)[None] < c, 2.0, 7.0).repeat(40, 0) for c in (30, 30 + moved))
    errors = boundary_errors(3.0 * pred, truth, np.ones(truth.shape, bool))
    assert errors == pytest.approx({"dbe_acc": moved, "dbe_comp": moved}, abs=0.2)


def test_boundary_errors_without_boundaries():
    truth = np.where(np.arange(60)[None] < 30, 2.0, 7.0).repeat(40, 0)
    valid, flat = np.ones(truth.shape, bool), np.full(truth.shape, 3.0)
    assert boundary_errors(flat, truth, valid) == {"dbe_acc": 10.0, "dbe_comp": 10.0}
    far = np.where(np.arange(60)[None] < 50, 2.0, 7.0).repeat(40, 0)
    assert boundary_errors(far, truth, valid)["dbe_acc"] == 10.0
    assert np.isnan(boundary_errors(truth, flat, valid)["dbe_comp"])
    assert np.isnan(boundary_errors(np.full(truth.shape, np.nan), truth, valid)["dbe_acc"])


def test_errors_at_edges_and_of_surfaces():
    truth = np.full((40, 60), 2.0)
    truth[:, 30:] = 4.0
    valid = np.ones(truth.shape, bool)
    assert edge_error(truth, truth, valid) == surface_error(truth, truth, valid) == 0.0
    shifted = np.full((40, 60), 2.0)
    shifted[:, 32:] = 4.0
    assert edge_error(shifted, truth, valid) > 0.1 and surface_error(shifted, truth, valid) == 0.0
    rough = truth * np.exp(0.01 * np.random.default_rng(0).normal(size=truth.shape))
    assert surface_error(rough, truth, valid) > 5.0
    assert np.isnan(edge_error(np.ones((9, 9)), np.full((9, 9), 2.0), np.ones((9, 9), bool)))
