"""The shared denoising loop: batches, members, arguments, resizing, and helpers against NumPy."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, PNDMScheduler, UNet2DConditionModel
from diffusers.models.attention_processor import AttnProcessor
from safetensors.torch import load_file, save_file

from geodiff_plugin.priors import pipeline as module
from geodiff_plugin.priors.components import DirectScheduler, ResizeToMultiple
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline
from geodiff_plugin.priors.geowizard import GeoWizardPipeline, closest_to_mean
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.lotus import LotusPipeline, space_of_name
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline, DirectMapPipeline
from geodiff_plugin.priors.ppd import AreaImageProcessor
from tests.contracts.tiny_priors import make_depthfm, make_depthmaster, make_geowizard, make_lotus, quiet
from tests.tiny import make_unet, make_vae


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def test_images_and_maps_are_inverse():
    maps = torch.rand(2, 1, 5, 6)
    rgb = module.image_of_map(maps)
    assert rgb.shape == (2, 3, 5, 6)
    torch.testing.assert_close(rgb, (2 * maps - 1).repeat(1, 3, 1, 1))
    torch.testing.assert_close(module.map_of(rgb), maps)
    colours = torch.rand(2, 3, 5, 6)
    torch.testing.assert_close(module.map_of(colours)[:, 0], (colours.mean(1) + 1) / 2)


def test_maps_are_stretched_one_by_one():
    maps = torch.rand(3, 1, 5, 6) * torch.tensor([1.0, 5.0, 9.0]).view(3, 1, 1, 1) - 2
    for given, found in zip(maps, module.normalized(maps), strict=True):
        torch.testing.assert_close(found, (given - given.min()) / (given.max() - given.min()))
    assert not module.normalized(torch.full((1, 1, 2, 2), 3.0)).any()


def test_half_precision_is_widened_and_wider_types_stay():
    kinds = {torch.float16: torch.float32, torch.bfloat16: torch.float32, torch.float32: torch.float32}
    for given, wanted in (kinds | {torch.float64: torch.float64}).items():
        assert module.upcast(torch.zeros(2, dtype=given)).dtype == wanted


def test_latents_are_scaled_on_the_way_in_and_out():
    vae, rgb = make_vae().eval(), torch.rand(2, 3, 16, 24) * 2 - 1
    with torch.no_grad():
        latents = module.encode_image(vae, rgb)
        mean = vae.encode(rgb).latent_dist.parameters.chunk(2, dim=1)[0]
        torch.testing.assert_close(latents, 0.5 * mean)
        torch.testing.assert_close(module.decode_image(vae, latents), vae.decode(mean).sample)
        assert module.encode_image(vae.half(), rgb).dtype == torch.float32
        assert module.decode_image(vae, latents).dtype == torch.float32
    other = SimpleNamespace(dtype=torch.float32, config=SimpleNamespace(scaling_factor=3.0))
    other.encode = lambda x: SimpleNamespace(latents=x + 1)
    torch.testing.assert_close(module.encode_image(other, rgb), 3 * (rgb + 1))


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
        ValueError, match=r"arguments of this prior must be among \['bonus'\]; got \['malus', 'more'\]"
    ):
        loop(images(1), bonus=0.5, more=1, malus=2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ({"num_inference_steps": 51}, "num_inference_steps must be between 1 and 50; got 51"),
        *(
            ({name: 1.5}, f"{name} must be an integer; got float")
            for name in ("num_inference_steps", "processing_resolution", "ensemble_size", "batch_size")
        ),
        ({"num_inference_steps": 0}, "num_inference_steps"),
        ({"processing_resolution": -1}, "processing_resolution must be between 0 and 65536; got -1"),
        ({"ensemble_size": 0}, "ensemble_size must be between 1 and 1048576; got 0"),
        ({"output_uncertainty": True}, "ensemble_size must be between 2 and 1048576; got 1"),
        ({"batch_size": 0}, "batch_size must be between 1 and 1048576; got 0"),
        ({"output_type": "pil"}, "output_type must be one of"),
        ({"resample_method_input": "cubic"}, "resample_method_input must be one of"),
        ({"resample_method_output": "cubic"}, "resample_method_output must be one of"),
        (
            {"latents": torch.zeros(1, 1, 48, 48)},
            r"latents must be of shape \(1, 1, 48, 64\); got shape \(1, 1, 48, 48\)",
        ),
        (
            {"latents": torch.zeros(1, 1, 48, 64), "generator": torch.Generator()},
            "latents and generator must be passed one",
        ),
        ({"latents": [1]}, "latents must be None or a torch.Tensor"),
    ],
)
def test_arguments_are_rejected_by_name(loop, call, words):
    with pytest.raises((TypeError, ValueError), match=words):
        loop(images(1), **call)


def test_defaults_of_the_prior_hold_for_what_is_left_out(loop):
    assert loop._steps_and_resolution(None, None) == (3, 0) and loop._steps_and_resolution(7, 64) == (7, 64)
    other = Loop(DirectScheduler(), "log", 1, 640)
    assert other._steps_and_resolution(None, None) == (1, 640) and other.space == "log"
    assert (other.config.default_denoising_steps, other.config.default_processing_resolution) == (1, 640)
    loop.max_steps = None
    assert loop._steps_and_resolution(1000, None)[0] == 1000
    with pytest.raises(ValueError, match="num_inference_steps must be between 1 and 1000; got 1001"):
        loop._steps_and_resolution(1001, None)
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
    rgb = torch.rand(3, 3, 16, 24) * 2 - 1
    latents = DepthDiffusionPipeline.image_latents
    with torch.no_grad():
        mode = latents(pipe, rgb, 2, 2)
        moments = vae.encode(rgb).latent_dist.parameters
        mean, log_variance = moments.repeat_interleave(2, 0).chunk(2, 1)
        torch.testing.assert_close(mode, 0.5 * mean)
        drawn = latents(pipe, rgb, 2, 2, torch.Generator().manual_seed(5), True)
        noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(5))
        torch.testing.assert_close(drawn, 0.5 * (mean + (0.5 * log_variance).exp() * noise))


class Extras(Loop):
    """Also has a map of which half of the padded grid a pixel is in."""

    def decode_extras(self, latents, ensemble_size):
        self.asked = latents, ensemble_size
        halves = (torch.arange(64) >= 32).float().expand(1, 2, 48, 64)
        return {"halves": halves.repeat(len(latents) // ensemble_size, 1, 1, 1)}


def test_further_maps_are_unpadded_and_brought_to_the_image_without_mixing_values():
    pipe = Extras(DDIMScheduler(prediction_type="sample", clip_sample=False, timestep_spacing="trailing"))
    pipe.set_progress_bar_config(disable=True)
    freed = []
    pipe.maybe_free_model_hooks = lambda: freed.append(True)
    found = pipe(images(2), ensemble_size=2, output_latent=True, processing_resolution=50)
    halves = found.extras["halves"]
    assert halves.shape == (2, 37, 50, 2) and set(np.unique(halves)) == {0.0, 1.0}
    np.testing.assert_array_equal(halves[1, :, :, 0], np.broadcast_to(np.arange(50) >= 32, (37, 50)))
    assert torch.equal(pipe.asked[0], found.latent) and pipe.asked[1] == 2 and freed == [True]
    tensor = pipe(images(1), output_type="pt", return_dict=False, output_latent=True)
    assert tensor[0].shape == (1, 1, 37, 50) and tensor[1] is None and tensor[2].shape == (1, 1, 48, 64)


class Recording(DirectScheduler):
    """Which generators and answers it is given."""

    def step(self, model_output, timestep, sample, generator=None, return_dict=True):
        self.given.append((model_output, int(timestep), sample, generator))
        return super().step(model_output, timestep, sample, generator, return_dict)


def test_every_step_gets_the_output_its_timestep_the_latents_and_the_generator():
    scheduler = Recording(timestep=5)
    scheduler.given = []
    pipe = Loop(scheduler, "depth", 1, 0)
    pipe.set_progress_bar_config(disable=True)
    generator = torch.Generator().manual_seed(1)
    found = pipe(images(1), generator=generator, output_latent=True)
    ((answer, time, sample, reported),) = scheduler.given
    assert torch.equal(answer, found.latent) and time == 5 and reported is generator
    assert torch.equal(sample, torch.randn(sample.shape, generator=torch.Generator().manual_seed(1)))
    condition = pipe.prepare_condition(pipe.image_processor.preprocess(images(1), 0)[0], 1, 1, None)
    torch.testing.assert_close(answer, pipe.denoise(sample, 5, condition))


def test_given_latents_are_taken_in_the_type_of_those_that_would_be_drawn(loop):
    latents = torch.zeros(1, 1, 48, 64, dtype=torch.float64)
    found = loop(images(1), latents=latents, num_inference_steps=1, output_latent=True).latent
    assert found.dtype == torch.float32


def test_a_prompt_is_not_padded_but_cut_and_is_one_for_all():
    asked = []

    def tokenizer(words, **reported):
        asked.append((words, reported))
        return SimpleNamespace(input_ids=torch.tensor([[1, 2, 3]]))

    tokenizer.model_max_length = 11
    pipe = SimpleNamespace(
        tokenizer=tokenizer, text_encoder=lambda ids: (ids[..., None].double().expand(1, 3, 4), 0)
    )
    found = DepthDiffusionPipeline.prompt_embedding(pipe, torch.zeros(5, 1, dtype=torch.float16))
    assert found.shape == (5, 3, 4) and found.dtype == torch.float16 and found[4, :, 0].tolist() == [1, 2, 3]
    DepthDiffusionPipeline.prompt_embedding(pipe, torch.zeros(1), "some words")
    reported = {"max_length": 11, "truncation": True, "return_tensors": "pt"}
    assert asked == [("", reported), ("some words", reported)]


def test_the_network_is_given_the_prompt_and_labels_if_there_are_any():
    asked = []
    pipe = SimpleNamespace(
        unet=lambda *given, **reported: asked.append((given, reported)) or ("answer", "more")
    )
    for condition in ({"prompt": "p"}, {"prompt": "p", "class_labels": "c", "other": 1}):
        assert DepthDiffusionPipeline.run_unet(pipe, "sample", "time", condition) == "answer"
        labels = condition.get("class_labels")
        reported = {"encoder_hidden_states": "p", "class_labels": labels, "return_dict": False}
        assert asked.pop() == (("sample", "time"), reported)


def test_images_are_encoded_and_scaled_by_the_pipelines_own_vae():
    vae = make_vae().eval()
    pipe, rgb = SimpleNamespace(vae=vae), torch.rand(2, 3, 16, 24) * 2 - 1
    own = DepthDiffusionPipeline
    with torch.no_grad():
        moments = own.encode_moments(pipe, rgb)
        assert torch.equal(moments, vae.encode(rgb).latent_dist.parameters)
        assert torch.equal(own.scale_latents(pipe, moments), 0.5 * moments)
        assert torch.equal(own.encode_image(pipe, rgb), module.encode_image(vae, rgb))
        z = torch.randn(2, 4, 4, 6)
        assert torch.equal(own.decode_image(pipe, z), module.decode_image(vae, z))
        pipe.decode_image, pipe.encode_image = (
            lambda z: own.decode_image(pipe, z),
            lambda p: own.encode_image(pipe, p),
        )
        assert torch.equal(own.decode(pipe, z), module.map_of(module.decode_image(vae, z)))
        x = torch.rand(2, 1, 8, 8)
        assert torch.equal(own.encode(pipe, x), module.encode_image(vae, module.image_of_map(x)))


def test_plain_maps_are_of_the_depth_channels_and_clipped():
    z = torch.linspace(-1, 2, 24).view(1, 4, 2, 3)
    pipe = SimpleNamespace(depth_channels=slice(1, 2), decode=lambda latents: latents)
    found = DepthDiffusionPipeline.decode_prediction(pipe, z)
    np.testing.assert_allclose(found, np.clip(z.numpy()[:, 1:2], 0, 1))


def test_members_of_every_image_are_put_together_by_the_stock_ensembling(loop):
    maps = torch.rand(6, 1, 5, 7)
    depth, spread = loop.combine_members(maps, 3, True, {"reduction": "mean"})
    for i in range(2):
        theirs = loop.ensemble_depth(maps[3 * i : 3 * i + 3], True, True, True, reduction="mean")
        torch.testing.assert_close((depth[i : i + 1], spread[i : i + 1]), theirs)
    assert loop.combine_members(maps, 1, False, {}) == (maps, None)
    assert loop.combine_members(maps, 3, False, {})[1] is None


def test_an_interface_without_an_implementation_raises():
    bare = module.DepthPrior()
    bare.config = {}
    assert bare.space == "depth" and not module.DepthPrior.recognises(None)
    for call in (
        lambda: bare.network_input,
        bare.network,
        lambda: bare.decode(None),
        lambda: bare.encode(None),
    ):
        with pytest.raises(NotImplementedError):
            call()
    everywhere = bare.maps_of(slice(0, 2))
    assert (everywhere.valid, everywhere.depth_range) == (None, None)
    assert DepthDiffusionPipeline.decode_extras(None, None, 1) == {}


def test_a_call_keeps_no_graph_of_its_networks(loop):
    gain = torch.nn.Parameter(torch.ones(1))
    own, loop.denoise = loop.denoise, lambda *given: gain * own(*given)
    found = loop(images(1), output_latent=True, output_type="pt")
    assert not found.latent.requires_grad and not found.prediction.requires_grad


IMAGE = np.random.default_rng(0).random((44, 60, 3)).astype(np.float32)


def seeded_of_prior_pipelines(seed=0):
    return torch.Generator().manual_seed(seed)


def load(adapter, folder, name="x", space=None):
    return quiet(adapter.load(Layout(folder, name), torch.float32, space))


@pytest.mark.parametrize(
    ("processor", "size", "resolution", "grid"),
    [
        (ResizeToMultiple(64), (375, 1242), 768, (256, 768)),  # 231 is nearer to 256
        (
            ResizeToMultiple(64),
            (96, 160),
            0,
            (128, 128),
        ),  # 1.5 and 2.5 round to the even number, as in Python
        (ResizeToMultiple(64), (20, 300), 256, (64, 256)),  # never less than one
        (ResizeToMultiple(16, grow=True), (60, 98), 64, (48, 64)),
        (ResizeToMultiple(16, grow=True), (5, 9), 0, (16, 16)),
        (
            ResizeToMultiple(1),
            (8, 1226),
            768,
            (5, 767),
        ),  # a float product cut to an integer, as Lotus's authors do
        (AreaImageProcessor(vae_scale_factor=16), (75, 113), 128, (96, 144)),
        (AreaImageProcessor(vae_scale_factor=16), (20, 300), 128, (32, 432)),
        (AreaImageProcessor(vae_scale_factor=16), (400, 300), 128, (128, 96)),
    ],
)
def test_sides_of_the_processed_image(processor, size, resolution, grid):
    image, padding, native = processor.preprocess(torch.rand(1, 3, *size), resolution)
    assert (tuple(image.shape[-2:]), padding, tuple(native)) == (grid, (0, 0), size)
    assert -1 <= image.min() < -0.5 and 0.5 < image.max() <= 1
    fitting = torch.rand(1, 3, 64, 128)
    assert torch.equal(processor.preprocess(fitting, 0)[0], fitting * 2 - 1)


@pytest.mark.parametrize("make", [make_geowizard, make_depthfm])
def test_a_batch_gives_every_member_what_it_gets_alone(make):
    pipe = make()
    options = {"ensemble_size": 2, "num_inference_steps": 1, "output_latent": True}
    drawn = pipe(IMAGE, generator=seeded_of_prior_pipelines(), **options).latent
    images, latents = (
        [IMAGE, IMAGE[:, ::-1].copy()],
        torch.randn(4, *drawn.shape[1:], generator=seeded_of_prior_pipelines()),
    )
    both = pipe(images, latents=latents, batch_size=3, **options).latent
    alone = [
        pipe(x, latents=latents[i : i + 2], **options).latent for x, i in zip(images, (0, 2), strict=True)
    ]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("version", [1, 2])
def test_folders_as_geowizards_scripts_read_them(version, tmp_path):
    """Whose index names classes that are not ours to load, or that have none."""
    saved, index = make_geowizard(version), tmp_path / "model_index.json"
    saved.save_pretrained(tmp_path)
    if version == 2:
        (tmp_path / "unet").rename(tmp_path / "unet_v2")
        index.unlink()
    else:
        unet = ["models.unet_2d_condition", "UNet2DConditionModel"]
        index.write_text(json.dumps({"_class_name": "Anything", "unet": unet}))
    assert GeoWizardPipeline.recognises(Layout(tmp_path, "x"))
    call = {"num_inference_steps": 2, "processing_resolution": 64}
    maps = (
        p(IMAGE, generator=seeded_of_prior_pipelines(), **call).prediction
        for p in (load(GeoWizardPipeline, tmp_path), saved)
    )
    np.testing.assert_array_equal(*maps)


def as_lotus_authors(pipe, folder) -> None:
    """Rewrite a saved folder as diffusers 0.28 and transformers 4.40 wrote the authors'."""
    pipe.save_pretrained(folder)
    PNDMScheduler(steps_offset=1, skip_prk_steps=True).save_pretrained(folder / "scheduler")
    index = json.loads((folder / "model_index.json").read_text())
    for name in ("prediction_type", "default_denoising_steps", "default_processing_resolution"):
        del index[name]
    index |= {name: [None, None] for name in ("feature_extractor", "image_encoder", "safety_checker")}
    index |= {"_class_name": "LotusGPipeline", "_diffusers_version": "0.28.0"}
    index |= {"scheduler": ["diffusers", "PNDMScheduler"], "requires_safety_checker": False}
    (folder / "model_index.json").write_text(json.dumps(index))
    weights = folder / "text_encoder" / "model.safetensors"
    prefixed = {f"text_model.{k.removeprefix('text_model.')}": v for k, v in load_file(weights).items()}
    save_file(prefixed, weights, metadata={"format": "pt"})


@pytest.mark.parametrize("kind", ["g", "d"])
def test_folders_as_lotus_authors_wrote_them(kind, tmp_path):
    pipe, folder = make_lotus(kind), tmp_path / f"lotus-depth-{kind}-v1-0"
    as_lotus_authors(pipe, folder)
    assert LotusPipeline.recognises(Layout(folder, str(folder)))
    loaded = load(LotusPipeline, folder, str(folder))
    assert loaded.config.prediction_type == "depth"
    maps = [
        p(IMAGE, processing_resolution=64, generator=seeded_of_prior_pipelines()).prediction
        for p in (pipe, loaded)
    ]
    np.testing.assert_allclose(*maps, rtol=0, atol=1e-5)
    assert load(LotusPipeline, folder, "x", "disparity").space == "disparity"
    plain = LotusPipeline.from_pretrained(folder, prediction_type="depth", local_files_only=True)
    assert plain.scheduler.config.timestep == 999


def test_the_name_of_a_lotus_sets_its_space():
    assert space_of_name("hub/lotus-depth-d-v1-0") == space_of_name("/disparity/lotus-depth-d") == "depth"
    assert space_of_name("models--jingheya--lotus-depth-g-v2-1-disparity/snapshots/1a2b") == "disparity"
    for name in ("checkpoints/lotus", "some-disparity-model"):
        with pytest.raises(ValueError, match="--space"):
            space_of_name(name)


def test_related_priors_are_distinguished(tmp_path):
    for options, sentence in (({"prediction_type": "depth"}, "class embedding"), ({}, "disparity versions")):
        with pytest.raises(ValueError, match=sentence):
            LotusPipeline(make_unet(), None, None, None, None, **options)
    make_geowizard(2).save_pretrained(tmp_path / "2")
    index_of_2 = tmp_path / "2" / "model_index.json"
    index = json.loads(index_of_2.read_text())
    index.pop("default_domain")  # what is left is the layout of a Lotus-G
    index_of_2.write_text(json.dumps(index))
    assert not GeoWizardPipeline.recognises(Layout(tmp_path / "2", "lotus"))
    folder = tmp_path / "master"
    make_depthmaster().save_pretrained(folder)
    index, config = (folder / "model_index.json").read_text(), folder / "unet" / "config.json"
    with_schedule = json.loads(index) | {"scheduler": ["diffusers", "DDIMScheduler"]}
    (folder / "model_index.json").write_text(json.dumps(with_schedule))
    assert not DepthMasterPipeline.recognises(Layout(folder, "stable diffusion"))
    (folder / "model_index.json").write_text(index)
    UNet2DConditionModel.from_config(json.loads(config.read_text())).save_pretrained(folder / "unet")
    with pytest.raises(ValueError, match=r"missing: fftblock\.conv_f1\.bias"):
        load(DepthMasterPipeline, folder)
    config.write_text(json.dumps(json.loads(config.read_text()) | {"class_embed_type": "projection"}))
    assert not DepthMasterPipeline.recognises(Layout(folder, "lotus d"))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: make_depthfm(noising_step=1000), "noising_step"),
        (lambda: DirectScheduler().set_timesteps(4), "num_inference_steps must be 1"),
        (lambda: make_depthfm()(IMAGE, ensemble_size=1, output_uncertainty=True), "ensemble_size must be"),
        (lambda: make_geowizard()(IMAGE, domain="underwater"), "domain must be one of"),
        (lambda: make_depthmaster()(IMAGE, latents=torch.zeros(1, 4, 2, 2)), "latents must be of shape"),
    ],
)
def test_arguments_out_of_range_are_named(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()


def test_geowizards_parts_domain_and_attention():
    one, two = make_geowizard(1), make_geowizard(2)
    with pytest.raises(ValueError, match="image_encoder"):
        GeoWizardPipeline(unet=one.unet, vae=one.vae, scheduler=one.scheduler, text_encoder=two.text_encoder)
    with pytest.raises(ValueError, match="text_encoder.*tokenizer"):
        GeoWizardPipeline(unet=two.unet, vae=two.vae, scheduler=two.scheduler)
    for pipe in (one, two):
        default, indoor, outdoor = (
            pipe(IMAGE, generator=seeded_of_prior_pipelines(), **reported).prediction
            for reported in ({}, {"domain": "indoor"}, {"domain": "outdoor"})
        )
        assert np.array_equal(default, indoor) and np.abs(indoor - outdoor).max() > 1e-4
        pipe.unet.set_attn_processor(AttnProcessor())  # under which depth and normals do not see each other
        np.testing.assert_allclose(
            pipe(IMAGE, generator=seeded_of_prior_pipelines()).prediction, default, atol=1e-5
        )


def test_geowizards_normals_are_unit_vectors_of_one_member():
    pipe = make_geowizard(2)
    drawn = pipe.prepare_latents({"image_latent": torch.zeros(2, 4, 6, 8)}, seeded_of_prior_pipelines())
    depth, normals = drawn.chunk(2, dim=1)
    assert torch.equal(depth, normals) and not torch.equal(depth[0], depth[1])
    output = pipe(
        IMAGE,
        ensemble_size=3,
        output_latent=True,
        generator=seeded_of_prior_pipelines(),
        processing_resolution=0,
    )
    normals = output.extras["normals"]
    assert normals.shape == (1, 44, 60, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-2)
    towards = torch.tensor([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [1.0, 0.0, 0.0]])
    vectors = torch.nn.functional.normalize(towards, dim=1)[:, :, None, None].expand(3, 3, 4, 5)
    assert torch.equal(closest_to_mean(vectors)[0], vectors[1])
