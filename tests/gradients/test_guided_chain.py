"""Finite differences through the whole chain: z_t, U-Net, z0_hat, decoder, metres, warp, L_geo."""

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm.denoising import NoiseLevel, noise_from, output_from, z0_from
from geodiff_plugin.algorithm.terms import Given, Objective
from geodiff_plugin.cameras import Camera, PosedViews, View
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.matching import Matches
from geodiff_plugin.priors.marigold import MarigoldPrior
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import MetricMap

WEIGHTS = {"photometric": 1.0, "matches": 0.3, "points": 0.1, "affine_reg": 0.01, "anchor": 0.2}
CONFIG = GuidanceConfig(weights=WEIGHTS, pyramid_levels=2, affine_reg_target="zero", min_visible=0.0)
GRID = (1, 1, 48, 64)


def double(x):
    return torch.as_tensor(x, dtype=torch.float64)


def views_of(pair):
    """A rectified view, and one that is also below."""
    left, right = (double(image).permute(2, 0, 1) / 255 for image in (pair.left, pair.right))
    camera, T = Camera(np.asarray(pair.K, np.float64), right.shape[:0:-1]), np.linalg.inv(pair.E)
    below = T.copy()
    below[1, 3] = -0.1
    rights = tuple(View(right, camera, pose) for pose in (T, below))
    return [PosedViews(View(left, camera, np.eye(4)), rights)]


@pytest.mark.parametrize("space", ["depth", "disparity", "log", "sqrt_disparity"])
def test_whole_chain_against_finite_differences(make_pipeline, textured_plane, space):
    pipe = make_pipeline().to(torch.float64)
    prior, objective = MarigoldPrior(pipe), Objective(views_of(textured_plane), MetricMap(space), CONFIG)
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    condition, z_t, text, anchor = draw(1, 4, 24, 32), draw(1, 4, 24, 32), draw(1, 2, 8), draw(1, 4, 24, 32)
    level = NoiseLevel(double(0.6), double(0.8), "v_prediction")
    start = objective.metric.from_range(torch.tensor([1.3]), torch.tensor([3.1]))
    start = AffineState(double(start.s_hat), double(start.t_hat), double(start.g_s))
    inverse, known = 1.0 / double(textured_plane.depth_m)[None, None], torch.zeros(GRID).double()
    known[..., ::7, ::5] = 1.0
    matches = Matches(inverse, torch.ones_like(inverse), double([0.02]))
    points = Matches(known * inverse, known, double([0.005]))

    def loss(z, s_hat, t_hat):
        (output,) = pipe.unet(
            torch.cat([condition, z], 1), 500, encoder_hidden_states=text, return_dict=False
        )
        z0 = z0_from(output, z, level)
        affine = AffineState(s_hat, t_hat, start.g_s)
        given = Given(affine, start, z0, anchor, matches, points)
        return objective(prior.decode(z0), given).total.sum()

    inputs = [z_t.requires_grad_(), *(x.clone().requires_grad_() for x in (start.s_hat, start.t_hat))]
    for i, grad in enumerate(torch.autograd.grad(loss(*inputs), inputs)):
        assert torch.isfinite(grad).all() and grad.abs().max() > 0
        direction, h = draw(*grad.shape), 1e-6
        ahead, behind = (
            [x.detach() + (step * direction if j == i else 0.0) for j, x in enumerate(inputs)]
            for step in (h, -h)
        )
        with torch.no_grad():
            numeric = (loss(*ahead) - loss(*behind)) / (2 * h)
        # Bilinear sampling is piecewise smooth: a few of 3072 pixels may cross a centre within h.
        torch.testing.assert_close((grad * direction).sum(), numeric, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("prediction_type", ["epsilon", "v_prediction", "sample", "flow_prediction"])
def test_denoising_arithmetic_and_its_inverse(prediction_type):
    generator = torch.Generator().manual_seed(1)
    output, z_t = torch.randn(2, 1, 2, 2, 3, generator=generator, dtype=torch.float64).requires_grad_()
    alpha, sigma = (0.6, 0.8) if prediction_type != "flow_prediction" else (0.6, 0.4)
    level = NoiseLevel(double(alpha), double(sigma), prediction_type)
    assert torch.autograd.gradcheck(lambda o, z: z0_from(o, z, level), (output, z_t))
    rebuilt = output_from(z0_from(output, z_t, level), noise_from(output, z_t, level), level)
    torch.testing.assert_close(rebuilt, (output, z_t))
