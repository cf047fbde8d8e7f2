"""Confidence, its features and the photometric error against NumPy, with constants written again."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import generic_filter, map_coordinates, maximum_filter, minimum_filter

from geodiff_plugin._internal import strips
from geodiff_plugin.algorithm.terms import match_exposure
from geodiff_plugin.matching import Matches
from geodiff_plugin.result.confidence import data_support, depth_confidence, features_of, reprojection
from geodiff_plugin.result.records import ConfidenceFeatures
from tests.views import view_of


def resized(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A map sampled bilinearly where the pixels of another grid lie, its rim repeated."""
    at = [(np.arange(new) + 0.5) * old / new - 0.5 for new, old in zip(size, x.shape, strict=True)]
    return map_coordinates(x, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")


def as_map(x: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(x))[None, None].float()


def mean_around(x: np.ndarray, radius: int) -> np.ndarray:
    """The mean over the part of a square window that lies in the map."""
    return generic_filter(x, np.nanmean, 2 * radius + 1, mode="constant", cval=np.nan)


@pytest.mark.parametrize("matched", [0.6, 0.0])
def test_features_are_window_means_on_the_grid_of_the_matches(matched):
    """Map, matches and support have three sizes; a fit lowered some depths and raised others."""
    rng = np.random.default_rng(0)
    full, grid = (35, 70), (34, 45)
    v, u = np.mgrid[: full[0], : full[1]] / 20
    depth = 2 + 0.2 * u + 0.1 * v + 0.8 * (u > 2.1)
    denoised = depth * np.exp(0.3 * (rng.random(full) - 0.5) + 0.1 * v)
    on_grid, before = (resized(np.log(x), grid) for x in (depth, denoised))
    inverse = np.exp(-on_grid + 0.02 * rng.normal(size=grid))
    confidence = rng.random(grid) * (rng.random(grid) < matched)
    confidence[rng.random(grid) < 0.05 * matched] = 9.0  # known points
    support = as_map(rng.random((48, 66)))
    target = Matches(as_map(inverse), as_map(confidence), torch.tensor([0.004]))
    found = features_of(as_map(denoised), as_map(depth), target, support)
    planes = np.minimum(np.abs(inverse - np.exp(-on_grid)) / 0.004, 10.0)
    weight, distance, change = (
        mean_around(x, 15) for x in (confidence, confidence * planes, np.abs(on_grid - before))
    )
    known = np.minimum(confidence, 1.0).mean()
    fraction = known / (known + 0.02)
    expected = {
        "residual": (distance + 0.02 * 10.0) / (weight + 0.02),
        "change": np.clip(change, 0.005, 0.2) ** fraction * 0.2 ** (1 - fraction),
        "discontinuity": maximum_filter(on_grid, 9) - minimum_filter(on_grid, 9),
    }
    assert found.support is support
    for name, values in expected.items():
        found_here = getattr(found, name)[0, 0].numpy()
        np.testing.assert_allclose(found_here, resized(values, (48, 66)), rtol=1e-4, err_msg=name)


def test_matches_determine_a_depth_from_a_third_of_what_they_could_know():
    known = np.random.default_rng(1).uniform(0, 0.7, (9, 14))
    found = data_support(as_map(known), (21, 25))[0, 0].numpy()
    np.testing.assert_allclose(found, resized(np.minimum(known / 0.33, 1.0), (21, 25)), rtol=1e-5)


def probability(support, residual, change, discontinuity, spread, error) -> np.ndarray:
    """The logistic model of five features; 0.5 is the error of a useless prior."""
    fraction = support / (support + 0.1)
    left = (1 - support) * np.clip(error, 0.01, 0.5) ** fraction * 0.5 ** (1 - fraction)
    odds = (
        -2.95
        + 0.36 * np.log(0.05 / np.clip(left, 0.0005, 0.05))
        + 1.04 * np.log(10 / np.clip(residual, 0.5, 10))
    )
    odds += 0.94 * np.log(0.2 / np.clip(change, 0.005, 0.2)) + 0.36 * np.log(
        0.5 / np.clip(discontinuity, 0.01, 0.5)
    )
    return 1 / (1 + np.exp(15.0 * spread - odds))


@pytest.mark.parametrize("has_spread", [True, False])
@pytest.mark.parametrize("of_prior", [None, (1, 1), (8, 9)])
def test_confidence_is_a_logistic_model_of_five_features(monkeypatch, has_spread, of_prior):
    """Features reach beyond both of their bounds; the prior's error is unknown, one number or a map."""
    rng, size = np.random.default_rng(2), (25, 31)
    support = rng.random(size) ** 0.2
    support[:5] **= 20
    features = [
        support,
        *(np.exp(rng.uniform(*np.log(ends), size)) for ends in ((0.2, 20), (2e-3, 0.5), (4e-3, 1.2))),
    ]
    spread = 0.2 * rng.random(size) if has_spread else None
    error = None if of_prior is None else np.exp(rng.uniform(np.log(0.005), np.log(0.8), of_prior))
    expected_error = 0.5
    if error is not None:
        at = [((np.arange(n) + 0.5) * old / n).astype(int) for n, old in zip(size, of_prior, strict=True)]
        expected_error = error[np.ix_(*at)]
    expected = probability(*features, 0.0 if spread is None else spread, expected_error)
    given = (
        ConfidenceFeatures(*map(as_map, features)),
        *(None if x is None else as_map(x) for x in (spread, error)),
    )
    np.testing.assert_allclose(depth_confidence(*given)[0, 0], expected, rtol=1e-4)
    monkeypatch.setattr(strips, "STRIP_PIXELS", 4 * size[1])  # strips of 4 of 25 rows
    np.testing.assert_allclose(depth_confidence(*given)[0, 0], expected, rtol=1e-4)


def rotation(x: float, y: float, z: float) -> np.ndarray:
    (a, b, c), (s, t, w) = np.cos([x, y, z]), np.sin([x, y, z])
    return (
        np.array([[c, -w, 0], [w, c, 0], [0, 0, 1]])
        @ np.array([[b, 0, t], [0, 1, 0], [-t, 0, b]])
        @ np.array([[1, 0, 0], [0, a, -s], [0, s, a]])
    )


def right_view(seed: int, size, focal, turn, centre):
    """An image with its camera, whose axes have focal lengths of their own."""
    image = np.random.default_rng(seed).random((3, *size)).astype(np.float32)
    K = np.array([[focal, 0.4, 0.46 * size[1]], [0, 0.8 * focal, 0.55 * size[0]], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = rotation(*turn).T
    T[:3, 3] = -T[:3, :3] @ centre
    return image, K, T


@pytest.mark.parametrize("strip", [None, 7])
def test_the_least_photometric_error_of_the_views_that_see_a_pixel(monkeypatch, strip):
    """Three views of other sizes, cameras and poses, one of them finer than the left image."""
    if strip is not None:
        monkeypatch.setattr(strips, "STRIP_PIXELS", strip * 44)
    rng, size = np.random.default_rng(3), (31, 44)
    K_left = np.array([[40.0, 0.3, 20.0], [0, 33.0, 17.0], [0, 0, 1]])
    left, depth = rng.random((3, *size)).astype(np.float32), rng.uniform(1.5, 3.0, size).astype(np.float32)
    views = [
        right_view(4, (36, 40), 35.0, (0.15, -0.1, 0.2), (0.9, 0.5, -0.1)),
        right_view(5, (28, 50), 30.0, (-0.1, 0.3, -0.05), (0.2, 0.7, 0.1)),
        right_view(6, (80, 90), 90.0, (0.02, 0.05, 0.1), (1.0, 0.4, 0.1)),
    ]
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    points = np.linalg.inv(K_left) @ np.stack([u, v, np.ones(size)]).reshape(3, -1) * depth.ravel()
    errors, seen = [], []
    for image, K, T in views:
        # No more pixels per radian than the left image, each axis by itself.
        new = [
            max(1, round(n * min(1.0, f)))
            for n, f in zip(image.shape[1:], (33.0 / K[1, 1], 40.0 / K[0, 0]), strict=True)
        ]
        if tuple(new) != image.shape[1:]:
            ratio = np.array([new[1] / image.shape[2], new[0] / image.shape[1]])
            K = K * np.array([*ratio, 1.0])[:, None]
            K[:2, 2] += 0.5 * ratio - 0.5
            fine = torch.from_numpy(image)[None]
            image = F.interpolate(fine, new, mode="bilinear", antialias=True)[0].numpy()
        x, y, z = K @ (T[:3, :3] @ points + T[:3, 3:])
        at = np.stack([y / z, x / z])
        inside = (at >= -0.01) & (at <= np.array(image.shape[1:])[:, None] - 0.99)  # rounding is allowed for
        visible = (inside.all(0) & (z > 0)).reshape(size)
        warped = [map_coordinates(channel, at, order=1, mode="nearest").reshape(size) for channel in image]
        tensors = torch.from_numpy(np.stack(warped))[None].float(), torch.from_numpy(left)[None]
        matched = match_exposure(*tensors, torch.from_numpy(visible)[None, None])
        errors.append(np.where(visible, np.abs(matched[0].numpy() - left).mean(0), np.inf))
        seen.append(visible)
    given = [view_of(torch.from_numpy(image), K, T) for image, K, T in views]
    visible, error = reprojection(given, as_map(depth), view_of(torch.from_numpy(left), K_left))
    any_sees, least = np.any(seen, 0), np.min(errors, 0)
    assert 0.3 < any_sees.mean() < 0.99 and all(0.1 < each.mean() < 0.9 for each in seen)
    assert visible.dtype == torch.bool and (visible[0, 0].numpy() == any_sees).mean() > 0.995
    same = visible[0, 0].numpy() == any_sees
    np.testing.assert_allclose(error[0, 0].numpy()[same], np.where(any_sees, least, 0.0)[same], atol=2e-3)
