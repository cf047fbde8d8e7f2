"""Marigold V2: frames of a video autoencoder, spaces, gradients, corrections that stay, and a fitted LoRA."""

import numpy as np
import pytest
import torch
from PIL import Image

from examples.fitted_lora import FittedLora, complete_by_lora, draw_points
from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.bundled.demo_pair import DemoPair
from geodiff_plugin.types import Rig


def test_a_frame_is_the_librarys_but_for_the_clamp_in_slices_and_tiles_too():
    pipe = tiny_marigold_v2()
    vae = pipe.vae
    z = 4.0 * torch.randn(2, 16, 4, 6, generator=torch.Generator().manual_seed(0))
    shape = (1, 16, 1, 1)
    mean, std = (torch.tensor(v).view(shape) for v in (vae.config.latents_mean, vae.config.latents_std))
    theirs = vae.decode((z * std + mean)[:, :, None]).sample[:, :, 0]
    ours = pipe.decode_picture(z.requires_grad_())
    assert (ours.abs() > 1).any(), "nothing to clip"
    torch.testing.assert_close(ours.clamp(-1, 1), theirs, rtol=0, atol=1e-6)
    beyond = torch.where(ours.abs() > 1, ours, 0.0)
    (gradient,) = torch.autograd.grad(beyond.sum(), z, retain_graph=True)
    assert gradient.abs().sum() > 0
    with torch.no_grad():
        vae.use_slicing = True
        torch.testing.assert_close(pipe.decode_picture(z), ours, rtol=0, atol=1e-4)
        vae.use_slicing = False
        vae.enable_tiling(16, 16, 8, 8)
        tiled = pipe.decode_picture(z)
    both = torch.stack([tiled.flatten(), ours.detach().flatten()])
    assert tiled.shape == ours.shape and torch.corrcoef(both)[0, 1] > 0.8


def guided(pipe, pair, factor=1.0, **knobs):
    points = np.zeros_like(pair.depth_m)
    points[::4, ::4] = pair.depth_m[::4, ::4] * factor
    guidance = GeometryGuidance.from_points(points, pair.K, min_steps=1, **knobs)
    return enable_geometry_guidance(pipe)(Image.fromarray(pair.left), guidance=guidance).prediction[0, ..., 0]


@pytest.mark.parametrize("space", ["log", "depth", "disparity"])
def test_points_make_every_space_metric_in_half_precision_too(space, textured_plane):
    depth_m = guided(tiny_marigold_v2(space=space), textured_plane, inner_steps=1)
    assert np.median(np.abs(depth_m / textured_plane.depth_m - 1)) < 0.025
    half = guided(tiny_marigold_v2(space=space).to(dtype=torch.bfloat16), textured_plane, inner_steps=1)
    assert half.dtype == np.float32 and np.median(np.abs(half / depth_m - 1)) < 0.003


@pytest.fixture
def pair(textured_plane):
    left, right = (image / np.float32(255) for image in (textured_plane.left, textured_plane.right))
    rig = Rig(textured_plane.K, textured_plane.K, textured_plane.E)
    return DemoPair(left, right, rig, textured_plane.depth_m, textured_plane.depth_m > 0)


def test_a_lora_lowers_the_error_at_its_points_from_the_least_squares_fit_on(pair):
    pipe, points = tiny_marigold_v2(), torch.from_numpy(draw_points(pair, 200))
    before = {name: p.clone() for name, p in pipe.transformer.named_parameters()}
    known = points > 0
    start, fitted = (
        complete_by_lora(pipe, pair.left, points, FittedLora(steps=steps, rank=4)) for steps in (0, 6)
    )
    x = pipe(pair.left).prediction[0, ..., 0]  # log depth is affine in it
    a, b = np.polyfit(x[known].astype(float), np.log(points[known].double().numpy()), 1)
    np.testing.assert_allclose(np.log(start.numpy()), a * x + b, rtol=0, atol=2e-3)
    assert (fitted - points).abs()[known].mean() < (start - points).abs()[known].mean()
    assert all(torch.equal(p, before[name]) for name, p in pipe.transformer.named_parameters())
    assert not any(m._forward_hooks for m in pipe.transformer.modules())
    with pytest.raises(ValueError, match="log depth"):
        complete_by_lora(tiny_marigold_v2(space="disparity"), pair.left, torch.ones(4, 4))
