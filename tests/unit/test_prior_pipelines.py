"""What each prior's own pipeline does beside its parity: grids, schedules, draws, folders, endings."""

from __future__ import annotations

import copy
import json
import math

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, PNDMScheduler, UNet2DConditionModel
from diffusers.models.attention_processor import AttnProcessor
from PIL import Image
from safetensors.torch import load_file, save_file

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.algorithm.denoising import noise_from, output_from, z0_from
from geodiff_plugin.algorithm.gradients import RULES, Plain
from geodiff_plugin.algorithm.schedule import count_steps
from geodiff_plugin.priors.components import DirectScheduler, SidesOf
from geodiff_plugin.priors.depthfm import cosine_alpha_bar
from geodiff_plugin.priors.depthmaster import DepthMasterPrior, FourierBlock
from geodiff_plugin.priors.geowizard import (
    GeoWizardPipeline,
    GeoWizardPrior,
    class_embedding,
    closest_to_mean,
)
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.lotus import LotusImageProcessor, LotusPipeline, LotusPrior, space_of_name
from geodiff_plugin.priors.ppd import AreaImageProcessor, area_resize
from geodiff_plugin.runtime.noise_levels import check_scheduler, noise_level
from tests.conftest import SCHEDULER, make_unet
from tests.contracts.tiny_depthfm import make_depthfm
from tests.contracts.tiny_depthmaster import make_depthmaster
from tests.contracts.tiny_geowizard import make_geowizard
from tests.contracts.tiny_lotus import make_lotus
from tests.contracts.tiny_ppd import make_ppd
from tests.contracts.tiny_priors import make_e2e_ft

IMAGE = np.random.default_rng(0).random((44, 60, 3)).astype(np.float32)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def load(adapter, folder, name="x", space=None):
    pipe = adapter.load(Layout(folder, name), torch.float32, space)
    pipe.set_progress_bar_config(disable=True)
    return pipe


# Grids ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("processor", "size", "resolution", "grid"),
    [
        (SidesOf(64), (375, 1242), 768, (256, 768)),  # 231 is nearer to 256
        (SidesOf(64), (375, 1242), 0, (384, 1216)),
        (SidesOf(64), (96, 160), 0, (128, 128)),  # 1.5 and 2.5 round to the even number, as in Python
        (SidesOf(64), (20, 300), 256, (64, 256)),  # never less than one
        (SidesOf(16, grow=True), (53, 70), 0, (64, 80)),
        (SidesOf(16, grow=True), (60, 98), 64, (48, 64)),
        (SidesOf(16, grow=True), (5, 9), 0, (16, 16)),
        (AreaImageProcessor(vae_scale_factor=16), (75, 113), 128, (96, 144)),
        (AreaImageProcessor(vae_scale_factor=16), (20, 300), 128, (32, 432)),
        (AreaImageProcessor(vae_scale_factor=16), (400, 300), 128, (128, 96)),
    ],
)
def test_sides_of_the_processed_image(processor, size, resolution, grid):
    image, padding, native = processor.preprocess(torch.rand(1, 3, *size), resolution)
    assert (tuple(image.shape[-2:]), padding, tuple(native)) == (grid, (0, 0), size)
    assert -1 <= image.min() < -0.5 and 0.5 < image.max() <= 1


def test_images_that_fit_are_not_touched_and_others_padded():
    image = torch.rand(1, 3, 64, 128)
    assert torch.equal(SidesOf(64).preprocess(image, 128)[0], image * 2 - 1)
    padded, padding, _ = AreaImageProcessor(vae_scale_factor=16).preprocess(image[..., :53, :113], 0)
    assert tuple(padded.shape[-2:]) == (64, 128) and padding == (11, 15)


def test_area_resize_is_the_mean_of_whole_blocks_and_keeps_a_constant():
    image = torch.rand(1, 2, 12, 18)
    torch.testing.assert_close(area_resize(image, (4, 6)), torch.nn.functional.avg_pool2d(image, 3))
    torch.testing.assert_close(area_resize(torch.ones(1, 1, 37, 51), (16, 32)), torch.ones(1, 1, 16, 32))


def test_lotus_rounds_sides_as_its_authors_do():
    wide = torch.zeros(1, 1, 8, 1226)
    assert LotusImageProcessor.resize_to_max_edge(wide, 768, "bilinear").shape == (1, 1, 5, 767)
    with pytest.raises(ValueError, match="aspect"):
        LotusImageProcessor.resize_to_max_edge(wide, 64, "bilinear")


# Schedules -----------------------------------------------------------------------------------------------


def test_direct_scheduler_gives_the_output_and_saves(tmp_path):
    DirectScheduler(timestep=1).save_pretrained(tmp_path)
    scheduler = DirectScheduler.from_pretrained(tmp_path)
    scheduler.set_timesteps(1, device="cpu")
    assert scheduler.timesteps.tolist() == [1]
    output, z = torch.randn(1, 4, 2, 2), torch.zeros(1, 4, 2, 2)
    assert scheduler.step(output, scheduler.timesteps[0], z).prev_sample is output
    assert scheduler.step(output, 1, z, return_dict=False)[0] is output
    check_scheduler(scheduler)
    level = noise_level(DirectScheduler(), torch.tensor(999))
    z0, eps = z0_from(output, z, level), noise_from(output, z, level)
    assert torch.equal(z0, output) and eps.norm() > 0  # a yardstick for the norm-matched rule
    assert torch.equal(output_from(z0 + 1, eps, level)[0], output + 1)
    with pytest.raises(ValueError, match="num_inference_steps must be 1"):
        scheduler.set_timesteps(4)
    with pytest.raises(ValueError, match="must be 'sample'"):
        DirectScheduler(prediction_type="epsilon")


def test_e2e_ft_ends_at_the_clean_latent():
    """Its DDIM's prev_sample is the authors' pred_original_sample."""
    pipe = make_e2e_ft()
    assert isinstance(pipe.scheduler, DDIMScheduler)
    pipe.scheduler.set_timesteps(1)
    (t,) = pipe.scheduler.timesteps
    v, z = torch.randn(2, 1, 4, 3, 3)
    step = pipe.scheduler.step(v, t, z)
    assert t == 999 and torch.equal(step.prev_sample, step.pred_original_sample)
    plain = DDIMScheduler(**SCHEDULER | {"rescale_betas_zero_snr": False})
    plain.set_timesteps(1)
    assert not torch.equal(plain.step(v, t, z).prev_sample, step.prev_sample)


@pytest.mark.parametrize(
    ("most", "asked", "default", "planned"),
    [
        (None, None, 1, (4, 1)),
        (None, 2, 10, (2, 1)),
        (1, None, 1, (1, 4)),
        (1, 1, 1, (1, 1)),
        (3, None, 3, (3, 2)),
    ],
)
def test_plan_of_steps_and_rounds(textured_plane, most, asked, default, planned):
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, min_steps=4)
    assert count_steps(guidance.denoising_steps(asked, default), asked, most) == planned


@pytest.mark.parametrize(("start", "rounds"), [(0.0, 3), (0.5, 1)])
def test_one_step_makes_the_updates_of_all(textured_plane, monkeypatch, start, rounds):
    """3 rounds of 2 updates in the one step; ``start`` leaves out rounds as it would leave out steps."""
    steps = []

    class Counted(Plain):
        def step(self, gradient, reference=None):
            steps.extend([gradient] * (gradient.ndim == 4))  # not those of scale and shift
            return super().step(gradient, reference)

    monkeypatch.setitem(RULES, "counted", Counted)
    views = textured_plane.right, textured_plane.K, textured_plane.E
    knobs = {"inner_steps": 2, "min_steps": 3, "weights": {"photometric": 1.0}}
    guidance = GeometryGuidance(*views, rule="counted", start=start, **knobs)
    out = enable_geometry_guidance(make_e2e_ft())(Image.fromarray(textured_plane.left), guidance=guidance)
    assert len(steps) == 2 * rounds and len(out.history) == rounds
    assert {report.step for report in out.history} == {0}


def test_depthfm_time_runs_from_0_to_1_and_the_sign_is_the_schedulers():
    """``z0 = z_t + (1 - t) v`` of theirs is what guidance computes from ``denoise`` and the noise level."""
    pipe, told, velocities = make_depthfm(), [], []

    def spy(module, arguments, output):
        told.append(float(arguments[1]))
        velocities.append(output[0])

    pipe.unet.register_forward_hook(spy)
    z = torch.randn(1, 4, 8, 8)
    condition = {"image_latent": torch.randn(1, 4, 8, 8), "prompt": pipe.prompt.embedding}
    pipe.set_timesteps(4, z.device)
    for k, t in enumerate(pipe.scheduler.timesteps):
        level = noise_level(pipe.scheduler, t)
        with torch.no_grad():
            output = pipe.denoise(z, t, condition)
        torch.testing.assert_close(z0_from(output, z, level), z + (1 - k / 4) * velocities[-1])
        z, before = pipe.scheduler.step(output, t, z).prev_sample, z
        torch.testing.assert_close(z, before + velocities[-1] / 4)
    assert told == [0.0, 0.25, 0.5, 0.75]
    assert cosine_alpha_bar(0.0) == pytest.approx(1.0) and cosine_alpha_bar(0.999) < 1e-5
    assert cosine_alpha_bar(0.4) == pytest.approx(math.cos(math.pi * 0.4 / 2) ** 2, abs=1e-4)


# What is drawn -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "draws"),
    [
        (make_depthmaster, False),
        (lambda: make_lotus("g"), True),
        (lambda: make_lotus("d"), True),  # the image latent
        (make_depthfm, True),
        (lambda: make_depthfm(noising_step=0), False),
    ],
)
def test_the_generator_decides_what_is_drawn(make, draws):
    pipe = make()
    first, again, other = (pipe(IMAGE, generator=seeded(s), output_latent=True).latent for s in (0, 0, 1))
    assert torch.equal(first, again) and torch.equal(first, other) != draws
    assert pipe.deterministic != draws
    with pytest.raises(ValueError, match="noising_step"):
        make_depthfm(noising_step=1000)


def test_lotus_g_sees_its_noise_and_d_has_none():
    padded = torch.rand(1, 3, 40, 64) * 2 - 1
    for kind in ("g", "d"):
        pipe = make_lotus(kind)
        condition = pipe.prepare_condition(padded, 1, 1, seeded())
        z, t = pipe.prepare_latents(condition, seeded(1)), torch.tensor(999)
        moved = pipe.denoise(z + 0.1, t, condition) - pipe.denoise(z, t, condition)
        assert bool(moved.abs().max() > 0) == pipe.sees_latents == bool(z.abs().max() > 0) == (kind == "g")


@pytest.mark.parametrize("make", [lambda: make_geowizard(1), lambda: make_geowizard(2), make_depthfm])
def test_a_batch_gives_every_member_what_it_gets_alone(make):
    pipe = make()
    options = {"ensemble_size": 2, "num_inference_steps": 1, "output_latent": True}
    drawn = pipe(IMAGE, generator=seeded(), **options).latent
    images, latents = [IMAGE, IMAGE[:, ::-1].copy()], torch.randn(4, *drawn.shape[1:], generator=seeded())
    both = pipe(images, latents=latents, batch_size=3, **options).latent
    alone = [
        pipe(x, latents=latents[i : i + 2], **options).latent for x, i in zip(images, (0, 2), strict=True)
    ]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-4, rtol=1e-4)


def test_depthfm_averages_members_in_its_own_way():
    with pytest.raises(ValueError, match="ensembling_kwargs"):
        make_depthfm()(IMAGE, ensemble_size=2, num_inference_steps=1, ensembling_kwargs={"reduction": "mean"})


# Networks ------------------------------------------------------------------------------------------------


def test_depthmasters_block_follows_the_middle():
    """Also in a copy, whose block is its own."""
    unet = make_depthmaster().unet
    latent, prompt = torch.randn(1, 4, 6, 8, generator=seeded()), torch.randn(1, 2, 8, generator=seeded())

    def answer(net):
        with torch.no_grad():
            return net(latent, 1, encoder_hidden_states=prompt, return_dict=False)[0]

    stock = UNet2DConditionModel.from_config(unet.config)
    stock.load_state_dict({k: v for k, v in unet.state_dict().items() if not k.startswith("fftblock.")})
    assert not torch.allclose(answer(stock), answer(unet), atol=1e-3)
    twin = copy.deepcopy(unet)
    torch.testing.assert_close(answer(twin), answer(unet))
    with torch.no_grad():
        twin.fftblock.fuse.weight.zero_()
    assert not torch.allclose(answer(twin), answer(unet), atol=1e-3)


@pytest.mark.parametrize("size", [(4, 6), (5, 7)])
def test_depthmasters_block_in_half_precision_and_for_odd_sizes(size):
    torch.manual_seed(0)
    block, features = FourierBlock(8, groups=4), torch.randn(2, 8, *size)
    wide, half = block(features), block.to(torch.bfloat16)(features.to(torch.bfloat16))
    assert half.dtype == torch.bfloat16 and wide.shape == features.shape
    assert torch.isfinite(half).all() and (half.float() - wide).abs().median() < 0.1


def test_ppd_in_half_precision_and_with_checkpointing():
    pipe, gradients = make_ppd(), []
    image, tokens = torch.rand(1, 3, 32, 48), torch.rand(1, 6, 64)
    for enabled in (False, True):
        if enabled:
            pipe.dit.enable_gradient_checkpointing()
        z = torch.ones(1, 1, 32, 48, requires_grad=True)
        output = pipe.dit(torch.cat([z, image], dim=1), tokens, torch.tensor(500.0))
        gradients.append(torch.autograd.grad(output.square().sum(), z)[0])
    torch.testing.assert_close(*gradients)
    assert gradients[0].abs().sum() > 0
    out = make_ppd().to(torch.bfloat16)(torch.rand(1, 3, 50, 81), output_type="pt", generator=seeded())
    assert tuple(out.prediction.shape) == (1, 1, 50, 81)
    assert out.prediction.dtype == torch.float32 and out.prediction.isfinite().all()


# Folders -------------------------------------------------------------------------------------------------


def as_geowizards_authors(folder, version):
    """Subfolders as ``run_infer.py`` and ``run_infer_v2.py`` read them, classes that are not ours to load."""
    if version == 2:
        (folder / "unet").rename(folder / "unet_v2")
        (folder / "model_index.json").unlink()
        return
    foreign = {"_class_name": "Anything", "unet": ["models.unet_2d_condition", "UNet2DConditionModel"]}
    (folder / "model_index.json").write_text(json.dumps(foreign))
    (folder / "feature_extractor").mkdir()
    statistics = {"image_mean": [0.4, 0.5, 0.6], "image_std": [0.1, 0.2, 0.3], "do_resize": True}
    (folder / "feature_extractor" / "preprocessor_config.json").write_text(json.dumps(statistics))


@pytest.mark.parametrize("version", [1, 2])
def test_geowizards_folders(version, tmp_path):
    saved = make_geowizard(version)
    saved.save_pretrained(tmp_path)
    as_geowizards_authors(tmp_path, version)
    assert GeoWizardPrior.recognises(Layout(tmp_path, "x"))
    loaded = load(GeoWizardPrior, tmp_path)
    if version == 1:
        assert loaded.config.clip_statistics["mean"] == [0.4, 0.5, 0.6]
        loaded.register_to_config(clip_statistics=saved.config.clip_statistics)
    options = {"num_inference_steps": 2, "processing_resolution": 64}
    maps = (p(IMAGE, generator=seeded(), **options).prediction for p in (loaded, saved))
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
def test_lotus_folders(kind, tmp_path):
    pipe, folder = make_lotus(kind), tmp_path / f"lotus-depth-{kind}-v1-0"
    as_lotus_authors(pipe, folder)
    assert LotusPrior.recognises(Layout(folder, str(folder)))
    loaded = load(LotusPrior, folder, str(folder))
    assert loaded.config.prediction_type == "depth"
    maps = [p(IMAGE, processing_resolution=64, generator=seeded()).prediction for p in (pipe, loaded)]
    np.testing.assert_allclose(*maps, rtol=0, atol=1e-5)
    assert LotusPrior(load(LotusPrior, folder, "x", "disparity")).space == "disparity"
    plain = LotusPipeline.from_pretrained(folder, prediction_type="depth", local_files_only=True)
    assert plain.scheduler.config.timestep == 999


@pytest.mark.parametrize(
    ("name", "space"),
    [
        ("jingheya/lotus-depth-d-v1-0", "depth"),
        ("jingheya/lotus-depth-g-v2-1-disparity", "disparity"),
        ("/disparity/lotus-depth-d-v1-0", "depth"),
        ("hub/models--jingheya--lotus-depth-d-v2-0-disparity/snapshots/1a2b", "disparity"),
        ("my/finetune", "--space"),
        ("checkpoints/lotus", "--space"),
        ("some-disparity-model", "--space"),
        ("jingheya/lotus-normal-g-v1-1", "normals"),
    ],
)
def test_the_name_of_a_lotus_tells_its_space(name, space):
    if space in ("depth", "disparity"):
        assert space_of_name(name) == space
        return
    with pytest.raises(ValueError, match=space):
        space_of_name(name)


def test_relatives_are_told_apart(tmp_path):
    make_unet().save_pretrained(tmp_path / "unet")
    assert not LotusPrior.recognises(Layout(tmp_path, "lotus-depth-g-v1-0"))
    for options, sentence in (({"prediction_type": "depth"}, "class embedding"), ({}, "disparity versions")):
        with pytest.raises(ValueError, match=sentence):
            LotusPipeline(make_unet(), None, None, None, None, **options)
    make_geowizard(2).save_pretrained(tmp_path / "2")
    index_of_2 = tmp_path / "2" / "model_index.json"
    index = json.loads(index_of_2.read_text())
    index.pop("default_domain")  # what is left is the layout of a Lotus-G
    index_of_2.write_text(json.dumps(index))
    assert not GeoWizardPrior.recognises(Layout(tmp_path / "2", "lotus"))
    folder = tmp_path / "master"
    make_depthmaster().save_pretrained(folder)
    index, config = (folder / "model_index.json").read_text(), folder / "unet" / "config.json"
    assert DepthMasterPrior(load(DepthMasterPrior, folder, space="disparity")).space == "disparity"
    with_schedule = json.loads(index) | {"scheduler": ["diffusers", "DDIMScheduler"]}
    (folder / "model_index.json").write_text(json.dumps(with_schedule))
    assert not DepthMasterPrior.recognises(Layout(folder, "stable diffusion"))
    (folder / "model_index.json").write_text(index)
    UNet2DConditionModel.from_config(json.loads(config.read_text())).save_pretrained(folder / "unet")
    with pytest.raises(ValueError, match=r"missing: fftblock\.conv_f1\.bias"):
        load(DepthMasterPrior, folder)
    config.write_text(json.dumps(json.loads(config.read_text()) | {"class_embed_type": "projection"}))
    assert not DepthMasterPrior.recognises(Layout(folder, "lotus d"))


# Lotus on the image --------------------------------------------------------------------------------------


def guided_lotus(pipe, image, callback=None):
    """Without updates, at the image's own size."""
    camera = np.array([[60.0, 0, 29.5], [0, 60.0, 21.5], [0, 0, 1]])
    points = np.array([[0.1, 0.1, 2.0], [0.2, 0.0, 3.0]])
    still = {"inner_steps": 0, "correct": False, "crisp": False}
    guidance = GeometryGuidance.from_points(points, camera, **still)
    call = {"processing_resolution": 0, "match_input_resolution": False, "generator": seeded()}
    return pipe(image, guidance=guidance, callback_on_step_end=callback, **call)


def test_lotus_relative_map_lies_pixel_to_pixel_on_an_image_of_odd_size():
    pipe, odd = make_lotus("d"), IMAGE[:43, :59]
    out = pipe(odd, processing_resolution=0, match_input_resolution=False)
    assert out.prediction.shape == (1, 40, 56, 1)  # theirs: whole cells, to be stretched
    alone = guided_lotus(enable_geometry_guidance(pipe), odd)
    x = alone.relative
    assert x.shape == (1, 43, 59, 1)
    np.testing.assert_array_equal(x[:, 40:], x[:, 39:40].repeat(3, 1))
    np.testing.assert_array_equal(x[:, :, 56:], x[:, :, 55:56].repeat(3, 2))
    another = np.resize(IMAGE, (64, 64, 3))  # a call of another size within a guided one changes nothing
    other = {"processing_resolution": 0, "generator": seeded(1)}
    beside = guided_lotus(pipe, odd, lambda p, *_: p(another, **other) and None)
    np.testing.assert_array_equal(alone.prediction, beside.prediction)


def test_the_layout_of_a_tensor_changes_nothing():
    pipe, plain = make_lotus("g"), torch.rand(1, 3, 96, 128, generator=seeded())
    views = (plain, plain.to(memory_format=torch.channels_last))
    maps = (pipe(x, generator=seeded(), processing_resolution=0).prediction for x in views)
    np.testing.assert_array_equal(*maps)


# GeoWizard's pair ----------------------------------------------------------------------------------------


def test_geowizards_parts_domain_and_attention():
    one, two = make_geowizard(1), make_geowizard(2)
    with pytest.raises(ValueError, match="image_encoder"):
        GeoWizardPipeline(unet=one.unet, vae=one.vae, scheduler=one.scheduler, text_encoder=two.text_encoder)
    with pytest.raises(ValueError, match="text_encoder and tokenizer"):
        GeoWizardPipeline(unet=two.unet, vae=two.vae, scheduler=two.scheduler)
    for pipe in (one, two):
        default, indoor, outdoor = (
            pipe(IMAGE, generator=seeded(), **told).prediction
            for told in ({}, {"domain": "indoor"}, {"domain": "outdoor"})
        )
        assert np.array_equal(default, indoor) and np.abs(indoor - outdoor).max() > 1e-4
        with pytest.raises(ValueError, match="domain must be one of"):
            pipe(IMAGE, domain="underwater")
    two.unet.set_attn_processor(AttnProcessor())
    with pytest.raises(ValueError, match="PairAttention"):
        two(IMAGE)
    sine, cosine = np.sin(1.0), np.cos(1.0)
    depth = [0, sine, 1, cosine, 0, sine, 0, 1, cosine, 1]
    np.testing.assert_allclose(class_embedding("outdoor")[0], depth, rtol=1e-6)
    np.testing.assert_allclose(class_embedding(None)[1], [sine, 0, cosine, 1], rtol=1e-6)


@pytest.mark.parametrize("version", [1, 2])
def test_geowizards_normals_are_unit_vectors_of_one_member(version):
    pipe = make_geowizard(version)
    drawn = pipe.prepare_latents({"image_latent": torch.zeros(2, 4, 6, 8)}, seeded())
    depth, normals = drawn.chunk(2, dim=1)
    assert torch.equal(depth, normals) and not torch.equal(depth[0], depth[1])
    output = pipe(IMAGE, ensemble_size=3, output_latent=True, generator=seeded(), processing_resolution=0)
    normals = output.extras["normals"]
    assert normals.shape == (1, 44, 60, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-2)
    with torch.no_grad():
        members = [pipe.decode_extras(latent[None], 1)["normals"][0] for latent in output.latent]
    at_size = [member.permute(1, 2, 0)[:44, :60] for member in members]
    assert any(np.allclose(member, normals[0], atol=1e-6) for member in at_size)
    towards = torch.tensor([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [1.0, 0.0, 0.0]])
    vectors = torch.nn.functional.normalize(towards, dim=1)[:, :, None, None].expand(3, 3, 4, 5)
    assert torch.equal(closest_to_mean(vectors)[0], vectors[1])


@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_guidance_moves_depth_and_normals_follow_through_attention_alone(gradient, textured_plane):
    views = textured_plane.right, textured_plane.K, textured_plane.E
    knobs = {"inner_steps": 1, "step_latents": 1.0, "weights": {"photometric": 1.0}, "respace": False}
    guidance = GeometryGuidance(*views, gradient=gradient, **knobs)

    def latents_of_every_step(**told):
        seen, pipe = [], enable_geometry_guidance(make_geowizard(1))
        own = pipe.scheduler.step

        def step(*args, **kwargs):
            result = own(*args, **kwargs)
            seen.append(result.prev_sample)
            return result

        pipe.scheduler.step = step
        return seen, pipe(textured_plane.left, num_inference_steps=2, generator=seeded(), **told)

    plain, _ = latents_of_every_step()
    guided, output = latents_of_every_step(guidance=guidance)
    depth, normals = slice(0, 4), slice(4, 8)
    assert not torch.equal(plain[0][:, depth], guided[0][:, depth])
    torch.testing.assert_close(plain[0][:, normals], guided[0][:, normals], rtol=0.0, atol=1e-6)
    assert (plain[1][:, normals] - guided[1][:, normals]).abs().max() > 1e-4
    assert output.extras["normals"].shape == (1, 48, 64, 3)
