"""The shared denoising loop: batches, members, arguments, resizing, and helpers against NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler

from geodiff_plugin.priors import pipeline as module
from geodiff_plugin.priors.components import DirectScheduler, FixedPrompt, SidesOf
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline, DirectMapPipeline
from tests.tiny import make_vae


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def test_pictures_and_maps_are_inverse():
    maps = torch.rand(2, 1, 5, 6)
    picture = module.picture_of(maps)
    assert picture.shape == (2, 3, 5, 6)
    torch.testing.assert_close(picture, (2 * maps - 1).repeat(1, 3, 1, 1))
    torch.testing.assert_close(module.map_of(picture), maps)
    colours = torch.rand(2, 3, 5, 6)
    torch.testing.assert_close(module.map_of(colours)[:, 0], (colours.mean(1) + 1) / 2)


def test_maps_are_stretched_one_by_one():
    maps = torch.rand(3, 1, 5, 6) * torch.tensor([1.0, 5.0, 9.0]).view(3, 1, 1, 1) - 2
    for given, found in zip(maps, module.stretched(maps), strict=True):
        torch.testing.assert_close(found, (given - given.min()) / (given.max() - given.min()))
    assert not module.stretched(torch.full((1, 1, 2, 2), 3.0)).any()


def test_half_precision_is_widened_and_wider_types_stay():
    kinds = {torch.float16: torch.float32, torch.bfloat16: torch.float32, torch.float32: torch.float32}
    for given, wanted in (kinds | {torch.float64: torch.float64}).items():
        assert module.widened(torch.zeros(2, dtype=given)).dtype == wanted


def test_latents_are_scaled_on_the_way_in_and_out():
    vae, picture = make_vae().eval(), torch.rand(2, 3, 16, 24) * 2 - 1
    with torch.no_grad():
        latents = module.encode_picture(vae, picture)
        mean = vae.encode(picture).latent_dist.parameters.chunk(2, dim=1)[0]
        torch.testing.assert_close(latents, 0.5 * mean)
        torch.testing.assert_close(module.decode_picture(vae, latents), vae.decode(mean).sample)
        assert module.encode_picture(vae.half(), picture).dtype == torch.float32
        assert module.decode_picture(vae, latents).dtype == torch.float32
    other = SimpleNamespace(dtype=torch.float32, config=SimpleNamespace(scaling_factor=3.0))
    other.encode = lambda x: SimpleNamespace(latents=x + 1)
    torch.testing.assert_close(module.encode_picture(other, picture), 3 * (picture + 1))


class Loop(DepthDiffusionPipeline):
    """Latents are the map; every step adds the image's mean, its member's draw and the step's number."""

    max_steps = 50

    def __init__(
        self, scheduler, prediction_type="depth", default_denoising_steps=3, default_processing_resolution=0
    ):
        super().__init__()
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        self.register_prior({"scheduler": scheduler}, *defaults, image_processor=16)
        self.seen = []

    @property
    def device(self):
        return torch.device("cpu")

    @property
    def dtype(self):
        return torch.float32

    _execution_device = device

    def prepare_condition(self, image, ensemble_size, batch_size, generator, bonus=0.0):
        self.seen.append(("condition", tuple(image.shape), ensemble_size, batch_size, bonus))
        return {"image_latent": image.mean(1, keepdim=True).repeat_interleave(ensemble_size, 0) + bonus}

    def denoise(self, latents, timestep, condition):
        self.seen.append((int(timestep), len(latents), len(condition["image_latent"])))
        return condition["image_latent"] / 4 + 0.5 + 0.01 * latents

    def decode(self, z0):
        return z0

    def encode(self, x):
        return x


@pytest.fixture
def loop():
    pipe = Loop(DDIMScheduler(prediction_type="sample", clip_sample=False, timestep_spacing="trailing"))
    pipe.set_progress_bar_config(disable=True)
    return pipe


def images(count, size=(37, 50)):
    return torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(0))


def test_batches_of_members_give_what_each_gives_alone(loop):
    given, latents = images(3), torch.randn(6, 1, 48, 64, generator=torch.Generator().manual_seed(1))
    call = {"ensemble_size": 2, "output_latent": True, "output_type": "pt"}
    whole = loop(given, latents=latents, batch_size=4, **call)
    assert loop.seen[0] == ("condition", (3, 3, 48, 64), 2, 4, 0.0)
    assert [seen[1:] for seen in loop.seen[1:]] == [(4, 4)] * 3 + [(2, 2)] * 3
    assert [seen[0] for seen in loop.seen[1:4]] == [seen[0] for seen in loop.seen[4:]] == [999, 666, 332]
    assert whole.prediction.shape == (3, 1, 37, 50) and whole.latent.shape == (6, 1, 48, 64)
    for i in range(3):
        alone = loop(given[i : i + 1], latents=latents[2 * i : 2 * i + 2], **call)
        torch.testing.assert_close(whole.latent[2 * i : 2 * i + 2], alone.latent)
        torch.testing.assert_close(whole.prediction[i : i + 1], alone.prediction, atol=1e-4, rtol=1e-4)
    seeded = [loop(given, generator=torch.Generator().manual_seed(s), **call).latent for s in (3, 3, 4)]
    assert torch.equal(seeded[0], seeded[1]) and not torch.equal(seeded[0], seeded[2])
    assert not torch.equal(seeded[0][0], seeded[0][1])


def test_the_map_is_unpadded_and_brought_to_the_image(loop):
    given = images(1)
    latents = torch.zeros(1, 1, 48, 64)
    call = {"latents": latents, "num_inference_steps": 1}
    found = loop(given, **call)
    # One step from 0: a quarter of the mean of the image in [-1, 1], and a half.
    wanted = (given * 2 - 1).mean(1)[0] / 4 + 0.5
    np.testing.assert_allclose(found.prediction[0, ..., 0], wanted, atol=2e-3)
    assert found.uncertainty is None and found.latent is None and found.extras == {}
    small = loop(
        given,
        latents=latents[..., :32, :32],
        num_inference_steps=1,
        processing_resolution=25,
        match_input_resolution=False,
    )
    assert small.prediction.shape == (1, 18, 25, 1)
    loop.output_resampling = "nearest-exact"
    call = {"latents": latents[..., :32, :32], "num_inference_steps": 1, "processing_resolution": 25}
    coarse, smooth = loop(given, **call), loop(given, **call, resample_method_output="bilinear")
    assert len(np.unique(coarse.prediction[0, 0])) <= 25 < len(np.unique(smooth.prediction[0, 0]))
    assert isinstance(loop(given, **call, return_dict=False), tuple)


def test_the_spread_of_members_is_given_where_it_is_asked_for(loop):
    latents = torch.randn(4, 1, 48, 64, generator=torch.Generator().manual_seed(1))
    call = {"latents": latents, "ensemble_size": 4, "output_type": "pt"}
    without, spread = loop(images(1), **call), loop(images(1), **call, output_uncertainty=True)
    assert without.uncertainty is None and spread.uncertainty.shape == (1, 1, 37, 50)
    torch.testing.assert_close(without.prediction, spread.prediction)
    mean = loop(images(1), **call, ensembling_kwargs={"reduction": "mean"})
    assert not torch.equal(mean.prediction, without.prediction)


def test_further_arguments_are_those_of_the_prior(loop):
    assert loop.call_options() == ["bonus"]
    loop(images(1), bonus=0.5, num_inference_steps=1)
    assert loop.seen[0][-1] == 0.5
    with pytest.raises(
        ValueError, match=r"arguments of this prior must be out of \['bonus'\]; got \['malus', 'more'\]"
    ):
        loop(images(1), bonus=0.5, more=1, malus=2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ({"num_inference_steps": 51}, "num_inference_steps must be .* 1 .* 50"),
        ({"num_inference_steps": 0}, "num_inference_steps"),
        ({"processing_resolution": -1}, "processing_resolution"),
        ({"ensemble_size": 0}, "ensemble_size"),
        ({"output_uncertainty": True}, "ensemble_size must be .* 2"),
        ({"batch_size": 0}, "batch_size"),
        ({"output_type": "pil"}, "output_type must be one of"),
        ({"resample_method_input": "cubic"}, "resample_method_input must be one of"),
        ({"resample_method_output": "cubic"}, "resample_method_output must be one of"),
        (
            {"latents": torch.zeros(1, 1, 48, 48)},
            r"latents must be of shape \(1, 1, 48, 64\); got shape \(1, 1, 48, 48\)",
        ),
        (
            {"latents": torch.zeros(1, 1, 48, 64), "generator": torch.Generator()},
            "latents and generator must be given one",
        ),
        ({"latents": [1]}, "latents must be None or a torch.Tensor"),
    ],
)
def test_arguments_are_refused_by_name(loop, call, words):
    with pytest.raises((TypeError, ValueError), match=words):
        loop(images(1), **call)


def test_defaults_of_the_prior_hold_for_what_is_left_out(loop):
    assert loop._steps_and_resolution(None, None) == (3, 0) and loop._steps_and_resolution(7, 64) == (7, 64)
    other = Loop(DirectScheduler(), "log", 1, 640)
    assert other._steps_and_resolution(None, None) == (1, 640) and other.space == "log"
    assert (other.config.default_denoising_steps, other.config.default_processing_resolution) == (1, 640)
    loop.max_steps = None
    assert loop._steps_and_resolution(1000, None)[0] == 1000
    assert loop.image_processor.config.vae_scale_factor == 16
    assert loop.network_input == slice(None) and loop.network() == (loop, "denoise")
    loop.sees_latents = False
    assert (
        loop.network_input is None
        and not loop.prepare_latents({"image_latent": torch.ones(2, 1, 3, 3)}, None).any()
    )
    loop.register_to_config(prediction_type=None)
    assert loop.space == "depth"
    loop.register_to_config(prediction_type="metres")
    with pytest.raises(ValueError, match="prediction_type must be one of"):
        _ = loop.space


def test_what_is_known_of_samples_is_cut_out_for_them(loop):
    valid = torch.rand(4, 1, 3, 3) > 0.5
    loop.valid, loop.metric_range = valid, torch.tensor([[1.0, 5.0], [6.0, 2.0], [3.0, 4.0], [9.0, 8.0]])
    maps = loop.maps_of(slice(1, 3))
    assert maps.space == "depth" and torch.equal(maps.valid, valid[1:3])
    depth_range = maps.depth_range
    assert (depth_range.near_m.tolist(), depth_range.far_m.tolist()) == ([2.0, 3.0], [6.0, 4.0])
    assert depth_range.on_edge is None


def test_a_map_is_its_own_latent_whatever_the_latents_are():
    maps = torch.rand(2, 1, 4, 5)
    pipe = SimpleNamespace()
    assert DirectMapPipeline.denoise(pipe, torch.zeros(2, 1, 4, 5), None, {"image_latent": maps}) is maps
    assert DirectMapPipeline.decode(pipe, maps) is maps and DirectMapPipeline.encode(pipe, maps) is maps
    assert DirectMapPipeline.max_steps == 1 and DirectMapPipeline.deterministic


def test_posteriors_are_drawn_once_a_member_or_their_mode_is_taken():
    vae = make_vae().eval()
    pipe = SimpleNamespace(
        vae=vae,
        encode_moments=lambda x: vae.encode(x).latent_dist.parameters,
        scale_latents=lambda z: 0.5 * z,
    )
    picture = torch.rand(3, 3, 16, 24) * 2 - 1
    latents = DepthDiffusionPipeline.image_latents
    with torch.no_grad():
        mode = latents(pipe, picture, 2, 2)
        moments = vae.encode(picture).latent_dist.parameters
        mean, log_variance = moments.repeat_interleave(2, 0).chunk(2, 1)
        torch.testing.assert_close(mode, 0.5 * mean)
        drawn = latents(pipe, picture, 2, 2, torch.Generator().manual_seed(5), True)
        noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(5))
        torch.testing.assert_close(drawn, 0.5 * (mean + (0.5 * log_variance).exp() * noise))


def test_a_direct_schedule_has_one_step_whose_result_is_the_output():
    scheduler = DirectScheduler(timestep=7)
    assert scheduler.timesteps.tolist() == [7] and DirectScheduler().timesteps.tolist() == [999]
    output, sample = torch.rand(1, 1, 2, 2), torch.rand(1, 1, 2, 2)
    assert scheduler.step(output, 7, sample).prev_sample is output
    assert scheduler.step(output, 7, sample, return_dict=False) == (output,)
    with pytest.raises(ValueError, match="num_inference_steps must be 1"):
        scheduler.set_timesteps(2)
    assert (
        scheduler.order == 1
        and scheduler.init_noise_sigma == 1.0
        and scheduler.config.prediction_type == "sample"
    )


def test_sides_are_multiples_the_next_or_the_nearest():
    grow, nearest = SidesOf(16, grow=True), SidesOf(16)
    lengths = (1, 15, 16, 17, 23, 25, 40, 41)
    assert [grow._multiple(n) for n in lengths] == [16, 16, 16, 32, 32, 32, 48, 48]
    assert [nearest._multiple(n) for n in lengths] == [16, 16, 16, 16, 16, 32, 32, 48]
    assert grow._multiple(16.4) == 16 and grow._multiple(16.6) == 32
    image, padding, size = grow.preprocess(torch.rand(1, 3, 30, 50), 0, dtype=torch.float16)
    assert (image.shape, padding, tuple(size), image.dtype) == (
        (1, 3, 32, 64),
        (0, 0),
        (30, 50),
        torch.float16,
    )


def test_a_fixed_prompt_is_what_was_saved(tmp_path):
    prompt = FixedPrompt(3, 5)
    assert prompt().shape == (1, 3, 5) and not prompt().any() and not prompt.embedding.requires_grad
    prompt.load_state_dict({"embedding": torch.rand(1, 3, 5)})
    prompt.save_pretrained(tmp_path)
    assert torch.equal(FixedPrompt.from_pretrained(tmp_path)(), prompt())
    assert FixedPrompt()().shape == (1, 77, 1024)
