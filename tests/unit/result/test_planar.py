"""Flat walls against sparse direct solves of the same two problems, on three grids of different sizes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from geodiff_plugin.matching import (
    Matches,
    known_fraction,
    known_shape,
    match_volume,
    rows,
    sweep_planes,
    with_points,
)
from geodiff_plugin.matching.consistency import DOUBT_OF_A_PLANE, ENOUGH_KNOWN, FAR_PLANES, MIN_DEVIATION
from geodiff_plugin.result import planar
from geodiff_plugin.result.confidence import MIN_DATA_FRACTION, data_support
from geodiff_plugin.result.planar import flatten
from tests.views import posed_of

DEPTH, MATCHES, LEFT = (44, 56), (15, 22), (60, 90)
#: Few enough pixels for the grid of the votes to be 26 by 33.
MAX_PIXELS = 26 * 33


def resized(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A map sampled bilinearly where the pixels of another grid lie, its rim repeated."""
    at = [(np.arange(new) + 0.5) * old / new - 0.5 for new, old in zip(size, x.shape, strict=True)]
    return map_coordinates(x, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")


def differences(size: tuple[int, int]):
    """Two matrices ``(affinities, pixels)``: a map's change from each pixel to those right and below."""
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


def smoothed_slopes(q: np.ndarray, known: np.ndarray, affinities: list[np.ndarray]) -> list[np.ndarray]:
    """The slopes of ``q`` along both axes, each at the first of its two pixels, smoothed along the links."""
    matrices = list(differences(q.shape))
    smoothness = 300.0 * sum(D.T @ diags(g) @ D for D, g in zip(matrices, affinities, strict=True))
    found = []
    for axis, g in zip((1, 0), affinities, strict=True):
        ends = [(0, 0), (0, 0)]
        ends[axis] = (0, 1)
        link = np.pad(g.reshape(np.diff(q, axis=axis).shape), ends)
        weight = (link * (known**2 + 0.01) + 1e-6).ravel()
        slope = np.pad(np.diff(q, axis=axis), ends).ravel()
        found.append(spsolve((diags(weight) + smoothness).tocsc(), weight * slope).reshape(q.shape))
    return found


def lowering(q: np.ndarray, slopes, affinities: list[np.ndarray], weight: np.ndarray) -> np.ndarray:
    """By how much log depth falls where values are drawn to the slopes, which the weight resists."""
    matrix, right = diags((weight / np.maximum(q, 1e-3) ** 2).ravel()), 0.0
    for D, g, slope, axis in zip(differences(q.shape), affinities, slopes, (1, 0), strict=True):
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
    affinities = [np.minimum(*both) for both in zip(fitted, before, strict=True)]
    slopes = smoothed_slopes(q, known, affinities)
    first = resized(lowering(q, slopes, affinities, held + 0.015 * good), DEPTH)
    size = rows.grid_of_rows(DEPTH)
    on_votes = resized(log_depth - first, size)
    q = np.exp(unit - on_votes)
    # The same plane has smaller slopes on a finer grid.
    finer = [MATCHES[1] / size[1], MATCHES[0] / size[0]]
    slopes = [factor * resized(slope, size) for factor, slope in zip(finer, slopes, strict=True)]
    affinities = links_of(on_votes, of_image(image, size), 0.03)
    second = lowering(q, slopes, affinities, resized(held, size) + 0.5 * good)
    return depth * np.exp(-first - resized(second, DEPTH))


def of_image(image: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
    return F.interpolate(image, size, mode="bilinear", antialias=True)[0].double().numpy()


@pytest.mark.parametrize("most_pixels", [MAX_PIXELS, 10**6])
@pytest.mark.parametrize("error", [0.2, 0.07, 0.04])
def test_both_problems_are_solved_as_a_direct_solver_does(monkeypatch, error, most_pixels):
    """A rough wall of which matches know much on the left and nothing on the right or at the top."""
    monkeypatch.setattr(rows, "MAX_PIXELS", most_pixels)
    monkeypatch.setattr(planar, "STEPS", 300)  # until nothing changes
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
    """Finer, coarser and stretched relative to the matches, none of which are known."""
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
        across, _ = planar._affinities_of_walls(
            log_depth, denoised, left_01, torch.full_like(log_depth, good)
        )
        return float(across[0, 0, 5, 31] / across[0, 0, 5, 10])

    weak, plain, strong = link_at_step(0.25), link_at_step(1.0), link_at_step(4.0)
    assert weak > plain > strong
    assert link_at_step(1e6) == pytest.approx(link_at_step(1e8))


def test_what_is_known_of_matches_without_deviations_is_left_to_the_reference(asked_kernels):
    one = torch.ones(1, 1, 6, 8)
    matches = Matches(0.5 * one, 0.7 * one, torch.tensor([0.01]), one)
    unit, good = torch.tensor(0.0), torch.tensor(1.0)
    assert planar._known_maps(matches, one, unit, good) == "result.kernels.planar.known_maps"
    bare = replace(matches, deviation=None)
    assert len(planar._known_maps(bare, one, unit, good)) == 4 and len(asked_kernels) == 1


SIZE = (48, 64)
WEAK = torch.full((1, 1, 1, 1), 0.2)
EVEN = torch.ones(1, 1, *SIZE)  # a denoised map without an edge


def matches_of(deviation: float | None, confidence: float = 0.9) -> Matches:
    whole = torch.ones(1, 1, *SIZE)
    spread = None if deviation is None else deviation * whole
    return Matches(0.5 * whole, confidence * whole, torch.tensor([0.01]), spread)


def slanted(blotches: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A plane's inverse depth, and its depth with blotches of this relative size."""
    rows, columns = torch.meshgrid(*(torch.arange(side).float() for side in SIZE), indexing="ij")
    plane = 0.3 + 0.002 * columns + 0.001 * rows
    waves = torch.sin(columns / 3.0) * torch.cos(rows / 2.5)
    return plane[None, None], (1.0 / (plane * (1.0 + blotches * waves)))[None, None]


def off_plane(depth_m: torch.Tensor) -> float:
    """RMS of the inverse depth from its best plane, as a fraction of the mean; least squares in float64."""
    rows, columns = torch.meshgrid(*(torch.arange(side).double() for side in SIZE), indexing="ij")
    terms = torch.stack([torch.ones(SIZE).double(), rows, columns], -1).reshape(-1, 3)
    inverse = (1.0 / depth_m.double()).reshape(-1, 1)
    residual = inverse - terms @ torch.linalg.lstsq(terms, inverse).solution
    return float(residual.square().mean().sqrt() / inverse.mean())


@pytest.mark.parametrize("deviation", [0.5, 1.0, 2.0, 4.0])
def test_what_matches_know_is_their_mean_precision(deviation: float) -> None:
    expected = min(1.0, min(1.0, deviation**-2) / ENOUGH_KNOWN)
    torch.testing.assert_close(known_fraction(matches_of(deviation)), torch.full((1, 1, *SIZE), expected))


def test_a_pixel_without_a_match_knows_nothing_and_points_stand_for_their_surroundings() -> None:
    assert (known_fraction(matches_of(1.0, confidence=0.0)) == 0.0).all()
    assert (known_fraction(matches_of(None)) == 1.0).all()
    given = torch.zeros(1, 1, *SIZE)
    given[..., ::8, ::8] = 1.0
    points = Matches(0.5 * given, given, torch.tensor([0.01]))
    known = known_fraction(with_points(matches_of(30.0), points))
    assert (known[..., 16:-16, 16:-16] == 1.0).all()


def test_a_far_surface_asks_for_more_precise_matches_than_a_near_one() -> None:
    """At half of ``FAR_PLANES`` twice the precision is needed, and none counts beyond ``MIN_DEVIATION``."""
    step = 0.01
    near, far = (torch.full((1, 1, *SIZE), planes * step) for planes in (2.0 * FAR_PLANES, 0.5 * FAR_PLANES))
    matches = matches_of(2.0)
    torch.testing.assert_close(known_shape(matches, near), torch.full_like(near, 0.25 / ENOUGH_KNOWN))
    torch.testing.assert_close(known_shape(matches, far), torch.full_like(far, 0.125 / ENOUGH_KNOWN))
    finest = torch.full_like(far, 0.1 * FAR_PLANES * step)
    expected = 0.1 * MIN_DEVIATION**-2 / ENOUGH_KNOWN
    torch.testing.assert_close(
        known_shape(matches_of(0.01), finest), torch.full_like(far, min(1.0, expected))
    )


def test_matches_that_know_little_determine_little() -> None:
    size = (96, 128)
    assert (data_support(known_fraction(matches_of(1.0)), size) == 1.0).all()
    wide = data_support(
        known_fraction(matches_of(10.0)), size
    )  # a precision of .01, of the .3 and of a third of it
    torch.testing.assert_close(wide, torch.full((1, 1, *size), 0.01 / ENOUGH_KNOWN / MIN_DATA_FRACTION))


def test_blotches_of_a_slanted_wall_go_where_nothing_is_known_and_stay_where_all_is() -> None:
    _, depth_m = slanted(0.04)
    grey = torch.full((1, 3, *SIZE), 0.5)
    flat = flatten(depth_m, matches_of(50.0), grey, WEAK, EVEN)
    assert off_plane(flat) < 0.3 * off_plane(depth_m)
    kept = flatten(depth_m, matches_of(1.0), grey, WEAK, EVEN)
    torch.testing.assert_close(kept, depth_m, rtol=2e-3, atol=0.0)


@pytest.mark.parametrize(("deviation", "least", "most"), [(50.0, 0.0, 0.15), (1.0, 0.9, 1.0)])
def test_specks_finer_than_the_grid_of_the_matches_go_where_nothing_is_known(
    deviation: float, least: float, most: float
) -> None:
    """A plane on twice the grid of the matches, on which every 37th pixel is 2 % nearer."""
    height, width = size = 2 * SIZE[0], 2 * SIZE[1]
    rows, columns = torch.meshgrid(*(torch.arange(side).float() for side in size), indexing="ij")
    plane = 0.3 + 0.001 * columns + 0.0005 * rows
    speck = (torch.arange(height * width) % 37 == 0).view(size)
    depth_m = (1.0 / (plane * (1.0 + 0.02 * speck)))[None, None]
    flat_m = flatten(depth_m, matches_of(deviation), torch.full((1, 3, *size), 0.5), WEAK, EVEN)
    inverse = 1.0 / flat_m
    around = torch.nn.functional.avg_pool2d(inverse, 5, 1, 2)[0, 0]  # 24 of 25 are no speck
    inside = (slice(8, -8),) * 2
    risen = (inverse[0, 0] / around - 1.0)[inside][speck[inside]].mean()
    assert least <= risen / 0.02 <= most


def test_a_plane_stays_a_plane_and_a_good_prior_keeps_its_relief() -> None:
    grey = torch.full((1, 3, *SIZE), 0.5)
    _, plane_m = slanted(0.0)
    torch.testing.assert_close(
        flatten(plane_m, matches_of(50.0), grey, WEAK, plane_m), plane_m, rtol=5e-3, atol=0.0
    )
    _, relief_m = slanted(0.01)
    good = torch.full((1, 1, 1, 1), 0.02)
    kept = flatten(relief_m, matches_of(50.0), grey, good, relief_m)
    torch.testing.assert_close(kept, relief_m, rtol=3e-3, atol=0.0)


def test_a_step_at_an_edge_of_the_image_stays() -> None:
    size = 64, 512  # the width for which the strengths of edges hold
    depth_m, image, whole = (
        torch.full((1, 1, *size), 4.0),
        torch.full((1, 3, *size), 0.2),
        torch.ones(1, 1, *size),
    )
    depth_m[..., 256:], image[..., 256:] = 2.0, 0.9
    matches = Matches(0.5 * whole, whole, torch.tensor([0.01]), 50.0 * whole)
    torch.testing.assert_close(flatten(depth_m, matches, image, WEAK, depth_m), depth_m, rtol=0.05, atol=0.0)


def test_a_step_that_the_image_does_not_show_stays_where_the_denoised_map_has_it_and_goes_elsewhere() -> None:
    """A step of a fifth between two fronts of one colour, on which nothing is known."""
    size = 64, 512  # the width for which the strengths of edges hold
    depth_m, whole = torch.full((1, 1, *size), 4.0), torch.ones(1, 1, *size)
    depth_m[..., 256:] *= 0.8
    matches = Matches(0.25 * whole, whole, torch.tensor([0.002]), 50.0 * whole)

    def left_of_it(denoised_m: torch.Tensor) -> float:
        flat_m = flatten(depth_m, matches, torch.full((1, 3, *size), 0.5), WEAK, denoised_m)
        return float((flat_m[..., 246] / flat_m[..., 266]).log().mean()) / math.log(1.0 / 0.8)

    assert 0.9 <= left_of_it(depth_m) <= 1.0
    assert left_of_it(whole) <= 0.5


def test_what_is_far_is_not_drawn_to_what_is_near_across_an_edge() -> None:
    """A front before a plane ten times as far; the coarser the grid, the less links fall at edges."""
    size = 192, 256
    depth_m, image = torch.full((1, 1, *size), 2.0), torch.full((1, 3, *size), 0.4)
    depth_m[..., 128:], image[..., 128:] = 20.0, 0.8
    whole = torch.ones_like(depth_m)
    flat_m = flatten(
        depth_m, Matches(0.25 * whole, whole, torch.tensor([0.01]), 50.0 * whole), image, WEAK, whole
    )
    torch.testing.assert_close(flat_m[..., 128:], depth_m[..., 128:], rtol=0.05, atol=0.0)


def test_a_blank_wall_has_wide_matches_and_a_textured_one_narrow_ones() -> None:
    """Two walls next to each other at one depth, the right one of nearly even paint, with sensor noise."""
    generator = torch.Generator().manual_seed(0)
    height, width, shift = 96, 160, 8
    texture = torch.rand(1, height, width + shift, generator=generator)
    texture[..., width // 2 :] = 0.5 + 0.004 * (texture[..., width // 2 :] - 0.5)
    left, right = texture[..., :width], texture[..., shift:]
    left, right = (x + 0.004 * torch.randn(x.shape, generator=generator) for x in (left, right))
    K = torch.tensor([[100.0, 0, 80], [0, 100.0, 48], [0, 0, 1]])
    T = np.eye(4)
    T[0, 3] = -0.1
    planes = torch.linspace(0.0, 2.0, 32)  # inverse depths: the wall's is .8
    matches = match_volume(sweep_planes(posed_of(left, K, (right, K, T)), planes))
    assert matches.deviation is not None
    narrow, wide = matches.deviation[0, 20:-20, 30:60], matches.deviation[0, 20:-20, 100:140]
    assert narrow.median() < 2.0 < wide.median() / 2.0
    sure = ((1.0 - matches.confidence[0, 20:-20, 30:60]) / DOUBT_OF_A_PLANE).sqrt()
    assert (narrow >= sure - 1e-5).all()
