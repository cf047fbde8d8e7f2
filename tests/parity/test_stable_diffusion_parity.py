"""Priors on Stable Diffusion's networks against the authors' own code: same random weights, same draws."""

import json
import string
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from diffusers.models.autoencoders import vae as vae_module
from PIL import Image
from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModelWithProjection

from geodiff_plugin.cli.results import run_convert
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, FourierUNet
from geodiff_plugin.priors.geowizard import GeoWizardPipeline
from geodiff_plugin.priors.lotus import LotusPipeline
from geodiff_plugin.priors.marigold import E2EFTPipeline, E2EFTPrior
from tests.contracts.tiny_priors import make_tokenizer, quiet
from tests.parity import (
    depthfm_reference,
    depthmaster_reference,
    e2e_ft_reference,
    geowizard_reference,
    lotus_reference,
)
from tests.parity.named_weights import fill, weight
from tests.tiny import make_text_encoder

ATOL = 1e-4


def fixture_of(name: str) -> dict[str, np.ndarray]:
    with np.load(Path(__file__).with_name("fixtures") / f"{name}.npz") as file:
        return dict(file)


def same(ours, theirs: np.ndarray, name: str = "") -> None:
    np.testing.assert_allclose(torch.as_tensor(ours).detach().numpy(), theirs, 0, ATOL, err_msg=name)


def text_encoder(config: dict) -> CLIPTextModel:
    model = CLIPTextModel(CLIPTextConfig(**config)).eval()
    return fill(model, "text_encoder.", lambda name: name.removeprefix("text_model."))


# DepthFM -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def depthfm(tmp_path_factory):
    """From a checkpoint as theirs, by their names, through the command and the loader; and their results."""
    folder, theirs = tmp_path_factory.mktemp("depthfm"), fixture_of("depthfm")
    shapes = json.loads(str(theirs["shapes"]))
    state = {name: torch.from_numpy(weight(f"unet.{name}", tuple(shape))) for name, shape in shapes.items()}
    checkpoint = {
        "state_dict": state,
        "ldm_hparams": depthfm_reference.HPARAMS,
        "noising_step": depthfm_reference.NOISING_STEP,
        "empty_text_embedding": depthfm_reference.prompt(),  # a numpy array, as theirs
    }
    torch.save(checkpoint, folder / "depthfm.ckpt")
    fill(AutoencoderKL(**depthfm_reference.VAE), "vae.").save_pretrained(folder / "vae")
    run_convert([folder / "depthfm.ckpt", folder / "converted"], str(folder / "vae"))
    found = find_prior(folder / "converted")
    assert found.key == "depthfm" and found.licence == "mit"
    return quiet(found.load()), theirs


@torch.no_grad()
def depthfm_call(pipe, members: int, **reported):
    image = torch.from_numpy(depthfm_reference.image_u8()).permute(2, 0, 1)[None] / 127.5 - 1
    latents = pipe.image_latents(image, members, members)
    start = pipe.add_noise(latents, depthfm_reference.noise(tuple(latents.shape)))
    call = {"num_inference_steps": depthfm_reference.STEPS, "processing_resolution": 0, "latents": start}
    rgb = Image.fromarray(depthfm_reference.image_u8())
    return start, pipe(rgb, **call, ensemble_size=members, batch_size=members, **reported)


def test_depthfm_equals_the_authors_code(depthfm):
    pipe, theirs = depthfm
    velocities = []
    hook = pipe.unet.register_forward_hook(lambda module, inputs, output: velocities.append(output[0]))
    start, output = depthfm_call(pipe, 1, output_latent=True)
    hook.remove()
    same(start, theirs["start"])
    same(torch.cat(velocities), theirs["velocities"])
    same(output.latent, theirs["end"])
    same(2 * pipe.decode(output.latent)[0, 0, ::8, ::8] - 1, theirs["decoded"])
    same(output.prediction[0, ::8, ::8, 0], theirs["output"])


def test_depthfms_members_are_averaged_before_the_exponential(depthfm):
    pipe, theirs = depthfm
    _, output = depthfm_call(pipe, 2, output_uncertainty=True)
    same(output.prediction[0, ::8, ::8, 0], theirs["output_of_two"])
    assert output.uncertainty.shape == output.prediction.shape and (output.uncertainty > 0).all()


# DepthMaster and E2E-FT ----------------------------------------------------------------------------------


def test_depthmaster_equals_the_authors_code(monkeypatch):
    reference, theirs = depthmaster_reference, fixture_of("depthmaster")
    monkeypatch.setattr(DepthMasterPipeline, "prompt_embedding", lambda *_: reference.prompt())
    unet, vae = FourierUNet(**reference.UNET), AutoencoderKL(**reference.VAE)
    networks = fill(unet, "unet.").eval(), fill(vae, "vae.").eval()
    pipe = quiet(DepthMasterPipeline(*networks, make_text_encoder(), make_tokenizer()))
    call = {"image": Image.fromarray(reference.image_u8()), "processing_resolution": 0, "output_latent": True}
    output = pipe(**call)
    same(output.latent, theirs["network"])
    decoded = 2 * pipe.decode(output.latent)[0, 0, ::4, ::4] - 1
    same(decoded, theirs["decoded"])
    assert decoded.abs().max() > 1, "the fixture must show that the decode does not clip"
    same(output.prediction[0, ::4, ::4, 0], theirs["output"])
    for parameter in pipe.unet.fftblock.fuse.parameters():
        parameter.data.zero_()
    assert np.abs(pipe(**call).latent.numpy() - theirs["network"]).max() > 0.01, "the block does nothing"


def test_e2e_ft_equals_the_authors_code():
    reference, theirs, outputs = e2e_ft_reference, fixture_of("e2e_ft"), []
    pipe = E2EFTPipeline(
        fill(UNet2DConditionModel(**reference.UNET), "unet.").eval(),
        fill(AutoencoderKL(**reference.VAE), "vae.").eval(),
        DDIMScheduler(**reference.SCHEDULER),
        text_encoder(reference.TEXT),
        make_tokenizer(string.ascii_lowercase),
    )
    pipe.unet.register_forward_hook(lambda module, args, out: outputs.append(out[0]))
    ours = quiet(pipe)(Image.fromarray(reference.image_u8()), processing_resolution=0, output_latent=True)
    assert np.abs(theirs["network_output"]).max() > 0.1
    same(outputs[0], theirs["network_output"])
    same(ours.latent, theirs["latent"])
    same(2.0 * E2EFTPrior(pipe).decode(ours.latent)[0, 0, ::4, ::4] - 1.0, theirs["unclipped"])
    clipped = ours.prediction[0, ..., 0]
    stretched = (clipped - clipped.min()) / (clipped.max() - clipped.min())  # their last line
    same(stretched[::4, ::4], theirs["depth"])


# GeoWizard -----------------------------------------------------------------------------------------------


def make_geowizard(case: str) -> GeoWizardPipeline:
    reference = geowizard_reference
    width, _ = reference.CASES[case]
    if case.startswith("v1"):
        encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**reference.VISION))
        reported = {"image_encoder": fill(encoder, "image_encoder.").eval()}
    else:
        encoder = fill(CLIPTextModel(CLIPTextConfig(**reference.TEXT)), "text_encoder.").eval()
        reported = {"text_encoder": encoder, "tokenizer": make_tokenizer(string.ascii_lowercase)}
    unet = UNet2DConditionModel(**reference.UNET, projection_class_embeddings_input_dim=width)
    networks = fill(unet, "unet.").eval(), fill(AutoencoderKL(**reference.VAE), "vae.").eval()
    return quiet(GeoWizardPipeline(*networks, DDIMScheduler(**reference.SCHEDULER), **reported))


@pytest.mark.parametrize("case", geowizard_reference.CASES)
def test_geowizard_equals_the_authors_code(case):
    """Network output of the first and the last step, decoded maps without clipping, depth and normals."""
    reference, theirs = geowizard_reference, fixture_of("geowizard")
    pipe, seen = make_geowizard(case), []
    own = pipe.denoise

    def denoise(latents, timestep, condition):
        seen.append((condition, own(latents, timestep, condition)))
        return seen[-1][1]

    pipe.denoise = denoise
    noise = torch.from_numpy(reference.noise()).repeat(1, 2, 1, 1)
    call = {"num_inference_steps": reference.STEPS, "processing_resolution": 0, "output_latent": True}
    output = pipe(reference.image_u8(), latents=noise, domain=reference.CASES[case][1], **call)
    assert len(seen) == reference.STEPS
    same(seen[0][0]["prompt"][0], theirs[f"{case}/condition"])
    for i, name in ((0, "network_output"), (-1, "last_output")):
        pair = seen[i][1].reshape(2, 4, *seen[i][1].shape[2:])
        same(pair[:, :, ::2, ::2], theirs[f"{case}/{name}"], name)
    with torch.no_grad():
        depth, normals = output.latent.chunk(2, dim=1)
        unclipped = pipe.decode(depth)[0, 0] * 2.0 - 1.0
        assert unclipped.abs().max() > 1.0, "a case in which nothing is clipped says nothing"
        same(unclipped[::8, ::8], theirs[f"{case}/depth_unclipped"])
        same(pipe.decode_image(normals)[0, :, ::8, ::8], theirs[f"{case}/normals_unscaled"])
    same(output.prediction[0, ::8, ::8, 0], theirs[f"{case}/depth"])
    normals = output.extras["normals"][0]  # (H, W, 3); theirs are the opposite vectors
    same(-normals[::8, ::8].transpose(2, 0, 1), theirs[f"{case}/normals"])


def test_geowizards_depth_and_normals_are_coupled():
    """Each half of the answer has a gradient in the other half of the question; and so was the reference."""
    theirs, pipe = fixture_of("geowizard"), make_geowizard("v1_indoor")
    coupled = theirs["v1_indoor/network_output"]
    for other in ("uncoupled", "v1_object"):
        assert np.abs(coupled - theirs[f"{other}/network_output"]).max() > 100 * ATOL
    noise, width = (
        torch.from_numpy(geowizard_reference.noise()),
        geowizard_reference.UNET["cross_attention_dim"],
    )
    reported = {"prompt": torch.ones(1, 1, width), "class_labels": torch.ones(1, 2, 10)}
    latents = noise.repeat(1, 2, 1, 1).requires_grad_()
    output = pipe.denoise(latents, torch.tensor(500), {"image_latent": noise, **reported})
    halves = pipe.depth_channels, pipe.normal_channels
    for answer, question in (halves, halves[::-1]):
        (gradient,) = torch.autograd.grad(output[:, answer].square().sum(), latents, retain_graph=True)
        assert gradient[:, question].abs().max() > 1e-3


# Lotus ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", lotus_reference.CASES)
def test_lotus_equals_the_authors_code(case, monkeypatch):
    reference, theirs, seen = lotus_reference, fixture_of("lotus"), {}
    channels, _, resolution = reference.CASES[case]
    pipe = LotusPipeline(
        fill(UNet2DConditionModel(**reference.UNET, in_channels=channels), "unet.").eval(),
        reference.loud(fill(AutoencoderKL(**reference.VAE), "vae.")).eval(),
        text_encoder(reference.TEXT),
        make_tokenizer(),
        DirectScheduler(timestep=999),
        "depth",
    )

    def spy(module, arguments, options, output):
        seen["image_latent"], seen["prompt"] = arguments[0][0, :4], options["encoder_hidden_states"][0]
        seen["network_output"] = output[0][0]

    def drawn(what, shape):
        return torch.from_numpy(reference.drawn(case, what, tuple(shape)))

    pipe.unet.register_forward_hook(spy, with_kwargs=True)
    monkeypatch.setattr(vae_module, "randn_tensor", lambda shape, **_: drawn("posterior", shape))
    shape = theirs[f"{case}/network_output"].shape
    call = {"processing_resolution": resolution, "output_latent": True}
    call["latents"] = drawn("noise", (1, *shape)) if channels == 8 else None
    out = quiet(pipe)(Image.fromarray(reference.image_u8(case)), **call)
    seen["unclipped"] = reference.keep(pipe.decode(out.latent)[0, 0])
    seen["final"] = reference.keep(out.prediction[0, ..., 0])
    for name, ours in seen.items():
        same(ours, theirs[f"{case}/{name}"], name)
    assert shape[1] > 1 and theirs[f"{case}/network_output"].std() > 0.1


def test_the_fixture_of_lotus_shows_where_it_clips():
    theirs = fixture_of("lotus")
    unclipped = np.concatenate([theirs[f"{case}/unclipped"].ravel() for case in lotus_reference.CASES])
    assert unclipped.min() < 0.0 < 1.0 < unclipped.max()
    for case in lotus_reference.CASES:
        assert theirs[f"{case}/final"].std() > 0.01 and not np.isin(theirs[f"{case}/final"], (0.0, 1.0)).all()
