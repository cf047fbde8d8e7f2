"""The last stage: blurred edges become steep, and matches, colours and a good map decide where they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from geodiff_plugin.algorithm import finish
from geodiff_plugin.algorithm.finish import sharpen_edges, vote_depth, weighted_median
from geodiff_plugin.matching import Matches
from geodiff_plugin.types import CameraView

NEAR, FAR = 2.0, 6.0


def box(height: int = 48, width: int = 64) -> Tensor:
    """A box at 2 m before a wall at 6 m."""
    depth = torch.full((1, 1, height, width), FAR)
    depth[..., height // 4 : 3 * height // 4, width // 4 : 3 * width // 4] = NEAR
    return depth


def blurred(depth_m: Tensor, rounds: int = 1) -> Tensor:
    """Inverse depth under a 3 by 3 box filter, as autoencoders blur what they store."""
    inverse = 1.0 / depth_m
    for _ in range(rounds):
        inverse = F.avg_pool2d(F.pad(inverse, (1,) * 4, mode="replicate"), 3, 1)
    return 1.0 / inverse


def picture(depth_m: Tensor, contrast: float = 0.5) -> Tensor:
    """A left image that shows the box, ``(1, 3, H, W)``."""
    return (0.2 + contrast * (depth_m < 4.0)).float().expand(-1, 3, -1, -1)


def between(depth_m: Tensor) -> float:
    """Share of the pixels that are on neither surface."""
    return float(
        ((depth_m / NEAR - 1.0).abs() > 0.03).logical_and((depth_m / FAR - 1).abs() > 0.03).float().mean()
    )


def matches(depth_m: Tensor, confidence: Tensor | float = 0.95) -> Matches:
    return Matches(1.0 / depth_m, torch.ones_like(depth_m) * confidence, torch.full((1,), 2e-3))


def error_of(value: float) -> Tensor:
    return torch.full((1, 1, 1, 1), value)


@pytest.mark.parametrize("contrast", [0.0, 0.5])
@pytest.mark.parametrize("spacing", [1, 3])
def test_blurred_edges_become_steep(contrast, spacing):
    truth = F.interpolate(box(), scale_factor=spacing, mode="nearest")
    soft = 1.0 / F.interpolate(1.0 / blurred(box()), scale_factor=spacing, mode="bilinear")
    sharp = sharpen_edges(soft, picture(truth, contrast), spacing)
    assert between(soft) > 0.05
    assert between(sharp) < 0.25 * between(soft)
    error, before = ((each / truth - 1.0).abs().mean() for each in (sharp, soft))
    assert error < 0.4 * before


@pytest.mark.parametrize("spacing", [1, 4])
def test_planes_thin_posts_and_steep_edges_stay_bit_for_bit(spacing):
    v = torch.arange(96.0).view(1, 1, -1, 1).expand(-1, -1, -1, 80)
    ground = 1.6 * 100.0 / (v + 4.0)  # a camera 1.6 m above it; it changes by a fifth a row at the horizon
    post = torch.full((1, 1, 40, 60), FAR)
    post[..., 28 : 28 + spacing] = NEAR
    for depth_m in (ground, post, F.interpolate(box(), scale_factor=2, mode="nearest")):
        assert torch.equal(sharpen_edges(depth_m, torch.rand(1, 3, *depth_m.shape[-2:]), spacing), depth_m)


def test_sharpening_gives_depths_that_are_there_whatever_the_strips(monkeypatch):
    generator = torch.Generator().manual_seed(1)
    soft = torch.cat([blurred(box(), rounds) for rounds in (1, 2)])
    soft = soft * (1.0 + 0.01 * torch.rand(soft.shape, generator=generator))
    left = torch.rand(2, 3, 48, 64, generator=generator)
    whole = sharpen_edges(soft, left, 2)
    assert not torch.equal(whole, soft) and torch.isin(whole, soft).all()
    alone = [sharpen_edges(*each, 2) for each in zip(soft.split(1), left.split(1), strict=True)]
    assert torch.equal(whole, torch.cat(alone))
    monkeypatch.setattr("geodiff_plugin.formats.depth.STRIP_PIXELS", 5 * 64)
    monkeypatch.setattr(finish, "CHUNK", 7)
    assert torch.equal(sharpen_edges(soft, left, 2), whole)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 30), st.integers(0, 1000))
def test_the_median_is_numpys(count, seed):
    rng = np.random.default_rng(seed)
    values, weight = rng.normal(size=(count, 6)), rng.uniform(0.01, 1.0, (count, 6))
    found = weighted_median(torch.from_numpy(values), torch.from_numpy(weight), 30)
    for i in range(6):
        order = np.argsort(values[:, i])
        reached = np.cumsum(weight[order, i]) >= weight[:, i].sum() / 2
        assert float(found[i]) == pytest.approx(values[order, i][reached][0], abs=1e-6)


def test_a_weak_map_takes_its_edges_from_matches_and_colours():
    truth = box()
    moved = torch.roll(truth, (3, -4), (2, 3))
    voted = vote_depth(moved, picture(truth), matches(truth), error_of(0.4))
    wrong = [((each / truth - 1.0).abs() > 0.1).float().mean() for each in (voted, moved)]
    assert wrong[1] > 0.05 and wrong[0] < 0.1 * wrong[1]


def test_a_good_map_keeps_its_edges_where_matches_are_fattened():
    truth = box()
    fattened = -F.max_pool2d(-truth, 7, 1, 3)
    voted = vote_depth(truth, picture(truth, 0.0), matches(fattened), error_of(0.01))
    assert (voted / truth - 1.0).abs().max() < 0.01


def test_speckles_holes_and_far_outliers_have_no_vote():
    truth, generator = box(), torch.Generator().manual_seed(2)
    bad = torch.rand(truth.shape, generator=generator) < 0.04
    speckled = torch.where(
        bad, torch.where(torch.rand(truth.shape, generator=generator) < 0.5, 0.3, 1e6), truth
    )
    confidence = torch.where(bad, 0.9, 0.95)
    confidence[..., 20:24, 30:34] = 0.0
    voted = vote_depth(truth * 1.005, picture(truth), matches(speckled, confidence), error_of(0.3))
    assert (voted / truth - 1.0).abs().max() < 0.02


def test_nothing_moves_without_matches_and_nothing_leaves_the_maps_range():
    generator = torch.Generator().manual_seed(3)
    depth_m = 1.0 + torch.rand(1, 1, 30, 41, generator=generator)
    left = torch.rand(1, 3, 30, 41, generator=generator)
    nowhere = vote_depth(depth_m, left, matches(depth_m, 0.0), error_of(0.3))
    assert (nowhere / depth_m - 1.0).abs().max() < 5e-3
    elsewhere = vote_depth(depth_m, left, matches(20.0 * depth_m), error_of(0.5))
    assert elsewhere.amin() >= depth_m.amin() and elsewhere.amax() <= depth_m.amax()


def test_a_plane_stays_one_and_scale_does_not_matter():
    u = torch.arange(80.0).expand(1, 1, 50, -1)
    plane = 400.0 / (40.0 + u)
    left = torch.full((1, 3, 50, 80), 0.5)
    voted = vote_depth(plane, left, matches(plane), error_of(0.3))
    assert (voted / plane - 1.0)[..., 8:-8].abs().max() < 2e-3
    far = Matches(1e-2 / plane, torch.full_like(plane, 0.95), torch.full((1,), 2e-5))
    assert torch.allclose(vote_depth(100.0 * plane, left, far, error_of(0.3)), 100.0 * voted, rtol=1e-4)


def test_strips_change_nothing_and_a_large_picture_takes_its_edges_from_its_colours(monkeypatch):
    truth = F.interpolate(box(), scale_factor=3, mode="nearest")
    left, coarse = picture(truth), matches(box())
    usual = vote_depth(truth, left, coarse, error_of(0.3))
    monkeypatch.setattr(finish, "STRIP", 700)
    assert torch.allclose(vote_depth(truth, left, coarse, error_of(0.3)), usual, rtol=1e-5)
    monkeypatch.setattr(finish, "MOST_PIXELS", 48 * 64)
    large = vote_depth(truth, left, coarse, error_of(0.3))
    assert large.shape == truth.shape
    assert ((large / truth - 1.0).abs() > 0.05).float().mean() < 2e-3


@pytest.mark.parametrize("posed", [False, True])
def test_matches_that_are_off_by_half_a_pixel_are_placed(posed):
    height, width, focal = 60, 90, 80.0
    v, u = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")

    def texture(x: Tensor, y: Tensor) -> Tensor:
        return 0.5 + 0.2 * torch.sin(0.9 * x + 0.3 * y) + 0.2 * torch.sin(0.37 * x - 0.8 * y)

    shift = torch.tensor([4.0, -3.0 if posed else 0.0])  # pixels, of a wall at 2 m
    K = torch.tensor([[focal, 0.0, 44.5], [0.0, focal, 29.5], [0.0, 0.0, 1.0]])
    T = torch.eye(4)
    T[:2, 3] = -shift * 2.0 / focal
    left = texture(u, v).expand(1, 3, -1, -1)
    right = texture(u + shift[0], v + shift[1]).expand(3, -1, -1)
    truth = torch.full((1, 1, height, width), 2.0)
    step = 1.0 / (focal * float(T[:3, 3].norm()))  # 1/m for a pixel
    off = Matches(1.0 / truth + 0.5 * step, torch.full_like(truth, 0.95), torch.full((1,), step))
    views = [CameraView(right, K, T)]
    map_m = 1.02 * truth
    map_m[..., 0], map_m[..., -1] = 1.0, 4.0  # matches outside of the map's range are cut to it
    errors = [
        (vote_depth(map_m, left, off, error_of(0.4), each, K) / truth - 1.0)[..., 8:-8, 8:-8]
        for each in ([], views)
    ]
    assert errors[1].abs().mean() < 0.6 * errors[0].abs().mean()
