"""Statistics of matches against NumPy on the same maps."""

import math

import numpy as np
import pytest
import torch

from geodiff_plugin.trust import match_statistics as module
from geodiff_plugin.trust.match_statistics import match_statistics
from tests.unit.trust.made_stages import FULL, GRID, STEP, as_map, made_result, matches_of


def nearest(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    at = [
        ((np.arange(new) + 0.5) * old / new).astype(int) for new, old in zip(size, values.shape, strict=True)
    ]
    return values[np.ix_(*at)]


def lower_median(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.5, method="lower"))


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse depths, some at infinity or behind it, their confidence, and a depth of another size."""
    rng = np.random.default_rng(seed)
    inverse = rng.uniform(0.1, 0.7, GRID)
    for value in (0.004, -0.02, 0.0):  # the first is nearer to infinity than a plane
        inverse[rng.random(GRID) < 0.05] = value
    confidence = rng.random(GRID)
    confidence[rng.random(GRID) < 0.05] = 0.5
    return inverse, confidence, rng.uniform(1.2, 9.0, FULL)


@pytest.mark.parametrize("max_sorted", [1 << 22, 400])
def test_numbers_of_matches_and_depth(monkeypatch, max_sorted):
    monkeypatch.setattr(module, "MAX_SORTED", max_sorted)
    inverse, confidence, depth_m = scene()
    found = match_statistics(matches_of(inverse, confidence), as_map(depth_m)[None])
    confident = confidence > 0.5
    in_front = confident & (inverse > 0)
    every = max(1, inverse.size // max_sorted)
    sample = np.where(in_front, inverse, np.nan).ravel()[::every]
    sample = sample[np.isfinite(sample)]
    low, high = np.quantile(sample, (0.05, 0.95))
    compared = confident & (inverse > STEP)
    deviation = np.log(nearest(depth_m, GRID) * inverse, where=compared, out=np.zeros(GRID))
    expected = {
        "matched": confident.mean(),
        "in_front": in_front.sum(),
        "log_range": math.log(high / low),
        "range_planes": (high - low) / STEP,
        "median_m": 1 / lower_median(sample),
        "log_deviation": lower_median(np.abs(deviation[compared])),
        "compared": compared.sum(),
    }
    assert {name: float(number) for name, number in found.items()} == pytest.approx(expected, rel=1e-4)


def test_without_a_confident_match_nothing_is_known():
    inverse, _, depth_m = scene()
    found = match_statistics(matches_of(inverse, np.full(GRID, 0.5)), as_map(depth_m)[None])
    assert [float(found[name]) for name in ("matched", "in_front", "compared")] == [0.0] * 3
    assert all(math.isnan(found[name]) for name in found.keys() - {"matched", "in_front", "compared"})


def test_they_are_computed_once_for_all_checks(monkeypatch):
    inverse, confidence, depth_m = scene()
    computed = []
    monkeypatch.setattr(
        module, "_of_grid", lambda *given: computed.append(given) or {"matched": torch.ones(())}
    )
    stage = made_result(matches_of(inverse, confidence), depth_m=depth_m)
    assert stage.matched is stage.matched and len(computed) == 1
    assert made_result().matched == {}


def test_more_values_than_the_kernel_sorts_are_left_to_the_reference(asked_kernels, monkeypatch):
    inverse, confidence, _ = scene()
    matches, depth_m = matches_of(inverse, confidence), torch.full((1, *GRID), 3.0)
    monkeypatch.setattr(module, "MAX_SORTED", depth_m.numel() // 2 + 1)
    assert module._of_grid(matches, depth_m) == "trust.kernels.match_statistics.of_grid"
    monkeypatch.setattr(module, "MAX_SORTED", depth_m.numel() // 2)
    assert module._of_grid(matches, depth_m)["matched"] > 0 and len(asked_kernels) == 1
