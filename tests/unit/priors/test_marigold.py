"""Marigold's adapter against the stock pipeline, and priors tuned end to end to one step."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, MarigoldDepthPipeline

from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.marigold import E2EFTPipeline, E2EFTPrior, MarigoldPrior
from tests.contracts.tiny_priors import make_e2e_ft
from tests.tiny import make_marigold, seeded


@pytest.fixture(scope="module")
def marigold():
    return make_marigold()


@pytest.fixture(scope="module")
def tuned():
    return make_e2e_ft()


def test_the_map_is_the_stock_pipelines_before_it_clips(marigold):
    prior = MarigoldPrior(marigold)
    z0 = torch.randn(2, 4, 8, 8, generator=seeded())
    with torch.no_grad():
        found = prior.decode(z0)
        torch.testing.assert_close((2 * found - 1).clamp(-1, 1), 2 * marigold.decode_prediction(z0) - 1)
        rgb = torch.rand(2, 1, 16, 16, generator=seeded())
        moments = marigold.vae.encode((2 * rgb - 1).expand(-1, 3, -1, -1)).latent_dist
        wanted = moments.mode() * marigold.vae.config.scaling_factor
        torch.testing.assert_close(prior.encode(rgb), wanted)
    owner, method = prior.network()
    assert owner is marigold.unet and method == "forward" and prior.config is marigold.config
    assert (prior.max_steps, prior.deterministic, prior.depth_channels) == (None, False, slice(None))


@pytest.mark.parametrize("channels", [4, 16])
def test_what_is_guided_follows_the_image_latent(channels):
    pipe = SimpleNamespace(vae=SimpleNamespace(config=SimpleNamespace(latent_channels=channels)), config={})
    assert MarigoldPrior(pipe).network_input == slice(channels, None)


def test_the_space_of_a_folder_is_from_the_user_or_its_index_or_else_depth(marigold, tmp_path):
    marigold.save_pretrained(tmp_path)
    index_file = tmp_path / "model_index.json"
    index = json.loads(index_file.read_text())
    for said, given, space in (
        ("disparity", None, "disparity"),
        ("disparity", "log", "log"),
        (None, None, "depth"),
    ):
        index_file.write_text(json.dumps(index | {"prediction_type": said}))
        loaded = MarigoldPrior.load(Layout(tmp_path, "x"), torch.float16, given)
        assert type(loaded) is MarigoldDepthPipeline and loaded.dtype == torch.float16
        assert loaded.config.prediction_type == MarigoldPrior(loaded).space == space
    assert type(E2EFTPrior.load(Layout(tmp_path, "x"), torch.float32, None)) is E2EFTPipeline


def test_its_schedule_is_one_step_to_no_noise_with_the_betas_of_the_folder(tuned):
    betas = {"beta_start": 0.001, "beta_end": 0.02, "clip_sample": False}
    leading = DDIMScheduler(**betas, timestep_spacing="leading", set_alpha_to_one=False)
    pipe = E2EFTPipeline(**tuned.components | {"scheduler": leading})
    config = pipe.scheduler.config
    assert (config.timestep_spacing, config.set_alpha_to_one) == ("trailing", True)
    assert (config.beta_start, config.beta_end) == (0.001, 0.02)
    pipe.scheduler.set_timesteps(1)
    assert pipe.scheduler.timesteps.tolist() == [999] and float(pipe.scheduler.final_alpha_cumprod) == 1.0
    clean = torch.randn(1, 4, 3, 3, generator=seeded())
    alpha = pipe.scheduler.alphas_cumprod[999]
    noise = torch.randn(1, 4, 3, 3, generator=seeded(1))
    z = alpha.sqrt() * clean + (1 - alpha).sqrt() * noise
    torch.testing.assert_close(pipe.scheduler.step(noise, 999, z).prev_sample, clean, rtol=1e-3, atol=1e-3)


def test_it_starts_from_zeros_unless_it_is_given_latents(tuned):
    image = torch.rand(2, 3, 16, 16, generator=seeded()) * 2 - 1
    with torch.no_grad():
        image_latent, start = tuned.prepare_latents(image, None, seeded(), 2, 1)
        stock_image_latent, drawn = MarigoldDepthPipeline.prepare_latents(tuned, image, None, seeded(), 2, 1)
        given = torch.randn(start.shape, generator=seeded(3))
        _, kept = tuned.prepare_latents(image, given, None, 2, 1)
    assert torch.equal(image_latent, stock_image_latent) and start.shape == drawn.shape == (4, 4, 8, 8)
    assert drawn.any() and not start.any() and torch.equal(kept, given)


def test_more_steps_than_one_are_rejected_and_the_stock_checks_stay(tuned):
    image = np.zeros((32, 32, 3), np.float32)
    for steps in (2, 50):
        with pytest.raises(ValueError, match=f"num_inference_steps must be 1 with a prior .*; got {steps}"):
            tuned(image, num_inference_steps=steps)
    with pytest.raises(ValueError, match="ensemble_size"):
        tuned(image, num_inference_steps=1, ensemble_size=0)
    whole = tuned(image, num_inference_steps=1).prediction
    assert np.array_equal(whole, tuned(image).prediction) and whole.shape == (1, 32, 32, 1)


def test_its_options_are_those_of_marigold_and_are_saved_with_how_it_starts(tuned, tmp_path):
    reported = {"prediction_type": "disparity", "scale_invariant": False, "shift_invariant": True}
    reported |= {"default_denoising_steps": 1, "default_processing_resolution": 96}
    pipe = E2EFTPipeline(**tuned.components, **reported)
    assert {
        name: pipe.config[name] for name in reported
    } == reported and pipe.config.initial_latents == "zeros"
    assert (pipe.scale_invariant, pipe.shift_invariant, pipe.default_processing_resolution) == (
        False,
        True,
        96,
    )
    swapped = E2EFTPipeline(**tuned.components, scale_invariant=True, shift_invariant=False)
    assert (swapped.config.scale_invariant, swapped.config.shift_invariant) == (True, False)
    pipe.save_pretrained(tmp_path)
    loaded = E2EFTPrior.load(Layout(tmp_path, "x"), torch.float32, None)
    assert {name: loaded.config[name] for name in reported} == reported
    for name, part in pipe.components.items():
        if isinstance(part, torch.nn.Module):
            assert getattr(loaded, name) is not part and type(getattr(loaded, name)) is type(part)
    assert (E2EFTPrior.max_steps, E2EFTPrior.deterministic) == (1, True)


MARIGOLD = {"in_channels": 8, "out_channels": 4}
TRAILING = {"timestep_spacing": "trailing"}


@pytest.mark.parametrize(
    ("name", "unet", "schedule", "index", "expected"),
    [
        ("x", {}, TRAILING, {}, True),
        ("x", {}, TRAILING, {"default_denoising_steps": 1}, True),
        ("x", {}, TRAILING, {"default_denoising_steps": 4}, False),
        ("x", {}, TRAILING | {"rescale_betas_zero_snr": True}, {}, False),
        ("x", {}, TRAILING | {"original_inference_steps": 50}, {}, False),
        ("x", {}, {"timestep_spacing": "leading"}, {}, False),
        ("x", {}, {"timestep_spacing": "leading"}, {"initial_latents": "zeros"}, True),
        ("x", {}, {"timestep_spacing": "leading"}, {"initial_latents": "noise"}, False),
        ("me/Marigold-E2E-FT-Depth", {}, {}, {}, True),
        ("me/marigold-e2e-ft-depth", {"in_channels": 4}, TRAILING, {"initial_latents": "zeros"}, False),
    ],
)
def test_it_is_distinguished_from_marigold_by_its_schedule_start_or_name(
    tmp_path, name, unet, schedule, index, expected
):
    files = {
        "unet/config.json": MARIGOLD | unet,
        "scheduler/scheduler_config.json": schedule,
        "model_index.json": {"text_encoder": ["transformers", "CLIPTextModel"]} | index,
    }
    for path, content in files.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(json.dumps(content))
    assert E2EFTPrior.recognises(Layout(tmp_path, name)) is expected
    assert MarigoldPrior.recognises(Layout(tmp_path, name)) is (not unet)
