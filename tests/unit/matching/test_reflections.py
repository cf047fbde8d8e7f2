"""What remains of matches that may be reflections, against NumPy."""

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter
from scipy.stats import norm

from geodiff_plugin.matching import reflections
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.reflections import reject_reflections


def remaining(inverse: np.ndarray, confidence: np.ndarray, depth_m: np.ndarray, every: int = 1) -> np.ndarray:
    """One image's share of each match that is no reflection, by the definition."""
    behind = np.clip(-np.log(np.maximum(inverse * depth_m, 1e-6)), -1.5, 1.5)
    counted = np.where(confidence > 0.3, behind, np.nan)
    spread = 1.5
    if np.isfinite(counted).any():
        ordered = np.sort(counted[np.isfinite(counted)])
        apart = np.abs(counted - ordered[(len(ordered) - 1) // 2]).ravel()[::every]
        spread = np.nanquantile(apart, 0.6) / norm.ppf(0.8)
    least = max(3 * spread, 0.2)
    radius = round(0.08 * max(depth_m.shape))
    sums = [
        uniform_filter(x, 2 * radius + 1, mode="constant") * (2 * radius + 1) ** 2
        for x in (behind * confidence, confidence)
    ]
    region = sums[0] / np.maximum(sums[1], 1)
    return 1 - np.clip((np.minimum(region, behind) / least - 1) / 0.6, 0, 1)


def reflecting_batch(size=(31, 44)):
    """Three images with reflections: of a good prior, of one that errs more, and without a certain match."""
    rng = np.random.default_rng(6)
    depth_m = rng.uniform(2, 6, (3, 1, *size))
    noise = np.array([0.02, 0.12, 0.05]).reshape(3, 1, 1, 1)
    inverse = np.exp(rng.normal(0.1, noise, depth_m.shape)) / depth_m
    inverse[0, 0, 5:20, 8:25] /= 1.45
    inverse[1, 0, 12:28, 20:38] /= 2.8
    inverse[:, :, 28:, :3] = 0.0
    confidence = rng.random(depth_m.shape) * (rng.random(depth_m.shape) < 0.8)
    confidence[2] *= 0.29
    inverse[2, 0, 5:25, 5:30] /= 2.0
    # One match alone: its region does not support it.
    confidence[0, 0, :14, 28:], confidence[0, 0, 5, 36] = 0.0, 0.7
    inverse[0, 0, 5, 36] /= 2.0
    return inverse, confidence, depth_m


@pytest.mark.parametrize("every", [1, 4])
def test_what_remains_of_the_reflections_of_each_image_follows_from_its_own_spread(monkeypatch, every):
    inverse, confidence, depth_m = reflecting_batch()
    if every > 1:  # more distances than are sorted: every fourth one is
        monkeypatch.setattr(reflections, "MAX_SORTED", depth_m.size // 3)
    given = [torch.from_numpy(x).float() for x in (inverse, confidence, depth_m)]
    found = reject_reflections(Matches(given[0], given[1], torch.full((3,), 0.01)), given[2])
    assert found.is_contiguous()
    for b in range(3):
        expected = remaining(inverse[b, 0], confidence[b, 0], depth_m[b, 0], every)
        np.testing.assert_allclose(found[b, 0], expected, atol=2e-4)
    assert (found[0, 0, 8:17, 12:20] < 0.5).any() and (found[1] < 0.5).any()
    assert (found[2] == 1).all()
    partly = (found > 0) & (found < 1)
    assert partly[0].any() and partly[1].any()


def test_what_lies_before_the_prior_is_never_a_reflection():
    inverse, confidence, depth_m = reflecting_batch()
    near = np.where(inverse > 0, 1 / np.maximum(inverse, 1e-9) / depth_m**2, 0.4)
    given = [torch.from_numpy(x).float() for x in (near, confidence, depth_m)]
    found = reject_reflections(Matches(given[0], given[1], torch.full((3,), 0.01)), given[2])
    assert (found[:2] == 1).float().mean() > 0.95


def test_more_values_than_are_sorted_are_left_to_the_reference(asked_kernels, monkeypatch):
    inverse, confidence, depth_m = reflecting_batch()
    given = [torch.from_numpy(x).float() for x in (inverse, confidence, depth_m)]
    matches = Matches(given[0], given[1], torch.full((3,), 0.01))
    monkeypatch.setattr(reflections, "MAX_SORTED", depth_m.size + 1)
    assert reject_reflections(matches, given[2]) == "matching.kernels.reflections.remaining"
    monkeypatch.setattr(reflections, "MAX_SORTED", depth_m.size)
    assert reject_reflections(matches, given[2]).shape == depth_m.shape and len(asked_kernels) == 1
