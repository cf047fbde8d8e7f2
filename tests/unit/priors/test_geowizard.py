"""GeoWizard's pairs of depth and normals: attention, conditions, calls of the network, endings."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers.models.attention_processor import Attention, AttnProcessor2_0
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from geodiff_plugin.priors import geowizard as module
from geodiff_plugin.priors.geowizard import GeoWizardPipeline, PairAttention, closest_to_mean
from tests.contracts.tiny_priors import make_geowizard


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def one():
    return make_geowizard(1)


@pytest.fixture(scope="module")
def two():
    return make_geowizard(2)


def test_every_token_of_a_pair_sees_those_of_both_halves():
    own, plain = (
        Attention(8, heads=2, dim_head=4, processor=p()).eval() for p in (PairAttention, AttnProcessor2_0)
    )
    plain.load_state_dict(own.state_dict())
    tokens = torch.randn(6, 5, 8)  # three pairs: all depth, then all normals
    with torch.no_grad():
        found = own(tokens)
        for i in range(3):
            together = plain(torch.cat([tokens[i], tokens[i + 3]])[None])[0]
            torch.testing.assert_close(found[i], together[:5])
            torch.testing.assert_close(found[i + 3], together[5:])


def test_self_attentions_are_coupled_and_those_to_the_prompt_are_not(one):
    one.unet.set_attn_processor(AttnProcessor2_0())
    module.couple_pairs(one.unet)
    kinds = {name: type(processor) for name, processor in one.unet.attn_processors.items()}
    of_itself = {name for name in kinds if ".transformer_blocks." in name and ".attn1." in name}
    assert of_itself and {name for name, kind in kinds.items() if kind is PairAttention} == of_itself


def test_the_network_is_asked_of_all_depth_then_of_all_normals(one):
    """Every image has its own latent, prompt and labels; the answers come back side by side."""
    seen = {}

    def run_unet(sample, timestep, condition):
        seen.update(sample=sample, timestep=timestep, **condition)
        return sample[:, 4:] + condition["class_labels"][:, :1, None, None]

    stand_in = SimpleNamespace(run_unet=run_unet, depth_channels=slice(0, 4), normal_channels=slice(4, 8))
    image, latents = torch.randn(3, 4, 2, 5), torch.randn(3, 8, 2, 5)
    condition = {"image_latent": image, "prompt": torch.randn(3, 1, 6), "class_labels": torch.randn(3, 2, 10)}
    found = GeoWizardPipeline.denoise(stand_in, latents, 7, condition)
    for i in range(3):
        for half in (0, 1):
            row = i + 3 * half
            own = latents[i, 4 * half : 4 * half + 4]
            assert torch.equal(seen["sample"][row], torch.cat([image[i], own]))
            assert torch.equal(seen["prompt"][row], condition["prompt"][i])
            assert torch.equal(seen["class_labels"][row], condition["class_labels"][i, half])
            answer = found[i, 4 * half : 4 * half + 4]
            torch.testing.assert_close(answer, own + condition["class_labels"][i, half, 0])
    assert seen["timestep"] == 7
    assert (one.depth_channels, one.normal_channels) == (slice(0, 4), slice(4, 8))


def test_the_first_version_gets_the_image_and_the_domain_as_numbers(one):
    images = torch.rand(2, 3, 64, 64) * 2 - 1
    with torch.no_grad():
        condition = one.prepare_condition(images, 3, 1, None)
        outdoor = one.prepare_condition(images, 1, 1, None, "outdoor")
        alone = [one._image_prompt(images[i : i + 1]) for i in range(2)]
        latents = [one.image_latents(images[i : i + 1], 1, 1) for i in range(2)]
    assert condition["prompt"].shape[:2] == (6, 1) and condition["class_labels"].shape == (6, 2, 10)
    for k in range(6):
        torch.testing.assert_close(condition["prompt"][k : k + 1], alone[k // 3], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(
            condition["image_latent"][k : k + 1], latents[k // 3], rtol=1e-4, atol=1e-5
        )
        assert torch.equal(condition["class_labels"][k], module.class_embedding("indoor"))
    assert torch.equal(outdoor["class_labels"][1], module.class_embedding("outdoor"))
    torch.testing.assert_close(outdoor["prompt"], condition["prompt"][::3], rtol=1e-4, atol=1e-5)


def test_the_second_version_gets_the_domain_as_text(two):
    images = torch.rand(2, 3, 64, 64) * 2 - 1
    words = []
    own, two.prompt_embedding = two.prompt_embedding, lambda like, text: words.append(text) or own(like, text)
    try:
        with torch.no_grad():
            found = [two.prepare_condition(images, 2, 2, None, domain) for domain in (None, "object")]
    finally:
        del two.prompt_embedding
    assert words == ["indoor geometry", "object geometry"]
    for condition in found:
        assert condition["class_labels"].shape == (4, 2, 4) and len(condition["prompt"]) == 4
        assert torch.equal(condition["class_labels"][3], module.class_embedding(None))
    assert not torch.equal(found[0]["prompt"], found[1]["prompt"])
    other = GeoWizardPipeline(**two.components, default_domain="object")
    torch.testing.assert_close(other.prepare_condition(images, 2, 2, None)["prompt"], found[1]["prompt"])
    with pytest.raises(ValueError, match="domain must be one of"):
        two.prepare_condition(images, 1, 1, None, "sea")
    with pytest.raises(ValueError, match="default_domain must be one of"):
        GeoWizardPipeline(**two.components, default_domain="sea")


def test_clip_sees_the_whole_image_squeezed_into_its_square_and_normalised(one):
    size, seen = one.image_encoder.config.image_size, []

    class Encoder:
        config = SimpleNamespace(image_size=size)

        def __call__(self, values):
            seen.append(values)
            return SimpleNamespace(image_embeds=values.mean((2, 3)).double())

    rows, columns = torch.linspace(0, 1, 90)[:, None], torch.linspace(0, 1, 160)[None]
    image_01 = torch.stack([rows.expand(90, 160), columns.expand(90, 160), rows * columns])[None]
    pipe = SimpleNamespace(image_encoder=Encoder())
    found = GeoWizardPipeline._image_prompt(pipe, 2 * image_01 - 1)
    wanted = torch.nn.functional.interpolate(image_01, (size, size), mode="bicubic", antialias=True)
    for channel in range(3):
        expected = (wanted[0, channel] - OPENAI_CLIP_MEAN[channel]) / OPENAI_CLIP_STD[channel]
        torch.testing.assert_close(seen[0][0, channel], expected, rtol=1e-4, atol=1e-4)
    assert found.shape == (1, 1, 3) and found.dtype == torch.float32
    half = (2 * image_01 - 1).bfloat16()
    assert GeoWizardPipeline._image_prompt(pipe, half).dtype == seen[1].dtype == torch.bfloat16
    GeoWizardPipeline._image_prompt(pipe, half.float())
    assert torch.equal(seen[1], seen[2].bfloat16())  # rounded at the end alone


def test_depth_and_normals_start_from_the_same_noise(two):
    like = {"image_latent": torch.zeros(3, 4, 5, 6)}
    found = two.prepare_latents(like, torch.Generator().manual_seed(1))
    assert torch.equal(found[:, :4], torch.randn(3, 4, 5, 6, generator=torch.Generator().manual_seed(1)))
    assert torch.equal(found[:, 4:], found[:, :4])


def test_depth_is_clipped_then_stretched_and_normals_are_unit_vectors_of_the_most_typical_member():
    rgb_images = torch.randn(4, 3, 6, 7)
    latents = torch.arange(4.0).view(4, 1, 1, 1).expand(4, 8, 1, 1) + torch.arange(8.0).view(8, 1, 1)
    asked = []

    class Decoded(GeoWizardPipeline):
        def __init__(self):
            pass

        def decode_image(self, z0):
            asked.append(z0)
            return rgb_images[z0[:, 0, 0, 0].long() % 4]

    pipe = Decoded()
    maps = pipe.decode_prediction(latents)
    assert torch.equal(asked.pop(), latents[:, :4])
    for found, rgb in zip(maps.numpy(), rgb_images.numpy(), strict=True):
        clipped = np.clip((rgb.mean(0) + 1) / 2, 0, 1)
        stretched = (clipped - clipped.min()) / (clipped.max() - clipped.min())
        np.testing.assert_allclose(found[0], stretched, rtol=1e-5, atol=1e-6)
    found = pipe.decode_extras(latents, 2)
    assert list(found) == ["normals"] and [tuple(z.shape) for z in asked] == [(1, 4, 1, 1)] * 4
    assert torch.equal(torch.cat(asked), latents[:, 4:])
    length = rgb_images.norm(dim=1, keepdim=True)
    unit = rgb_images / (length + 1e-5)
    torch.testing.assert_close(found["normals"], torch.cat([closest_to_mean(pair) for pair in unit.split(2)]))
    torch.testing.assert_close(found["normals"].norm(dim=1), torch.ones(2, 6, 7), rtol=0, atol=1e-3)


def test_the_closest_member_has_the_least_sum_of_angles_to_the_mean():
    rng = np.random.default_rng(0)
    for _ in range(5):
        vectors = rng.normal(size=(5, 3, 4, 6)) * 0.4 + np.array([0.0, 0.2, -1.0])[:, None, None]
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        mean = vectors.mean(0)
        mean /= np.linalg.norm(mean, axis=0)
        angles = np.arccos(np.clip(np.einsum("echw,chw->ehw", vectors, mean), -1, 1)).sum((1, 2))
        found = closest_to_mean(torch.from_numpy(vectors))
        assert torch.equal(found, torch.from_numpy(vectors[[angles.argmin()]]))


@pytest.mark.parametrize("version", [1, 2])
def test_each_version_needs_its_own_encoder(version, one, two):
    pipe = {1: one, 2: two}[version]
    parts = dict(pipe.components)
    needed = {1: ["image_encoder"], 2: ["text_encoder", "tokenizer"]}[version]
    assert GeoWizardPipeline(**parts).config.default_domain == "indoor"
    for name in needed:
        got = [other for other in needed if other != name]
        with pytest.raises(
            ValueError, match="components must be a U-Net of GeoWizard v1 or v2 with"
        ) as error:
            GeoWizardPipeline(**parts | {name: None})
        assert str(needed) in str(error.value) and f"got {got}" in str(error.value)
    stranger = SimpleNamespace(config=SimpleNamespace(projection_class_embeddings_input_dim=5))
    with pytest.raises(ValueError, match="with None"):
        GeoWizardPipeline(**parts | {"unet": stranger})


def test_latents_of_images_are_the_mode(one):
    image = torch.rand(1, 3, 64, 64) * 2 - 1
    with torch.no_grad():
        parameters = one.vae.encode(image).latent_dist.parameters
        found = one.prepare_condition(image, 2, 1, torch.Generator())["image_latent"]
    mode = DiagonalGaussianDistribution(parameters).mode() * one.vae.config.scaling_factor
    torch.testing.assert_close(found, mode.expand(2, -1, -1, -1), rtol=1e-4, atol=1e-5)


def test_labels_are_made_on_the_cpu_whatever_the_default_device_is():
    with torch.device("meta"):
        assert {module.class_embedding(domain).device.type for domain in (None, "indoor")} == {"cpu"}
