"""Exposure is taken out of the photometric comparison, wrong depth is not."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin.algorithm.photometric import match_exposure

SIZE = (48, 60)


def _texture(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.3 + 0.2 * torch.rand(1, 3, *SIZE, generator=generator)


@pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
def test_gain_and_bias_per_channel_are_undone(gain):
    left, seen = _texture(), torch.ones(1, 1, *SIZE, dtype=torch.bool)
    right = gain * left * torch.tensor([0.9, 1.0, 1.1]).view(1, 3, 1, 1) + 0.02
    assert (match_exposure(right, left, seen) - left).abs().max() < 0.01


def test_vignetting_is_mostly_undone():
    left, seen = _texture(), torch.ones(1, 1, *SIZE, dtype=torch.bool)
    rows, columns = torch.meshgrid(
        torch.linspace(-1, 1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij"
    )
    right = left * (1.0 - 0.3 * (rows**2 + columns**2) / 2)
    before, after = (right - left).abs().mean(), (match_exposure(right, left, seen) - left).abs().mean()
    assert after < 0.35 * before


def test_what_is_not_visible_does_not_count():
    left, seen = _texture(), torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    seen[..., :30] = True
    right = 0.7 * left
    right[..., 30:] = 1.0
    assert (match_exposure(right, left, seen) - left)[..., :25].abs().max() < 0.02


def test_another_scene_stays_another_scene():
    left, seen = _texture(), torch.ones(1, 1, *SIZE, dtype=torch.bool)
    assert (match_exposure(_texture(1), left, seen) - left).abs().mean() > 0.04


def test_blank_images_stay_finite():
    flat, seen = torch.full((1, 3, *SIZE), 0.5), torch.ones(1, 1, *SIZE, dtype=torch.bool)
    warped = flat.clone().requires_grad_()
    matched = match_exposure(warped, flat, seen)
    (gradient,) = torch.autograd.grad(matched.square().sum(), warped)
    assert torch.isfinite(matched).all() and torch.isfinite(gradient).all()
