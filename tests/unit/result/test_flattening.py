"""Flat walls against sparse direct solves of the same two problems, on three grids of different sizes."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from geodiff_plugin.matching import Matches, known_shape, rows
from geodiff_plugin.result import flattening
from geodiff_plugin.result.flattening import flatten

DEPTH, MATCHES, LEFT = (44, 56), (15, 22), (60, 90)
#: Few enough pixels for the grid of the votes to be 26 by 33.
MOST_PIXELS = 26 * 33


def resized(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A map sampled bilinearly where the pixels of another grid lie, its rim repeated."""
    at = [(np.arange(new) + 0.5) * old / new - 0.5 for new, old in zip(size, x.shape, strict=True)]
    return map_coordinates(x, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")


def differences(size: tuple[int, int]):
    """Two matrices ``(links, pixels)``: a map's change from each pixel to the one right of or below it."""
    index = np.arange(size[0] * size[1]).reshape(size)
    for axis in (1, 0):
        first, second = (np.delete(index, end, axis).ravel() for end in (-1, 0))
        link, one = np.arange(len(first)), np.ones(len(first))
        yield coo_matrix(
            (np.r_[-one, one], (np.r_[link, link], np.r_[first, second])), (len(first), index.size)
        ).tocsr()


def links_of(log_depth: np.ndarray, image: np.ndarray, edge: float) -> list[np.ndarray]:
    """How strongly neighbours are linked, across and down."""
    scale, found = max(log_depth.shape) / 512, []
    for axis in (1, 0):
        colour = np.abs(np.diff(image, axis=axis + 1)).mean(0) / 0.1
        jump = np.abs(np.diff(log_depth, axis=axis)) / edge
        found.append((scale**2 * np.maximum(np.exp(-scale * (colour + jump)), 1e-3)).ravel())
    return found


def smoothed_slopes(q: np.ndarray, known: np.ndarray, links: list[np.ndarray]) -> list[np.ndarray]:
    """The slopes of ``q`` along both axes, each at the first of its two pixels, smoothed along the links."""
    matrices = list(differences(q.shape))
    smoothness = 300.0 * sum(D.T @ diags(g) @ D for D, g in zip(matrices, links, strict=True))
    found = []
    for axis, g in zip((1, 0), links, strict=True):
        ends = [(0, 0), (0, 0)]
        ends[axis] = (0, 1)
        link = np.pad(g.reshape(np.diff(q, axis=axis).shape), ends)
        weight = (link * (known**2 + 0.01) + 1e-6).ravel()
        slope = np.pad(np.diff(q, axis=axis), ends).ravel()
        found.append(spsolve((diags(weight) + smoothness).tocsc(), weight * slope).reshape(q.shape))
    return found


def lowering(q: np.ndarray, slopes, links: list[np.ndarray], weight: np.ndarray) -> np.ndarray:
    """By how much log depth falls where values are drawn to the slopes, which the weight resists."""
    matrix, right = diags((weight / np.maximum(q, 1e-3) ** 2).ravel()), 0.0
    for D, g, slope, axis in zip(differences(q.shape), links, slopes, (1, 0), strict=True):
        target = np.delete(slope, -1, axis).ravel()
        matrix = matrix + 40.0 * D.T @ diags(g) @ D
        right = right + 40.0 * D.T @ (g * (target - D @ q.ravel()))
    change = spsolve(matrix.tocsc(), right).reshape(q.shape)
    return np.log(np.maximum(1 + change / q, 0.3))


def expected_depth(depth, matches: Matches, image, error: float, denoised) -> np.ndarray:
    log_depth = np.log(depth)
    unit, good = log_depth.mean(), max(0.1 / error, 1.0) ** 4
    on_matches = resized(log_depth, MATCHES)
    q = np.exp(unit - on_matches)
    inverse = torch.from_numpy(np.exp(-on_matches))[None, None].float()
    known = known_shape(matches, inverse)[0, 0].double().numpy()
    held = np.minimum(known**2 / np.maximum(1 - known, 1e-6), 1e3)
    guide = of_image(image, MATCHES)
    fitted = links_of(on_matches, guide, max(0.1 / math.sqrt(good), 0.03))
    before = links_of(resized(np.log(denoised), MATCHES), guide, 0.02)
    links = [np.minimum(*both) for both in zip(fitted, before, strict=True)]
    slopes = smoothed_slopes(q, known, links)
    first = resized(lowering(q, slopes, links, held + 0.015 * good), DEPTH)
    size = rows.grid_of_rows(DEPTH)
    on_votes = resized(log_depth - first, size)
    q = np.exp(unit - on_votes)
    # The same plane has smaller slopes on a finer grid.
    finer = [MATCHES[1] / size[1], MATCHES[0] / size[0]]
    slopes = [factor * resized(slope, size) for factor, slope in zip(finer, slopes, strict=True)]
    links = links_of(on_votes, of_image(image, size), 0.03)
    second = lowering(q, slopes, links, resized(held, size) + 0.5 * good)
    return depth * np.exp(-first - resized(second, DEPTH))


def of_image(image: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
    return F.interpolate(image, size, mode="bilinear", antialias=True)[0].double().numpy()


@pytest.mark.parametrize("most_pixels", [MOST_PIXELS, 10**6])
@pytest.mark.parametrize("error", [0.2, 0.07, 0.04])
def test_both_problems_are_solved_as_a_direct_solver_does(monkeypatch, error, most_pixels):
    """A rough wall of which matches know much on the left and nothing on the right or at the top."""
    monkeypatch.setattr(rows, "MOST_PIXELS", most_pixels)
    monkeypatch.setattr(flattening, "STEPS", 300)  # until nothing changes
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: DEPTH[0], : DEPTH[1]] / 40
    depth = (
        5.0
        / (1 + 0.3 * u + 0.2 * v)
        * np.exp(0.02 * np.sin(9 * u) * np.cos(7 * v) + 0.01 * rng.normal(size=DEPTH))
    )
    depth[:, 41:] *= 0.7
    depth[3:6, 20:24] *= 0.1  # a speck far before the wall
    denoised = depth.copy()
    denoised[30:] *= 1.08
    image = 0.4 + 0.3 * (np.mgrid[: LEFT[0], : LEFT[1]][1] > 65) + 0.05 * rng.random((3, *LEFT))
    image = torch.from_numpy(image)[None].float()
    deviation = np.exp(np.linspace(-0.5, 4, MATCHES[1])) * np.ones(MATCHES)
    deviation[:4] = 60.0
    confidence = rng.random(MATCHES) * (rng.random(MATCHES) > 0.2)
    whole = [torch.from_numpy(x)[None, None].float() for x in (np.full(MATCHES, 0.2), confidence, deviation)]
    matches = Matches(whole[0], whole[1], torch.tensor([0.004]), whole[2])
    depth_m, denoised_m = (torch.from_numpy(x)[None, None].float() for x in (depth, denoised))
    found = flatten(depth_m, matches, image, torch.full((1, 1, 1, 1), error), denoised_m)[0, 0].numpy()
    expected = expected_depth(depth, matches, image, error, denoised)
    changed = np.abs(np.log(expected / depth))
    assert changed.max() > 0.01
    np.testing.assert_allclose(np.log(found / depth), np.log(expected / depth), atol=0.01 * changed.max())


@pytest.mark.parametrize("size", [(44, 56), (9, 13), (12, 300)])
def test_a_slanted_plane_is_a_fixed_point_on_grids_of_any_two_sizes(size):
    """Finer, coarser and stretched against the matches, none of which know a thing."""
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    y, x = (v + 0.5) / size[0], (u + 0.5) / size[1]
    depth_m = torch.from_numpy(3.0 / (1 + 0.5 * x + 0.4 * y))[None, None].float()
    whole = torch.ones(1, 1, *MATCHES)
    matches = Matches(0.4 * whole, 0.9 * whole, torch.tensor([0.01]), 60.0 * whole)
    image = torch.full((1, 3, *LEFT), 0.5)
    flat = flatten(depth_m, matches, image, torch.full((1, 1, 1, 1), 0.3), torch.ones_like(depth_m))
    inner = (..., slice(size[0] // 6 + 1, -size[0] // 6), slice(size[1] // 6 + 1, -size[1] // 6))
    torch.testing.assert_close(flat[inner], depth_m[inner], rtol=4e-3, atol=0.0)


def test_the_unit_of_lengths_does_not_matter():
    rng = np.random.default_rng(1)
    depth_m = torch.from_numpy(2 + rng.random(DEPTH))[None, None].float()
    whole = torch.ones(1, 1, *MATCHES)
    deviation = torch.from_numpy(rng.uniform(1, 40, MATCHES))[None, None].float()
    image, error = (
        torch.rand(1, 3, *LEFT, generator=torch.Generator().manual_seed(0)),
        torch.full((1, 1, 1, 1), 0.15),
    )

    def in_unit(factor: float) -> torch.Tensor:
        matches = Matches(0.4 * whole / factor, 0.9 * whole, torch.tensor([0.01 / factor]), deviation)
        return flatten(factor * depth_m, matches, image, error, factor * depth_m) / factor

    assert not torch.allclose(in_unit(1.0), depth_m, rtol=1e-3)
    torch.testing.assert_close(in_unit(37.0), in_unit(1.0), rtol=1e-4, atol=0.0)


def test_a_map_of_64_bits_stays_one():
    depth_m = torch.full((1, 1, *DEPTH), 2.0, dtype=torch.float64)
    whole = torch.ones(1, 1, *MATCHES)
    matches = Matches(0.5 * whole, whole, torch.tensor([0.01]), 9.0 * whole)
    flat = flatten(depth_m, matches, torch.rand(1, 3, *LEFT), torch.full((1, 1, 1, 1), 0.2), depth_m)
    assert flat.dtype == torch.float64


def test_a_wall_whose_values_weigh_more_ends_at_smaller_steps_but_not_at_details():
    """A step of depth cuts links the more, the larger the weight, down to steps of ``DETAIL_EDGE``."""
    log_depth = torch.zeros(1, 1, 12, 64)
    log_depth[..., 32:] = 0.05
    left_01 = torch.full((1, 3, 12, 64), 0.5)
    denoised = torch.ones_like(log_depth)

    def link_at_step(good: float) -> float:
        across, _ = flattening._links_of_walls(log_depth, denoised, left_01, torch.full_like(log_depth, good))
        return float(across[0, 0, 5, 31] / across[0, 0, 5, 10])

    weak, plain, strong = link_at_step(0.25), link_at_step(1.0), link_at_step(4.0)
    assert weak > plain > strong
    assert link_at_step(1e6) == pytest.approx(link_at_step(1e8))
