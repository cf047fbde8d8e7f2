"""Edges of depth maps: blurred ones become steep, and everything else stays as it is."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm import sharpening
from geodiff_plugin.algorithm.sharpening import sharpen_edges

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


def test_the_image_says_where_a_wide_ramp_ends():
    truth = box()
    soft = blurred(truth, 2)
    errors = [
        (sharpen_edges(soft, picture(truth, contrast)) / truth - 1.0).abs().mean() for contrast in (0.0, 0.6)
    ]
    assert errors[1] < errors[0]


@pytest.mark.parametrize("spacing", [1, 4])
def test_planes_and_steep_edges_stay_bit_for_bit(spacing):
    v = torch.arange(96.0).view(1, 1, -1, 1).expand(-1, -1, -1, 80)
    ground = 1.6 * 100.0 / (v + 4.0)  # a camera 1.6 m above it; it changes by a fifth a row at the horizon
    for depth_m in (ground, F.interpolate(box(), scale_factor=2, mode="nearest")):
        assert torch.equal(sharpen_edges(depth_m, torch.rand(1, 3, *depth_m.shape[-2:]), spacing), depth_m)


def test_a_thin_post_keeps_its_depth():
    depth_m = torch.full((1, 1, 40, 60), FAR)
    depth_m[..., 30] = NEAR
    assert torch.equal(sharpen_edges(depth_m, picture(depth_m)), depth_m)


def test_it_gives_depths_that_are_there():
    generator = torch.Generator().manual_seed(0)
    depth_m = blurred(1.0 + 9.0 * torch.rand(1, 1, 50, 70, generator=generator))
    sharp = sharpen_edges(depth_m, torch.rand(1, 3, 50, 70, generator=generator))
    assert not torch.equal(sharp, depth_m)
    assert torch.isin(sharp, depth_m).all()


def test_strips_chunks_and_batches_change_nothing(monkeypatch):
    generator = torch.Generator().manual_seed(1)
    soft = torch.cat([blurred(box(), rounds) for rounds in (1, 2)])
    soft = soft * (1.0 + 0.01 * torch.rand(soft.shape, generator=generator))
    left = torch.rand(2, 3, 48, 64, generator=generator)
    whole = sharpen_edges(soft, left, 2)
    alone = [sharpen_edges(*each, 2) for each in zip(soft.split(1), left.split(1), strict=True)]
    assert torch.equal(whole, torch.cat(alone))
    monkeypatch.setattr("geodiff_plugin.formats.depth.STRIP_PIXELS", 5 * 64)
    monkeypatch.setattr(sharpening, "CHUNK", 7)
    assert torch.equal(sharpen_edges(soft, left, 2), whole)


@pytest.mark.parametrize(("name", "value"), [("SLOPE", 1e3), ("REACH", 0.3), ("BRIGHTNESS", 1e3)])
def test_every_weight_of_the_median_counts(monkeypatch, name, value):
    truth = box()
    soft, left = blurred(truth), picture(truth)
    usual = sharpen_edges(soft, left)
    monkeypatch.setattr(sharpening, name, value)
    assert not torch.equal(sharpen_edges(soft, left), usual)
