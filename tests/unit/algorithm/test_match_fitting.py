"""The fit of a map to its matches, stage by stage against NumPy, for samples that differ in everything.

The numbers of the references are the documented ones, written once more: a reference side of 512 pixels, a
reference error of 5 %, and so on.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import ndimage

from geodiff_plugin.algorithm import match_fitting
from geodiff_plugin.algorithm.match_fitting import (
    edge_affinities,
    fit_depth,
    fit_target,
    highest,
    local_error,
    log_depth_at,
    off_edges,
    prior_error,
    range_around,
)
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from tests.unit.algorithm.references import robust_field, weighted_quantile

CONFIG = DEFAULT.changed(smoothness=30.0, match_sigma=0.03, outlier_sigma=2.0)
GRID, MAP, IMAGE = (26, 34), (19, 29), (41, 63)  # of the matches, of the depth map, of the image


def drawn(*shape: int, seed: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def smooth(*shape: int, seed: int) -> torch.Tensor:
    """A smooth random map between -1 and 1."""
    coarse = drawn(*shape[:2], 3, 4, seed=seed, low=-1.0)
    return F.interpolate(coarse, shape[-2:], mode="bicubic").clamp(-1.0, 1.0)


def scene(samples: int = 2) -> tuple[torch.Tensor, Matches, torch.Tensor]:
    """Depth maps, matches from which they differ smoothly and at outliers, and images; all differ by sample.

    The second sample is three times as far away, its matches are coarser, and it has few of them.
    """
    log_depth = 0.4 * smooth(samples, 1, *MAP, seed=1) + torch.arange(samples).view(-1, 1, 1, 1)
    log_depth[..., :, 17:] += 0.8  # a depth edge
    ground_truth = F.interpolate(log_depth, GRID, mode="bilinear") - 0.15 * smooth(samples, 1, *GRID, seed=2)
    noise = 0.02 * torch.randn(samples, 1, *GRID, generator=torch.Generator().manual_seed(3))
    outliers = (drawn(samples, 1, *GRID, seed=4) > 0.93) * 0.7
    matched = drawn(samples, 1, *GRID, seed=5)
    confidence = (matched - torch.tensor([0.3, 0.6, 0.2])[:samples].view(-1, 1, 1, 1)).clamp_min(0.0) * 1.3
    step = torch.tensor([0.01, 0.006, 0.02])[:samples]
    image = (0.5 + 0.5 * smooth(samples, 3, *IMAGE, seed=6)).clamp(0, 1)
    image[..., 25:, :] *= 0.4  # an edge of the image
    return log_depth.exp(), Matches((-ground_truth + noise + outliers).exp(), confidence, step), image


def array(tensor: torch.Tensor, sample: int) -> np.ndarray:
    """One sample of ``(B, 1, h, w)`` as ``(h, w)``, float64."""
    return tensor[min(sample, len(tensor) - 1), 0].double().numpy()


def affinities(image: np.ndarray, log_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Across and down, of an image ``(3, h, w)`` and a map on one grid."""
    scale = max(log_depth.shape) / 512.0
    found = []
    for axis in (1, 0):
        step = np.abs(np.diff(image, axis=axis + 1)).mean(0) / 0.1
        jump = np.abs(np.diff(log_depth, axis=axis)) / 0.1
        found.append(scale**2 * np.maximum(np.exp(-scale * (step + jump)), 1e-3))
    return found[0], found[1]


class Observed:
    """What a fit of one sample reads: residuals, noise, weights and links on the grid of the matches."""

    def __init__(self, depth_m, target: Matches, image, sample: int) -> None:
        log_depth = F.interpolate(depth_m.log(), GRID, mode="bilinear")
        guide = F.interpolate(image, GRID, mode="bilinear", antialias=True)
        inverse = np.maximum(array(target.inverse_depth, sample), 1e-9)
        self.confidence = array(target.confidence, sample)
        self.noise = np.hypot(float(target.plane_step[sample]) / inverse, CONFIG.match_sigma)
        self.weight = self.confidence * (CONFIG.match_sigma / self.noise) ** 2
        self.residual = np.where(self.weight > 0, np.log(inverse) + array(log_depth, sample), 0.0)
        self.affinities = affinities(guide[sample].double().numpy(), array(log_depth, sample))

    def stiff(self, trusted, error):
        """Field and weights of the fit that bends the map over wide regions only."""
        width = CONFIG.outlier_sigma * np.hypot(self.noise, error)
        passes = [(400.0, 1.3e-3 * 400.0)]
        return robust_field(self.residual, trusted, width, self.affinities, passes, 3, 6)[:2]

    def spread(self, residual) -> float:
        """Robust standard deviation of residuals less their noise, between 0.01 and 0.5."""
        if not self.weight.any():
            return 0.5
        expected = np.average(np.minimum(self.confidence, 1.0), weights=self.weight)
        largest = weighted_quantile(np.abs(residual), self.weight, 0.8 * expected) / 1.2816
        noise = weighted_quantile(self.noise, self.weight, 0.5)
        return float(np.clip(np.sqrt(max(largest**2 - noise**2 / 4, 0.0)), 0.01, 0.5))


def levels(error):
    """Smoothness and inertia of the three passes for a prior's error, a number or a map."""
    ratio = (0.05 / error) ** 4
    last = np.clip(CONFIG.smoothness * ratio, 0.03, 100.0)
    broad = np.maximum(last, 50.0)
    tikhonov = np.minimum(0.015 * ratio, 0.03)
    least = [1e-4, np.sqrt(1e-4 * 5e-4), 5e-4]
    smoothness = [broad, np.sqrt(broad * last), last]
    return [(a, np.maximum(tikhonov, floor)) for a, floor in zip(smoothness, least, strict=True)]


@pytest.mark.parametrize("kind", ["of a sample", "of a pixel", "on another grid"])
def test_a_fit_follows_matches_as_in_its_formula(kind):
    depth_m, target, image = scene()
    error = {
        "of a sample": torch.tensor([0.03, 0.09]).view(2, 1, 1, 1),
        "of a pixel": drawn(2, 1, *GRID, seed=7, low=0.02, high=0.25),
        "on another grid": drawn(2, 1, 13, 17, seed=8, low=0.02, high=0.25),
    }[kind]
    fit = fit_depth(depth_m, target, image, error, CONFIG)
    on_grid = error if kind == "of a sample" else F.interpolate(error, GRID, mode="nearest-exact")
    for b in range(2):
        e = array(on_grid, b)
        observed = Observed(depth_m, target, image, b)
        _, trusted = observed.stiff(observed.weight, e)
        of_match = 2.5 * observed.noise
        total, _, support = robust_field(
            observed.residual, trusted, of_match, observed.affinities, levels(e), 2, 6
        )
        np.testing.assert_allclose(fit.log_change[b, 0].numpy(), total, atol=5e-5)
        down = {"mode": "bilinear", "antialias": True}  # the map is smaller than the grid of the matches
        change, shown = (
            F.interpolate(torch.from_numpy(x)[None, None], MAP, **down)[0, 0].numpy()
            for x in (total, support)
        )
        np.testing.assert_allclose(fit.depth_m[b, 0], array(depth_m, b) * np.exp(-change), rtol=1e-3)
        np.testing.assert_allclose(fit.support[b, 0], shown.clip(0, 1), atol=1e-3)
        assert np.abs(total).max() > 0.05 and shown.min() < 0.7 < shown.max()


def test_a_larger_map_is_changed_by_the_interpolated_correction():
    depth_m, target, image = scene()
    large = F.interpolate(depth_m, (70, 81), mode="bilinear")
    error = torch.tensor([0.03, 0.09]).view(2, 1, 1, 1)
    fit = fit_depth(large, target, image, error, CONFIG)
    change = F.interpolate(fit.log_change, (70, 81), mode="bilinear")
    torch.testing.assert_close(fit.depth_m, large * (-change).exp())
    assert fit.support.shape == fit.depth_m.shape and fit.support.amin() >= 0 and fit.support.amax() <= 1


@pytest.mark.parametrize("size", [(19, 29), (40, 10), (8, 60), (26, 20)])
def test_a_correction_is_smoothed_before_it_is_downscaled_along_either_axis(size):
    depth_m, target, image = scene()
    smaller_m = F.interpolate(depth_m, size)
    fit = fit_depth(smaller_m, target, image, torch.full((2, 1, 1, 1), 0.05), CONFIG)
    change = F.interpolate(fit.log_change, size, mode="bilinear", antialias=True)
    torch.testing.assert_close(fit.depth_m, smaller_m * torch.exp(-change))


def test_the_priors_error_is_cross_validated_in_blocks_as_in_its_formula():
    """Three samples: many matches, few of them and none at all."""
    depth_m, target, image = scene(3)
    target.confidence[1] *= drawn(1, *GRID, seed=9) > 0.8
    target.confidence[2] = 0.0
    found = prior_error(depth_m, target, image, CONFIG).flatten()
    rows, columns = np.indices(GRID) // 3  # 8 % of 34 pixels
    black = (rows + columns) % 2 == 1
    for b in range(3):
        observed = Observed(depth_m, target, image, b)
        first = observed.spread(observed.residual)
        of_black, of_white = (observed.stiff(observed.weight * side, first)[0] for side in (black, ~black))
        error = observed.spread(np.where(black, of_white, of_black) - observed.residual)
        fraction = min(np.count_nonzero(observed.weight) / 100.0, 1.0)
        assert found[b].item() == pytest.approx(error**fraction * 0.5 ** (1 - fraction), rel=0.01)
    assert found[2] == 0.5 and 0.01 < found[0] < found[1] < 0.5
    assert 0 < np.count_nonzero(array(target.confidence, 1)) < 100


def test_a_map_that_matches_exactly_has_the_least_error():
    depth_m = scene()[0]
    exact = 1.0 / log_depth_at(depth_m, GRID).exp()
    target = Matches(exact, torch.ones_like(exact), torch.full((2,), 1e-5))
    found = prior_error(depth_m, target, drawn(2, 3, *GRID, seed=1))
    torch.testing.assert_close(found, torch.full((2, 1, 1, 1), 0.01))


@pytest.mark.parametrize("size", [(7, 300), (300, 7)])
def test_links_fall_at_edges_of_the_image_and_of_the_map_along_both_axes(size):
    """So large that edges cut a link down to its least value."""
    image = 3.0 * drawn(2, 3, *size, seed=1) ** 3
    log_depth = drawn(2, 1, *size, seed=2) ** 4
    found = edge_affinities(image, log_depth)
    scale = (300 / 512) ** 2
    for b in range(2):
        expected = affinities(image[b].double().numpy(), array(log_depth, b))
        for got, link in zip(found, expected, strict=True):
            np.testing.assert_allclose(got[b, 0], link, rtol=1e-4)
            assert link.min() == pytest.approx(scale * 1e-3) and link.max() > 0.3 * scale


@pytest.mark.parametrize("on_device", [False, True])
def test_the_range_of_a_window_is_scipys_at_every_reach(monkeypatch, on_device):
    monkeypatch.setattr(match_fitting, "launch_bound", lambda _: on_device)
    values = drawn(2, 1, 13, 18, seed=1, low=-1.0)
    for radius in (1, 2, 3, 5):
        for b in range(2):
            one, size = array(values, b), 2 * radius + 1
            most, least = (
                f(one, size, mode="nearest") for f in (ndimage.maximum_filter, ndimage.minimum_filter)
            )
            np.testing.assert_allclose(highest(values, radius)[b, 0], most, rtol=1e-6)
            np.testing.assert_allclose(range_around(values, radius)[b, 0], most - least, rtol=1e-5)


@pytest.mark.parametrize("per_pixel", [False, True])
def test_matches_near_depth_edges_lose_confidence_by_the_step_and_the_error(per_pixel):
    size = (9, 420)  # 0.6 % of the longer side are three pixels
    depth_m = (1.5 * smooth(3, 1, 6, 210, seed=1)).exp()
    target = Matches(drawn(3, 1, *size, seed=2), drawn(3, 1, *size, seed=3), torch.ones(3))
    error = torch.tensor([0.02, 0.16, 0.3]).view(3, 1, 1, 1)
    if per_pixel:
        error = local_error(error, drawn(3, 1, 5, 140, seed=4) > 0.3)
    found = off_edges(target, depth_m, error)
    assert torch.equal(found.inverse_depth, target.inverse_depth)
    log_depth = F.interpolate(depth_m.log(), size, mode="bilinear")
    on_grid = F.interpolate(error, size, mode="nearest-exact") if per_pixel else error
    for b in range(3):
        one = array(log_depth, b)
        span = ndimage.maximum_filter(one, 7, mode="nearest") - ndimage.minimum_filter(one, 7, mode="nearest")
        width = 0.3 * np.maximum(array(on_grid, b) / 0.11, 1.0) ** 3
        expected = array(target.confidence, b) / (1 + (span / width) ** 2)
        np.testing.assert_allclose(found.confidence[b, 0], expected, rtol=1e-4)


def test_a_prior_has_the_largest_error_where_it_gives_no_depth():
    error = torch.tensor([0.03, 0.2]).view(2, 1, 1, 1)
    valid = drawn(2, 1, 4, 6, seed=1) > 0.4
    found = local_error(error, valid)
    np.testing.assert_array_equal(found.numpy(), np.where(valid, error.numpy(), np.float32(0.5)))
    assert local_error(error, None) is error and local_error(None, valid) is None
    per_pixel = drawn(2, 1, 8, 12, seed=2)
    found = local_error(per_pixel, valid)
    nearest = F.interpolate(per_pixel, (4, 6), mode="nearest-exact")
    np.testing.assert_array_equal(found.numpy(), np.where(valid, nearest, np.float32(0.5)))


def test_what_a_map_is_fitted_to():
    """Matches less reflections and less those next to edges; points, which stand for many pixels, win."""
    depth_m, matches, _ = scene()
    points = Matches(drawn(2, 1, *GRID, seed=1), (drawn(2, 1, *GRID, seed=2) > 0.9).float(), torch.ones(2))
    kept, error = drawn(2, 1, 12, 15, seed=3), torch.tensor([0.03, 0.2]).view(2, 1, 1, 1)
    on_grid = F.interpolate(kept, GRID, mode="bilinear")
    plain = fit_target(matches, None, kept, None, depth_m)
    torch.testing.assert_close(plain.confidence, on_grid * matches.confidence)
    torch.testing.assert_close(plain.inverse_depth, matches.inverse_depth)
    doubted = off_edges(replace(matches, confidence=on_grid * matches.confidence), depth_m, error)
    near_edges = fit_target(matches, None, kept, error, depth_m)
    torch.testing.assert_close(near_edges.confidence, doubted.confidence)
    both = fit_target(matches, points, kept, error, depth_m)
    known = points.confidence > 0
    stands_for = known[0].numel() / known.sum((1, 2, 3)).view(2, 1, 1, 1)
    torch.testing.assert_close(both.confidence, torch.where(known, stands_for, doubted.confidence))
    torch.testing.assert_close(
        both.inverse_depth, torch.where(known, points.inverse_depth, matches.inverse_depth)
    )
    # Without judged matches there are only points, or nothing.
    for given, judged in ((matches, None), (None, kept), (None, None)):
        alone = fit_target(given, points, judged, error, depth_m)
        torch.testing.assert_close(alone.confidence, torch.where(known, stands_for, 0.0))
        assert fit_target(given, None, judged, error, depth_m) is None


def test_neither_the_fit_nor_the_error_keeps_a_graph():
    depth_m, target, image = scene()
    depth_m.requires_grad_()
    error = prior_error(depth_m, target, image)
    assert not error.requires_grad
    assert not any(part.requires_grad for part in fit_depth(depth_m, target, image, error))
    assert not off_edges(target, depth_m, error).confidence.requires_grad
