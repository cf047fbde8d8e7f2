"""DepthFM's flow, its start and its ending, against closed forms and NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler

from geodiff_plugin.priors.depthfm import SIDE, DepthFMPipeline
from tests.contracts.tiny_priors import make_depthfm


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def pipe():
    return make_depthfm()


def drawn(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("steps", [1, 2, 3, 5])
def test_a_network_that_knows_the_velocity_is_led_to_the_depth_in_any_number_of_steps(steps):
    """The flow's time, from 0 in equal steps, is what the network sees next to latents and image."""
    image, depth = torch.randn(2, 4, 3, 5), torch.randn(2, 4, 3, 5)
    seen = []

    def run_unet(sample, time, condition):
        seen.append((sample, float(time), condition))
        return depth - image

    pipe = SimpleNamespace(scheduler=FlowMatchEulerDiscreteScheduler(), run_unet=run_unet)
    DepthFMPipeline.set_timesteps(pipe, steps, torch.device("cpu"))
    z, condition = image, {"image_latent": image, "prompt": torch.zeros(2, 1, 1)}
    for i, t in enumerate(pipe.scheduler.timesteps):
        z_t = z
        output = DepthFMPipeline.denoise(pipe, z, t, condition)
        z = pipe.scheduler.step(output, t, z).prev_sample
        torch.testing.assert_close(seen[i][0], torch.cat([z_t, image], dim=1))
        torch.testing.assert_close(z, image + (i + 1) / steps * (depth - image))
    np.testing.assert_allclose([time for _, time, _ in seen], np.arange(steps) / steps, atol=1e-6)
    assert all(reported is condition for *_, reported in seen)


def test_every_member_starts_at_its_images_latent_with_noise_of_its_own(pipe):
    rgb = torch.rand(2, 3, 64, 128) * 2 - 1
    with torch.no_grad():
        condition = pipe.prepare_condition(rgb, 2, 1, None)
        alone = torch.cat([pipe.image_latents(rgb[i : i + 1], 1, 1) for i in (0, 0, 1, 1)])
    torch.testing.assert_close(condition["image_latent"], alone)
    assert torch.equal(condition["prompt"], pipe.prompt().expand(4, -1, -1))
    start = pipe.prepare_latents(condition, drawn(3))
    noise = torch.randn(alone.shape, generator=drawn(3))
    torch.testing.assert_close(start, pipe.add_noise(condition["image_latent"], noise))
    assert not torch.equal(start[0], start[1]) and not pipe.deterministic
    half = pipe.prepare_latents({"image_latent": alone.half()}, drawn(3))
    assert half.dtype == torch.float16


def test_without_noise_it_starts_at_the_image_and_members_are_the_same(pipe):
    plain = DepthFMPipeline(**pipe.components, noising_step=0)
    latent = torch.randn(2, 4, 3, 5)
    assert plain.deterministic and plain.prepare_latents({"image_latent": latent}, drawn()) is latent
    for step in (1, 999):
        assert not DepthFMPipeline(**pipe.components, noising_step=step).deterministic
    for wrong in (-1, 1000, 2.5):
        with pytest.raises((TypeError, ValueError), match="noising_step must be"):
            DepthFMPipeline(**pipe.components, noising_step=wrong)


def test_members_are_averaged_before_the_exponential_and_their_spread_is_in_the_maps_unit():
    logs = torch.randn(6, 1, 4, 5)
    depth, spread = DepthFMPipeline.combine_members(None, logs, 3, True, {})
    for i, members in enumerate(logs.numpy().reshape(2, 3, 4, 5)):
        wanted = np.exp(members.mean(0))
        width = wanted.max() - wanted.min()
        np.testing.assert_allclose(depth[i, 0], (wanted - wanted.min()) / width, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(spread[i, 0], np.exp(members).std(0, ddof=1) / width, rtol=1e-5)
    without, none = DepthFMPipeline.combine_members(None, logs, 3, False, {})
    assert none is None and torch.equal(without, depth)
    _, flat = DepthFMPipeline.combine_members(None, torch.ones(2, 1, 4, 5), 2, True, {})
    assert not flat.any()
    with pytest.raises(ValueError, match=r"ensembling_kwargs must be empty; got \['a', 'b'\]"):
        DepthFMPipeline.combine_members(None, logs, 3, False, {"b": 1, "a": 2})


def test_log_depth_is_the_mean_of_the_decoded_channels_not_clipped():
    rgb = 3 * torch.randn(2, 3, 8, 8)
    found = DepthFMPipeline.decode_prediction(SimpleNamespace(decode_image=lambda z: rgb), None)
    np.testing.assert_allclose(found[:, 0], rgb.numpy().mean(1), rtol=1e-5, atol=1e-6)
    assert found.shape == (2, 1, 8, 8)


def test_sides_are_the_nearest_multiples_of_64(pipe):
    image, padding, size = pipe.image_processor.preprocess(torch.rand(1, 3, 100, 200), 0)
    assert (tuple(image.shape[-2:]), padding, tuple(size)) == ((128, 192), (0, 0), (100, 200))
    assert pipe.image_processor.side == SIDE and not pipe.image_processor.grow
