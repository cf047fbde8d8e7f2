"""What each prior's own pipeline does beside its parity: grids, schedules, draws, folders, endings."""

import json

import numpy as np
import pytest
import torch
from diffusers import PNDMScheduler, UNet2DConditionModel
from diffusers.models.attention_processor import AttnProcessor
from safetensors.torch import load_file, save_file

from geodiff_plugin.priors.components import DirectScheduler, SidesOf
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline
from geodiff_plugin.priors.geowizard import GeoWizardPipeline, closest_to_mean
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.lotus import LotusPipeline, space_of_name
from geodiff_plugin.priors.ppd import AreaImageProcessor
from tests.contracts.tiny_priors import make_depthfm, make_depthmaster, make_geowizard, make_lotus, quiet
from tests.tiny import make_unet

IMAGE = np.random.default_rng(0).random((44, 60, 3)).astype(np.float32)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def load(adapter, folder, name="x", space=None):
    return quiet(adapter.load(Layout(folder, name), torch.float32, space))


@pytest.mark.parametrize(
    ("processor", "size", "resolution", "grid"),
    [
        (SidesOf(64), (375, 1242), 768, (256, 768)),  # 231 is nearer to 256
        (SidesOf(64), (96, 160), 0, (128, 128)),  # 1.5 and 2.5 round to the even number, as in Python
        (SidesOf(64), (20, 300), 256, (64, 256)),  # never less than one
        (SidesOf(16, grow=True), (60, 98), 64, (48, 64)),
        (SidesOf(16, grow=True), (5, 9), 0, (16, 16)),
        (SidesOf(1), (8, 1226), 768, (5, 767)),  # a float product cut to an integer, as Lotus's authors do
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
    drawn = pipe(IMAGE, generator=seeded(), **options).latent
    images, latents = [IMAGE, IMAGE[:, ::-1].copy()], torch.randn(4, *drawn.shape[1:], generator=seeded())
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
        p(IMAGE, generator=seeded(), **call).prediction for p in (load(GeoWizardPipeline, tmp_path), saved)
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
    maps = [p(IMAGE, processing_resolution=64, generator=seeded()).prediction for p in (pipe, loaded)]
    np.testing.assert_allclose(*maps, rtol=0, atol=1e-5)
    assert load(LotusPipeline, folder, "x", "disparity").space == "disparity"
    plain = LotusPipeline.from_pretrained(folder, prediction_type="depth", local_files_only=True)
    assert plain.scheduler.config.timestep == 999


def test_the_name_of_a_lotus_tells_its_space():
    assert space_of_name("hub/lotus-depth-d-v1-0") == space_of_name("/disparity/lotus-depth-d") == "depth"
    assert space_of_name("models--jingheya--lotus-depth-g-v2-1-disparity/snapshots/1a2b") == "disparity"
    for name in ("checkpoints/lotus", "some-disparity-model"):
        with pytest.raises(ValueError, match="--space"):
            space_of_name(name)


def test_relatives_are_told_apart(tmp_path):
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
            pipe(IMAGE, generator=seeded(), **told).prediction
            for told in ({}, {"domain": "indoor"}, {"domain": "outdoor"})
        )
        assert np.array_equal(default, indoor) and np.abs(indoor - outdoor).max() > 1e-4
        pipe.unet.set_attn_processor(AttnProcessor())  # under which depth and normals do not see each other
        np.testing.assert_allclose(pipe(IMAGE, generator=seeded()).prediction, default, atol=1e-5)


def test_geowizards_normals_are_unit_vectors_of_one_member():
    pipe = make_geowizard(2)
    drawn = pipe.prepare_latents({"image_latent": torch.zeros(2, 4, 6, 8)}, seeded())
    depth, normals = drawn.chunk(2, dim=1)
    assert torch.equal(depth, normals) and not torch.equal(depth[0], depth[1])
    output = pipe(IMAGE, ensemble_size=3, output_latent=True, generator=seeded(), processing_resolution=0)
    normals = output.extras["normals"]
    assert normals.shape == (1, 44, 60, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-2)
    towards = torch.tensor([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [1.0, 0.0, 0.0]])
    vectors = torch.nn.functional.normalize(towards, dim=1)[:, :, None, None].expand(3, 3, 4, 5)
    assert torch.equal(closest_to_mean(vectors)[0], vectors[1])
