"""GeoWizard: its folders, its domain, its normals, and a guidance that leaves them alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from diffusers.models.attention_processor import AttnProcessor
from safetensors.torch import load_file, save_file

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.geowizard import (
    GeoWizardPipeline,
    GeoWizardPrior,
    class_embedding,
    closest_to_mean,
)
from tests.contracts.tiny_geowizard import make_geowizard

IMAGE = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32)


def call(pipe, **kwargs):
    return pipe(IMAGE, generator=torch.Generator().manual_seed(0), **kwargs)


@pytest.fixture(scope="module", params=[1, 2], ids=["v1", "v2"])
def pipe(request):
    return make_geowizard(request.param)


def as_the_authors_lay_it_out(folder, version):
    """Subfolders as ``run_infer.py`` and ``run_infer_v2.py`` read them, classes that are not ours to load."""
    if version == 2:
        (folder / "unet").rename(folder / "unet_v2")
        (folder / "model_index.json").unlink()
        return
    foreign = {name: ["models.unet_2d_condition", "UNet2DConditionModel"] for name in ("unet",)}
    (folder / "model_index.json").write_text(json.dumps({"_class_name": "Anything"} | foreign))
    (folder / "feature_extractor").mkdir()
    statistics = {"image_mean": [0.4, 0.5, 0.6], "image_std": [0.1, 0.2, 0.3], "do_resize": True}
    (folder / "feature_extractor" / "preprocessor_config.json").write_text(json.dumps(statistics))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("authors", [False, True], ids=["ours", "authors"])
def test_a_folder_gives_the_pipeline_back(version, authors, tmp_path):
    saved = make_geowizard(version)
    saved.save_pretrained(tmp_path)
    if authors:
        as_the_authors_lay_it_out(tmp_path, version)
    layout = Layout(tmp_path, str(tmp_path))
    assert GeoWizardPrior.recognises(layout)
    loaded = GeoWizardPrior.load(layout, torch.float32, None)
    loaded.set_progress_bar_config(disable=True)
    if authors and version == 1:
        assert loaded.config.clip_statistics["mean"] == [0.4, 0.5, 0.6]
        loaded.register_to_config(clip_statistics=saved.config.clip_statistics)
    options = {"processing_resolution": 64, "num_inference_steps": 2}
    np.testing.assert_array_equal(call(loaded, **options).prediction, call(saved, **options).prediction)
    assert GeoWizardPrior(loaded).space == "depth"


def test_an_unet_of_another_prior_is_not_claimed(tmp_path):
    make_geowizard(2).save_pretrained(tmp_path)
    index = json.loads((tmp_path / "model_index.json").read_text())
    index.pop("default_domain")  # what is left is the layout of a Lotus-G
    (tmp_path / "model_index.json").write_text(json.dumps(index))
    assert not GeoWizardPrior.recognises(Layout(tmp_path, "lotus"))


def test_weights_that_do_not_fit_are_listed(tmp_path):
    make_geowizard(1).save_pretrained(tmp_path)
    file = tmp_path / "unet" / "diffusion_pytorch_model.safetensors"
    weights = load_file(file)
    weights["stranger.weight"] = weights.pop("class_embedding.linear_1.weight")
    save_file(weights, file)
    expected = r"missing: class_embedding.linear_1.weight; unexpected: stranger.weight"
    with pytest.raises(ValueError, match=expected):
        GeoWizardPrior.load(Layout(tmp_path, "x"), torch.float32, None)


def test_parts_must_fit_the_version():
    one, two = make_geowizard(1), make_geowizard(2)
    with pytest.raises(ValueError, match="image_encoder"):
        GeoWizardPipeline(unet=one.unet, vae=one.vae, scheduler=one.scheduler, text_encoder=two.text_encoder)
    with pytest.raises(ValueError, match="text_encoder and tokenizer"):
        GeoWizardPipeline(unet=two.unet, vae=two.vae, scheduler=two.scheduler)


def test_the_domain_changes_the_answer_and_has_three_values(pipe):
    indoor, outdoor = call(pipe).prediction, call(pipe, domain="outdoor").prediction
    np.testing.assert_array_equal(indoor, call(pipe, domain="indoor").prediction)
    assert np.abs(indoor - outdoor).max() > 1e-4
    with pytest.raises(ValueError, match="domain must be one of"):
        call(pipe, domain="underwater")


def test_class_embedding_is_sines_and_cosines_of_one_hot_codes():
    sine, cosine = np.sin(1.0), np.cos(1.0)
    depth = [0, sine, 1, cosine, 0, sine, 0, 1, cosine, 1]
    np.testing.assert_allclose(class_embedding("outdoor")[0], depth, rtol=1e-6)
    np.testing.assert_allclose(class_embedding(None)[1], [sine, 0, cosine, 1], rtol=1e-6)


def test_both_halves_start_from_one_noise(pipe):
    like = {"image_latent": torch.zeros(2, 4, 6, 8)}
    depth, normals = pipe.prepare_latents(like, torch.Generator().manual_seed(0)).chunk(2, dim=1)
    assert torch.equal(depth, normals)
    assert not torch.equal(depth[0], depth[1])


def test_a_batch_gives_every_member_what_it_gets_alone(pipe):
    latents = pipe.prepare_latents(
        {"image_latent": torch.zeros(3, 4, 6, 8)}, torch.Generator().manual_seed(0)
    )
    options = {"ensemble_size": 3, "latents": latents, "output_latent": True}
    together, alone = (pipe(IMAGE, batch_size=size, **options).latent for size in (3, 1))
    torch.testing.assert_close(together, alone, rtol=0.0, atol=1e-5)


def test_a_replaced_attention_processor_is_an_error():
    pipe = make_geowizard(2)
    pipe.unet.set_attn_processor(AttnProcessor())
    with pytest.raises(ValueError, match="PairAttention"):
        call(pipe)


def test_normals_are_unit_vectors_of_one_member(pipe):
    output = call(pipe, ensemble_size=3, output_latent=True)
    normals = output.extras["normals"]
    assert normals.shape == (1, 48, 64, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-2)
    with torch.no_grad():
        members = [pipe.decode_extras(latent[None], 1)["normals"][0] for latent in output.latent]
    assert any(np.allclose(member.permute(1, 2, 0), normals[0], atol=1e-6) for member in members)


def test_the_member_closest_to_the_mean_is_taken():
    towards = torch.tensor([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [1.0, 0.0, 0.0]])
    members = torch.nn.functional.normalize(towards, dim=1)[:, :, None, None].expand(3, 3, 4, 5)
    assert torch.equal(closest_to_mean(members)[0], members[1])


@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_guidance_moves_depth_and_normals_follow_through_attention_alone(gradient, textured_plane):
    views = textured_plane.right, textured_plane.K, textured_plane.E
    guidance = GeometryGuidance(
        *views,
        gradient=gradient,
        inner_steps=1,
        step_latents=1.0,
        weights={"photometric": 1.0},
        respace=False,
    )

    def latents_of_every_step(guidance):
        seen = []
        pipe = enable_geometry_guidance(make_geowizard(1))
        own = pipe.scheduler.step

        def step(*args, **kwargs):
            result = own(*args, **kwargs)
            seen.append(result.prev_sample)
            return result

        pipe.scheduler.step = step
        output = pipe(
            textured_plane.left,
            num_inference_steps=2,
            generator=torch.Generator().manual_seed(0),
            **({"guidance": guidance} if guidance else {}),
        )
        return seen, output

    plain, _ = latents_of_every_step(None)
    guided, output = latents_of_every_step(guidance)
    depth, normals = slice(0, 4), slice(4, 8)
    assert not torch.equal(plain[0][:, depth], guided[0][:, depth])
    torch.testing.assert_close(plain[0][:, normals], guided[0][:, normals], rtol=0.0, atol=1e-6)
    assert (plain[1][:, normals] - guided[1][:, normals]).abs().max() > 1e-4
    assert output.extras["normals"].shape == (1, 48, 64, 3)
