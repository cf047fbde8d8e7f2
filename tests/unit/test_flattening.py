"""Walls whose matches know little: what they know, how far a fit is followed, and flat slopes."""

import math

import pytest
import torch

from geodiff_plugin.matching import Matches, known_shape, known_share, match_volume, sweep_planes, with_points
from geodiff_plugin.matching.consistency import DOUBT_OF_A_PLANE, ENOUGH_KNOWN, FAR_PLANES, LEAST_DEVIATION
from geodiff_plugin.result.confidence import DETERMINED_FROM, determined
from geodiff_plugin.result.flattening import flatten
from geodiff_plugin.types import CameraView, PosedViews

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
    """RMS of the inverse depth from its best plane, as a share of the mean; least squares in float64."""
    rows, columns = torch.meshgrid(*(torch.arange(side).double() for side in SIZE), indexing="ij")
    terms = torch.stack([torch.ones(SIZE).double(), rows, columns], -1).reshape(-1, 3)
    inverse = (1.0 / depth_m.double()).reshape(-1, 1)
    residual = inverse - terms @ torch.linalg.lstsq(terms, inverse).solution
    return float(residual.square().mean().sqrt() / inverse.mean())


@pytest.mark.parametrize("deviation", [0.5, 1.0, 2.0, 4.0])
def test_what_matches_know_is_their_mean_precision(deviation: float) -> None:
    expected = min(1.0, min(1.0, deviation**-2) / ENOUGH_KNOWN)
    torch.testing.assert_close(known_share(matches_of(deviation)), torch.full((1, 1, *SIZE), expected))


def test_a_pixel_without_a_match_knows_nothing_and_points_stand_for_their_surroundings() -> None:
    assert (known_share(matches_of(1.0, confidence=0.0)) == 0.0).all()
    assert (known_share(matches_of(None)) == 1.0).all()
    given = torch.zeros(1, 1, *SIZE)
    given[..., ::8, ::8] = 1.0
    points = Matches(0.5 * given, given, torch.tensor([0.01]))
    known = known_share(with_points(matches_of(30.0), points))
    assert (known[..., 16:-16, 16:-16] == 1.0).all()


def test_a_far_surface_asks_for_more_precise_matches_than_a_near_one() -> None:
    """At half of ``FAR_PLANES`` twice the precision is needed, and none counts beyond ``LEAST_DEVIATION``."""
    step = 0.01
    near, far = (torch.full((1, 1, *SIZE), planes * step) for planes in (2.0 * FAR_PLANES, 0.5 * FAR_PLANES))
    matches = matches_of(2.0)
    torch.testing.assert_close(known_shape(matches, near), torch.full_like(near, 0.25 / ENOUGH_KNOWN))
    torch.testing.assert_close(known_shape(matches, far), torch.full_like(far, 0.125 / ENOUGH_KNOWN))
    finest = torch.full_like(far, 0.1 * FAR_PLANES * step)
    expected = 0.1 * LEAST_DEVIATION**-2 / ENOUGH_KNOWN
    torch.testing.assert_close(
        known_shape(matches_of(0.01), finest), torch.full_like(far, min(1.0, expected))
    )


def test_matches_that_know_little_determine_little() -> None:
    size = (96, 128)
    assert (determined(known_share(matches_of(1.0)), size) == 1.0).all()
    wide = determined(
        known_share(matches_of(10.0)), size
    )  # a precision of .01, of the .3 and of a third of it
    torch.testing.assert_close(wide, torch.full((1, 1, *size), 0.01 / ENOUGH_KNOWN / DETERMINED_FROM))


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
    """Two walls beside each other at one depth, the right one of nearly even paint, with sensor noise."""
    generator = torch.Generator().manual_seed(0)
    height, width, shift = 96, 160, 8
    texture = torch.rand(1, height, width + shift, generator=generator)
    texture[..., width // 2 :] = 0.5 + 0.004 * (texture[..., width // 2 :] - 0.5)
    left, right = texture[..., :width], texture[..., shift:]
    left, right = (x + 0.004 * torch.randn(x.shape, generator=generator) for x in (left, right))
    K = torch.tensor([[100.0, 0, 80], [0, 100.0, 48], [0, 0, 1]])
    T = torch.eye(4)
    T[0, 3] = -0.1
    planes = torch.linspace(0.0, 2.0, 32)  # inverse depths: the wall's is .8
    matches = match_volume(sweep_planes(PosedViews(left, (CameraView(right, K, T),), K), planes))
    assert matches.deviation is not None
    narrow, wide = matches.deviation[0, 20:-20, 30:60], matches.deviation[0, 20:-20, 100:140]
    assert narrow.median() < 2.0 < wide.median() / 2.0
    sure = ((1.0 - matches.confidence[0, 20:-20, 30:60]) / DOUBT_OF_A_PLANE).sqrt()
    assert (narrow >= sure - 1e-5).all()
