"""Marigold V2: the scale of latents, tokens, the one step, and frames that are decoded in parts."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from examples.fitted_lora import FittedLora, complete_by_lora, draw_points
from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.bundled.demo_pair import DemoPair
from geodiff_plugin.priors import marigold_v2 as module
from geodiff_plugin.priors.marigold_v2 import TIMESTEP, MarigoldV2Pipeline
from tests.views import made_rig


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def pipe():
    return tiny_marigold_v2()


def drawn(seed=0):
    return torch.Generator().manual_seed(seed)


def test_latents_are_normalised_channel_by_channel_and_brought_back(pipe):
    config, z = pipe.vae.config, torch.randn(2, 16, 3, 5)
    mean, std = (np.array(v)[:, None, None] for v in (config.latents_mean, config.latents_std))
    np.testing.assert_allclose(pipe.scale_latents(z), (z.numpy() - mean) / std, rtol=1e-5, atol=1e-6)
    assert pipe.scale_latents(z.bfloat16()).dtype == torch.float32
    image = torch.rand(2, 3, 32, 48) * 2 - 1
    with torch.no_grad():
        moments = pipe.encode_moments(image)
        wanted = pipe.vae.encode(image[:, :, None]).latent_dist
        torch.testing.assert_close(moments[:, :16], wanted.mode()[:, :, 0])
        assert moments.shape == (2, 32, 4, 6)
        np.testing.assert_allclose(
            pipe.encode_image(image), (moments[:, :16].numpy() - mean) / std, rtol=1e-4, atol=1e-5
        )
        decoded = pipe.decode_image(z)
        theirs = pipe.vae.decode(torch.from_numpy(z.numpy() * std + mean).float()[:, :, None]).sample[:, :, 0]
    assert decoded.shape == (2, 3, 24, 40)
    torch.testing.assert_close(decoded.clamp(-1, 1), theirs)


def test_latents_of_members_are_drawn_or_all_the_mode(pipe):
    image = torch.rand(2, 3, 32, 48) * 2 - 1
    sampling = MarigoldV2Pipeline(**pipe.components, sample_latent=True)
    assert pipe.deterministic and not sampling.deterministic and sampling.config.sample_latent
    with torch.no_grad():
        mode, again = (pipe.prepare_condition(image, 2, 1, drawn(s)) for s in (0, 1))
        samples, same, other = (sampling.prepare_condition(image, 2, 1, drawn(s)) for s in (0, 0, 1))
        moments = pipe.encode_moments(image)
    assert torch.equal(mode["image_latent"], again["image_latent"])
    torch.testing.assert_close(mode["image_latent"][::2], pipe.scale_latents(moments[:, :16]))
    assert torch.equal(mode["image_latent"][0], mode["image_latent"][1])
    assert torch.equal(samples["image_latent"], same["image_latent"])
    assert not torch.equal(samples["image_latent"], other["image_latent"])
    assert not torch.equal(samples["image_latent"][0], samples["image_latent"][1])
    assert torch.equal(mode["prompt"], pipe.prompt().expand(4, -1, -1))
    assert pipe.prepare_latents(mode, drawn()) is mode["image_latent"]
    half = tiny_marigold_v2().to(dtype=torch.bfloat16)
    with torch.no_grad():
        condition = half.prepare_condition(image.bfloat16(), 1, 2, None)
    assert {value.dtype for value in condition.values()} == {torch.bfloat16}


def test_one_step_of_the_whole_length_subtracts_the_velocity(pipe):
    pipe.set_timesteps(1, torch.device("cpu"))
    assert pipe.scheduler.timesteps.tolist() == [TIMESTEP] == [500.0]
    z, velocity = torch.randn(2, 16, 3, 5), torch.randn(2, 16, 3, 5)
    found = pipe.scheduler.step(velocity, pipe.scheduler.timesteps[0], z).prev_sample
    torch.testing.assert_close(found, z - velocity)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_tokens_are_squares_of_four_latents_and_the_answer_is_put_back_where_they_were(dtype):
    seen = {}

    def transformer(**reported):
        seen.update(reported)
        return 2 * reported["hidden_states"], "more"

    z = torch.randn(3, 16, 4, 6).to(dtype).float()
    condition = {"prompt": torch.randn(3, 5, 8).to(dtype)}
    pipe = SimpleNamespace(transformer=transformer)
    found = MarigoldV2Pipeline.denoise(pipe, z, torch.tensor(500.0), condition)
    torch.testing.assert_close(found, 2 * z)
    assert found.dtype == torch.float32 and seen["hidden_states"].dtype == dtype
    assert seen["hidden_states"].shape == (3, 6, 64)
    torch.testing.assert_close(seen["hidden_states"][1, 4].float(), z[1, :, 2:4, 2:4].flatten())
    assert seen["img_shapes"] == [[(1, 2, 3)]] * 3 and seen["return_dict"] is False
    torch.testing.assert_close(seen["timestep"], torch.full((3,), 0.5, dtype=dtype))
    assert seen["encoder_hidden_states"] is condition["prompt"]


def test_its_blocks_are_computed_again_in_the_backward_pass(pipe):
    assert pipe.transformer.is_gradient_checkpointing


class Frames:
    """A video autoencoder of one channel that records what it is given."""

    def __init__(self, tiling=False, slicing=False, tile=(32, 64)):
        self.use_tiling, self.use_slicing = tiling, slicing
        self.tile_sample_min_height, self.tile_sample_min_width = tile
        self.config = SimpleNamespace(latents_mean=[1.0], latents_std=[2.0])
        self.dtype, self.calls = torch.float32, []

    def tiled_decode(self, z, return_dict):
        self.calls.append(("tiles", tuple(z.shape), return_dict))
        return z, "more"

    def post_quant_conv(self, z):
        return z + 1

    def decoder(self, z):
        self.calls.append(("whole", tuple(z.shape)))
        return 3 * z


@pytest.mark.parametrize(
    ("size", "tiling", "tiled"),
    [
        *(((4, 8), tiling, False) for tiling in (False, True)),
        *(((5, 8), tiling, tiling) for tiling in (False, True)),
        *(((4, 9), tiling, tiling) for tiling in (False, True)),
    ],
)
def test_a_frame_that_is_larger_than_a_tile_is_decoded_in_tiles_if_the_user_asked_for_them(
    size, tiling, tiled
):
    vae, z = Frames(tiling), torch.randn(2, 1, 1, *size)
    found = module._decode(vae, z)
    assert vae.calls == [("tiles", tuple(z.shape), False)] if tiled else [("whole", tuple(z.shape))]
    assert torch.equal(found, z if tiled else 3 * (z + 1))


@pytest.mark.parametrize("slicing", [False, True])
def test_frames_are_decoded_one_by_one_if_the_user_asked_for_it(slicing):
    vae, z = Frames(slicing=slicing), torch.randn(3, 1, 4, 8)
    found = MarigoldV2Pipeline.decode_image(SimpleNamespace(vae=vae), z)
    assert vae.calls == [("whole", (1, 1, 1, 4, 8))] * 3 if slicing else [("whole", (3, 1, 1, 4, 8))]
    torch.testing.assert_close(found, 3 * (2 * z + 1 + 1))
    assert MarigoldV2Pipeline.decode_image(SimpleNamespace(vae=vae), z.bfloat16()).dtype == torch.float32


def test_every_channel_is_clipped_before_their_mean():
    rgb = 2 * torch.randn(2, 3, 5, 6)
    found = MarigoldV2Pipeline.decode_prediction(SimpleNamespace(decode_image=lambda z: rgb), None)
    wanted = (np.clip(rgb.numpy(), -1, 1).mean(1, keepdims=True) + 1) / 2
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_an_offloaded_autoencoder_is_brought_back_before_it_decodes():
    vae, brought = Frames(), []
    vae._hf_hook = SimpleNamespace(pre_forward=brought.append)
    module._decode(vae, torch.zeros(1, 1, 1, 4, 8))
    assert brought == [vae]


def test_a_frame_is_the_librarys_but_for_the_clamp_in_slices_and_tiles_too():
    pipe = tiny_marigold_v2()
    vae = pipe.vae
    z = 4.0 * torch.randn(2, 16, 4, 6, generator=torch.Generator().manual_seed(0))
    shape = (1, 16, 1, 1)
    mean, std = (torch.tensor(v).view(shape) for v in (vae.config.latents_mean, vae.config.latents_std))
    theirs = vae.decode((z * std + mean)[:, :, None]).sample[:, :, 0]
    ours = pipe.decode_image(z.requires_grad_())
    assert (ours.abs() > 1).any(), "nothing to clip"
    torch.testing.assert_close(ours.clamp(-1, 1), theirs, rtol=0, atol=1e-6)
    beyond = torch.where(ours.abs() > 1, ours, 0.0)
    (gradient,) = torch.autograd.grad(beyond.sum(), z, retain_graph=True)
    assert gradient.abs().sum() > 0
    with torch.no_grad():
        vae.use_slicing = True
        torch.testing.assert_close(pipe.decode_image(z), ours, rtol=0, atol=1e-4)
        vae.use_slicing = False
        vae.enable_tiling(16, 16, 8, 8)
        tiled = pipe.decode_image(z)
    both = torch.stack([tiled.flatten(), ours.detach().flatten()])
    assert tiled.shape == ours.shape and torch.corrcoef(both)[0, 1] > 0.8


def guided(pipe, pair, factor=1.0, **parameters):
    points = np.zeros_like(pair.depth_m)
    points[::4, ::4] = pair.depth_m[::4, ::4] * factor
    guidance = GeometryGuidance.from_points(points, pair.K, min_steps=1, **parameters)
    return enable_geometry_guidance(pipe)(Image.fromarray(pair.left), guidance=guidance).prediction[0, ..., 0]


@pytest.mark.parametrize("space", ["log", "depth", "disparity"])
def test_points_make_every_space_metric_in_half_precision_too(space, textured_plane):
    depth_m = guided(tiny_marigold_v2(space=space), textured_plane, guidance_steps=1)
    assert np.median(np.abs(depth_m / textured_plane.depth_m - 1)) < 0.025
    half = guided(tiny_marigold_v2(space=space).to(dtype=torch.bfloat16), textured_plane, guidance_steps=1)
    assert half.dtype == np.float32 and np.median(np.abs(half / depth_m - 1)) < 0.003


@pytest.fixture
def pair(textured_plane):
    left, right = (image / np.float32(255) for image in (textured_plane.left, textured_plane.right))
    rig = made_rig(textured_plane.K, textured_plane.K, textured_plane.E)
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
