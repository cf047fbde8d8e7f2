"""Marigold V2: frames of a video autoencoder, spaces, gradients, corrections that stay, and a fitted LoRA."""

from types import SimpleNamespace

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


class BlockCode(torch.nn.Module):
    """An autoencoder of 8 x 8 blocks that keeps their lowest frequencies, shaped as Qwen-Image's."""

    use_slicing = use_tiling = False
    tile_sample_min_height = tile_sample_min_width = 256
    dtype, device = torch.float32, torch.device("cpu")

    def __init__(self, kept: int) -> None:
        super().__init__()
        k = np.arange(8)
        cosines = np.cos(np.pi * (2 * k[None] + 1) * k[:, None] / 16)
        cosines *= np.where(k == 0, 0.5, 2**-0.5)[:, None] / 2
        self.basis = torch.nn.Parameter(torch.tensor(cosines[:kept] * 2**0.5, dtype=torch.float32))
        count = kept * kept
        self.config = SimpleNamespace(latents_mean=[0.1] * count, latents_std=[2.0] * count)
        self.post_quant_conv = torch.nn.Identity()

    def encode(self, picture):
        blocks = picture.mean(1)[:, 0].unflatten(1, (-1, 8)).unflatten(3, (-1, 8))  # (B, h, 8, w, 8)
        z = torch.einsum("bhiwj,ui,vj->buvhw", blocks, self.basis, self.basis).flatten(1, 2)[:, :, None]
        moments = torch.cat([z, torch.full_like(z, -30.0)], dim=1)
        return SimpleNamespace(latent_dist=SimpleNamespace(parameters=moments))

    def decoder(self, z):
        z = z[:, :, 0].unflatten(1, (len(self.basis), -1))
        grey = torch.einsum("buvhw,ui,vj->bhiwj", z, self.basis, self.basis)
        return grey.flatten(3).flatten(1, 2)[:, None, None].expand(-1, 3, -1, -1, -1)


def wavy_map() -> torch.Tensor:
    """A slope with ripples of 8 px, as detail of a surface."""
    rows, columns = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    return (0.2 + 0.5 * rows / 64 + 0.05 * torch.sin(columns * 2 * torch.pi / 8))[None, None]


@pytest.mark.parametrize("beyond", [0.0, 0.5])
def test_a_corrected_latent_keeps_the_correction_and_the_detail(beyond):
    """Also of a map ``beyond`` 1, where the library clamps, and of detail that no code holds."""
    pipe, x = tiny_marigold_v2(), wavy_map() + beyond
    pipe.vae = BlockCode(8)
    torch.testing.assert_close(pipe.decode(pipe.encode(x)), x, rtol=0, atol=1e-5)
    pipe.vae = BlockCode(4)
    rows = torch.linspace(0, 1, 64)[:, None].expand(64, 96)[None, None]
    corrected = x + 0.2 * rows * (1 - rows)
    kept = pipe.decode(pipe.encode(x))
    assert (kept - x).abs().max() > 5e-4, "16 channels hold all of it, so that there is nothing to lose"
    moved = pipe.encode(corrected) - pipe.encode(x)
    z0 = torch.randn(moved.shape, generator=torch.Generator().manual_seed(0))  # the prior's own, any
    arrived = pipe.decode(z0 + moved) - pipe.decode(z0)
    torch.testing.assert_close(arrived, corrected - x, rtol=0, atol=1e-3)


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


def test_a_guided_call_ends_at_its_points(textured_plane):
    """By the correction alone: nothing refines the result, no gradient moves it."""
    errors = {}
    for correct in (False, True):
        pipe = tiny_marigold_v2()
        pipe.vae = BlockCode(4)
        depth_m = guided(pipe, textured_plane, 1.1, inner_steps=0, crisp=False, correct=correct)
        truth_m = 1.1 * textured_plane.depth_m
        errors[correct] = np.abs(depth_m / truth_m - 1)[::4, ::4].mean()
    # 0.039 and 0.091 were seen: the prior has random weights, and 16 channels do not hold its whole map.
    assert errors[True] < 0.5 * errors[False] and errors[True] < 0.045


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
