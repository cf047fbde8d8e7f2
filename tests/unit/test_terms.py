"""Guidance terms against their formulas in NumPy, and the photometric one against what it must not see."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from geodiff_plugin.algorithm.terms import ANCHOR_FLOOR, TERM_CAUCHY, TERMS, Compared
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import AffineState

SIZE = (32, 40)
FLAT = DEFAULT.changed(pyramid_levels=1)
photometric = TERMS["photometric"].function


def draw(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def estimate(**changes):
    left = draw(2, 3, *SIZE)
    affine = AffineState(torch.tensor([0.3, -2.0]), torch.tensor([1.0, 0.5]), torch.tensor([2.0, 9.0]))
    half = torch.full((2, 1, *SIZE), 0.5, dtype=torch.float64)
    matches = Matches(half, torch.ones_like(half), torch.tensor([0.01, 0.02]))
    latent = torch.zeros(2, 4, 8, 10, dtype=torch.float64)
    seen = torch.ones(2, 1, 1, *SIZE, dtype=torch.bool)
    values = (1.0 / half, left, left[:, None].clone(), seen, affine, affine, latent, latent, matches, matches)
    return Compared(*values)._replace(**changes)


@pytest.mark.parametrize("name", TERMS)
def test_a_perfect_estimate_costs_nothing(name):
    value = TERMS[name].function(estimate())
    torch.testing.assert_close(value.double(), torch.zeros(2).double(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("knobs", [{}, {"points_loss": "l1l2", "pull_to": "zero"}])
@pytest.mark.parametrize("matched", [True, False])
def test_values_are_the_formulas(knobs, matched):
    depth, inverse, confidence = 1 + draw(2, 1, *SIZE), draw(2, 1, *SIZE, seed=1), draw(2, 1, *SIZE, seed=2)
    confidence[1] = 0.0  # the second sample has no match at all
    z0, unit = draw(2, 4, 8, 10, seed=3), torch.tensor([0.01, 0.3], dtype=torch.float64)
    target, start = Matches(inverse, confidence, unit), AffineState(*draw(3, 2, seed=4))
    compared = estimate(depth_m=depth, matches=target if matched else None, points=target, z0=z0)
    compared = compared._replace(affine_start=start, config=DEFAULT.changed(**knobs))
    d, w, c = (x.numpy() for x in (depth, inverse, confidence))
    e = (1 / d - w) / unit.numpy()[:, None, None, None]
    robust = TERM_CAUCHY**2 / 2 * np.log1p((e / TERM_CAUCHY) ** 2)
    metres, known = np.abs(d - 1 / w), c > 0

    def mean(x, weight):
        return (x * weight).sum((1, 2, 3)) / np.maximum(weight.sum((1, 2, 3)), 1e-6)

    points = mean(metres + metres**2, known) if knobs else mean(robust, c)
    s, t = compared.affine.s_hat.numpy(), compared.affine.t_hat.numpy()
    s, t = (s, t) if knobs else (s - start.s_hat.numpy(), t - start.t_hat.numpy())
    share = F.interpolate(confidence, (8, 10), mode="area").numpy()
    square = (z0.numpy() ** 2).mean(1, keepdims=True) * (
        np.maximum(1 - share, ANCHOR_FLOOR) if matched else 1
    )
    expected = {"points": points, "prior_pull": s**2 + t**2, "anchor": square.mean((1, 2, 3))}
    for name, value in (expected | ({"matches": mean(robust, c)} if matched else {})).items():
        np.testing.assert_allclose(TERMS[name].function(compared), value, rtol=1e-6, err_msg=name)


def test_photometric_ignores_what_is_not_visible():
    warped, seen = estimate().warped_01.clone(), torch.zeros(2, 1, 1, *SIZE, dtype=torch.bool)
    warped[..., 20:] = 0.0
    seen[..., :18] = True  # SSIM looks one pixel around
    masked = photometric(estimate(warped_01=warped, visible=seen, config=FLAT))
    torch.testing.assert_close(masked, torch.zeros_like(masked), atol=1e-5, rtol=0)
    assert (photometric(estimate(warped_01=warped, config=FLAT)) > 0.1).all()
