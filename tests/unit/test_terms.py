from __future__ import annotations

import kornia.metrics
import pytest
import torch

from geodiff_plugin.algorithm.photometric import masked_mean, match_exposure, photometric_map, ssim
from geodiff_plugin.algorithm.terms import ANCHOR_FLOOR, CAUCHY, TERMS, Compared
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import AffineState

photometric = TERMS["photometric"].function
FLAT = DEFAULT.changed(pyramid_levels=1)


def estimate(**changes):
    left = torch.rand(2, 3, 32, 40, generator=torch.Generator().manual_seed(0))
    affine = AffineState(torch.tensor([0.3, -2.0]), torch.tensor([1.0, 0.5]), torch.tensor([2.0, 9.0]))
    values = {
        "depth_m": torch.full((2, 1, 32, 40), 2.0),
        "left_01": left,
        "warped_01": left[:, None].clone(),
        "visible": torch.ones(2, 1, 1, 32, 40, dtype=torch.bool),
        "affine": affine,
        "affine_start": affine,
        "z0": torch.zeros(2, 4, 8, 10),
        "z0_prior": torch.zeros(2, 4, 8, 10),
        "points": Matches(
            torch.full((2, 1, 32, 40), 0.5), torch.ones(2, 1, 32, 40), torch.tensor([0.01, 0.02])
        ),
        "matches": Matches(
            torch.full((2, 1, 32, 40), 0.5), torch.ones(2, 1, 32, 40), torch.tensor([0.01, 0.02])
        ),
    }
    return Compared(**(values | changes))


@pytest.mark.parametrize("name", [n for n in TERMS if n != "prior_pull"])
def test_a_perfect_estimate_costs_nothing(name):
    value = TERMS[name].function(estimate())
    torch.testing.assert_close(value, torch.zeros(2), atol=1e-5, rtol=0)


def test_photometric_ignores_what_is_not_visible():
    warped = estimate().warped_01.clone()
    warped[..., 20:] = 0.0
    seen = torch.zeros(2, 1, 1, 32, 40, dtype=torch.bool)
    seen[..., :18] = True  # SSIM looks one pixel around
    masked = photometric(estimate(warped_01=warped, visible=seen, config=FLAT))
    torch.testing.assert_close(masked, torch.zeros(2), atol=1e-5, rtol=0)
    assert (photometric(estimate(warped_01=warped, config=FLAT)) > 0.1).all()


def test_photometric_takes_the_view_that_explains_a_pixel_best():
    left = estimate().left_01
    good, bad = left.clone(), torch.zeros_like(left)
    first, second = good.clone(), bad.clone()
    first[..., 20:], second[..., 20:] = 0.0, left[..., 20:]
    seen = torch.ones(2, 2, 1, 32, 40, dtype=torch.bool)
    both = estimate(warped_01=torch.stack([first, second], 1), visible=seen, config=FLAT)
    seam = photometric(both)  # SSIM looks one pixel across the seam
    assert (seam < 0.03).all() and (photometric(estimate(warped_01=first[:, None])) > 0.2).all()
    hidden = both.visible.clone()
    hidden[:, 1] = False
    alone = photometric(estimate(warped_01=both.warped_01, visible=hidden))
    torch.testing.assert_close(alone, photometric(estimate(warped_01=first[:, None])))


def test_points_robust_and_in_metres():
    points = TERMS["points"].function
    known = torch.zeros(2, 1, 32, 40)
    known[:, :, 3, 4] = known[:, :, 20, 30] = 1.0
    target = Matches(torch.full((2, 1, 32, 40), 0.5) * known, known, torch.tensor([0.005, 0.005]))
    off = estimate(depth_m=torch.full((2, 1, 32, 40), 2.5), points=target)
    c2 = CAUCHY**2
    expected = torch.full((2,), c2 / 2 * float(torch.log1p(torch.tensor(20.0**2 / c2))))
    torch.testing.assert_close(points(off), expected)
    torch.testing.assert_close(
        points(off._replace(config=DEFAULT.changed(points_loss="l1l2"))), torch.full((2,), 0.5 + 0.25)
    )


@pytest.mark.parametrize("points_loss", ["robust", "l1l2"])
def test_points_gradient_in_float64(points_loss):
    g = torch.Generator().manual_seed(5)
    depth = torch.rand(1, 1, 6, 7, generator=g, dtype=torch.float64) + 1.0
    known = (torch.rand(1, 1, 6, 7, generator=g) < 0.4).double()
    target = Matches(
        known / (torch.rand(1, 1, 6, 7, generator=g, dtype=torch.float64) + 1.0),
        known,
        known.new_tensor([0.01]),
    )
    base = estimate(points=target, config=DEFAULT.changed(points_loss=points_loss))

    def loss(d):
        return TERMS["points"].function(base._replace(depth_m=d))

    assert torch.autograd.gradcheck(loss, depth.requires_grad_())
    (grad,) = torch.autograd.grad(loss(depth).sum(), depth)
    assert (grad[known == 0] == 0).all() and (grad[known > 0] != 0).all()


def test_photometric_without_ssim_is_l1():
    left = estimate().left_01
    warped = (left + 0.1).clamp(0, 1)
    torch.testing.assert_close(photometric_map(left, warped, eta=0.0), (left - warped).abs())


def test_photometric_gradient_in_float64():
    g = torch.Generator().manual_seed(3)
    left = torch.rand(1, 3, 26, 25, generator=g, dtype=torch.float64)
    warped = torch.rand(1, 2, 3, 26, 25, generator=g, dtype=torch.float64)
    seen = torch.rand(1, 2, 1, 26, 25, generator=g) < 0.8
    base = estimate(left_01=left, visible=seen, config=DEFAULT.changed(pyramid_levels=2))

    def loss(w):
        return photometric(base._replace(warped_01=w))

    warped.requires_grad_()
    (grad,) = torch.autograd.grad(loss(warped).sum(), warped)
    direction = torch.randn(warped.shape, generator=g, dtype=torch.float64)
    h = 1e-6
    with torch.no_grad():
        numeric = (loss(warped + h * direction) - loss(warped - h * direction)).sum() / (2 * h)
    torch.testing.assert_close((grad * direction).sum(), numeric, rtol=1e-5, atol=1e-9)


def test_matches_in_planes():
    near = estimate(depth_m=torch.full((2, 1, 32, 40), 1 / 0.53))
    c2 = CAUCHY**2
    expected = c2 / 2 * torch.log(1 + torch.tensor([3.0, 1.5]) ** 2 / c2)
    torch.testing.assert_close(TERMS["matches"].function(near), expected, rtol=1e-4, atol=0)


def test_a_surface_far_from_its_matches_is_still_pulled():
    far_off = estimate(depth_m=torch.full((2, 1, 32, 40), 50.0, requires_grad=True))
    (grad,) = torch.autograd.grad(TERMS["matches"].function(far_off).sum(), far_off.depth_m)
    assert (grad > 0).all()


def test_no_matches_cost_nothing_and_pull_nothing():
    target = estimate().matches
    empty = Matches(target.inverse_depth, torch.zeros_like(target.confidence), target.plane_step)
    depth = torch.full((2, 1, 32, 40), 7.0, requires_grad=True)
    value = TERMS["matches"].function(estimate(depth_m=depth, matches=empty))
    assert value.abs().max() == 0
    (grad,) = torch.autograd.grad(value.sum(), depth)
    assert torch.isfinite(grad).all() and grad.abs().max() == 0


def test_prior_pull_anchors():
    pull = TERMS["prior_pull"].function
    torch.testing.assert_close(pull(estimate()), torch.zeros(2))
    to_zero = estimate(config=DEFAULT.changed(pull_to="zero"))
    torch.testing.assert_close(pull(to_zero), torch.tensor([0.09 + 1.0, 4.0 + 0.25]))


def test_anchor_holds_what_no_match_holds():
    moved = torch.full((2, 4, 8, 10), 3.0)
    value = TERMS["anchor"].function(estimate(z0=moved, matches=None))
    torch.testing.assert_close(value, torch.full((2,), 9.0))
    target = estimate().matches
    half = target.confidence.clone()
    half[..., :20] = 0.0
    half = Matches(target.inverse_depth, half, target.plane_step)
    value = TERMS["anchor"].function(estimate(z0=moved, matches=half))
    torch.testing.assert_close(value, torch.full((2,), 9.0 * (1.0 + ANCHOR_FLOOR) / 2.0))


def test_masked_mean():
    value = torch.arange(6.0).view(1, 1, 2, 3)
    weight = torch.tensor([[1, 0, 1], [0, 0, 0]], dtype=torch.bool).view(1, 1, 2, 3)
    assert masked_mean(value, weight).item() == 1.0
    assert masked_mean(value, torch.zeros_like(weight)).item() == 0.0


def test_ssim_is_kornias():
    torch.manual_seed(0)
    a, b = torch.rand(2, 2, 3, 25, 31)
    b = 0.7 * a + 0.3 * b
    torch.testing.assert_close(ssim(a, b), kornia.metrics.ssim(a, b, 3), atol=2e-5, rtol=0)


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
