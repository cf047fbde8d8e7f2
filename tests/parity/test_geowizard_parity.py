"""Our GeoWizard pipeline against the authors' own code, with the same weights and the same noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from transformers import (
    CLIPTextConfig,
    CLIPTextModel,
    CLIPTokenizer,
    CLIPVisionConfig,
    CLIPVisionModelWithProjection,
)

from geodiff_plugin.priors.geowizard import GeoWizardPipeline
from geodiff_plugin.priors.pipeline import decode_picture
from tests.parity import geowizard_reference as reference
from tests.parity.named_weights import fill

THEIRS = np.load(Path(__file__).with_name("fixtures") / "geowizard.npz")
TOLERANCE = {"rtol": 0.0, "atol": 1e-4}


def make(case: str, folder: Path) -> GeoWizardPipeline:
    """Ours, from the configurations of the reference."""
    width, _ = reference.CASES[case]
    unet = UNet2DConditionModel(**reference.UNET, projection_class_embeddings_input_dim=width)
    if case.startswith("v1"):
        encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**reference.VISION))
        told = {"image_encoder": fill(encoder, "image_encoder.")}
    else:
        reference.write_tokenizer(folder)
        told = {
            "text_encoder": fill(CLIPTextModel(CLIPTextConfig(**reference.TEXT)), "text_encoder."),
            "tokenizer": CLIPTokenizer(f"{folder}/vocab.json", f"{folder}/merges.txt", model_max_length=77),
        }
    pipe = GeoWizardPipeline(
        unet=fill(unet, "unet."),
        vae=fill(AutoencoderKL(**reference.VAE), "vae."),
        scheduler=DDIMScheduler(**reference.SCHEDULER),
        **told,
    )
    for module in pipe.components.values():
        if isinstance(module, torch.nn.Module):
            module.eval()
    pipe.set_progress_bar_config(disable=True)
    return pipe


def same(ours: torch.Tensor | np.ndarray, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(np.asarray(ours), theirs, **TOLERANCE)


@pytest.fixture(scope="module", params=list(reference.CASES))
def called(request, tmp_path_factory):
    """Name of the case, the pipeline, its network's inputs and outputs, its output."""
    pipe = make(request.param, tmp_path_factory.mktemp("tokenizer"))
    seen, own = [], pipe.denoise

    def denoise(latents, timestep, condition):
        seen.append((condition, own(latents, timestep, condition)))
        return seen[-1][1]

    pipe.denoise = denoise
    output = pipe(
        reference.image_u8(),
        num_inference_steps=reference.STEPS,
        processing_resolution=0,
        latents=torch.from_numpy(reference.noise()).repeat(1, 2, 1, 1),
        domain=reference.CASES[request.param][1],
        output_latent=True,
    )
    return request.param, pipe, seen, output


def test_condition(called):
    case, _, seen, _ = called
    same(seen[0][0]["prompt"][0], THEIRS[f"{case}/condition"])


def test_network_output_of_the_first_and_the_last_step(called):
    case, _, seen, _ = called
    assert len(seen) == reference.STEPS
    for i, name in ((0, "network_output"), (-1, "last_output")):
        pair = seen[i][1].reshape(2, 4, *seen[i][1].shape[2:])
        same(pair[:, :, ::2, ::2], THEIRS[f"{case}/{name}"])


@torch.no_grad()
def test_unclipped_decode(called):
    case, pipe, _, output = called
    depth, normals = output.latent.chunk(2, dim=1)
    unclipped = pipe.decode_relative(depth)[0, 0] * 2.0 - 1.0
    assert unclipped.abs().max() > 1.0, "a case in which nothing is clipped says nothing"
    same(unclipped[::8, ::8], THEIRS[f"{case}/depth_unclipped"])
    same(decode_picture(pipe.vae, normals)[0, :, ::8, ::8], THEIRS[f"{case}/normals_unscaled"])


def test_final_depth_and_normals(called):
    case, _, _, output = called
    same(output.prediction[0, ::8, ::8, 0], THEIRS[f"{case}/depth"])
    normals = output.extras["normals"][0]  # (H, W, 3); theirs are the opposite vectors
    same(-normals[::8, ::8].transpose(2, 0, 1), THEIRS[f"{case}/normals"])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-3)


def test_the_domain_matters_and_the_reference_was_coupled():
    """Without xformers their cross-domain attention stays off, and the output is another."""
    coupled = THEIRS["v1_indoor/network_output"]
    assert np.abs(coupled - THEIRS["uncoupled/network_output"]).max() > 100 * TOLERANCE["atol"]
    assert np.abs(coupled - THEIRS["v1_object/network_output"]).max() > 100 * TOLERANCE["atol"]


def test_depth_and_normals_are_coupled_in_the_network(tmp_path):
    """Each half of the answer has a gradient in the other half of the question."""
    pipe = make("v1_indoor", tmp_path)
    noise = torch.from_numpy(reference.noise())
    condition = {
        "image_latent": noise,
        "prompt": torch.ones(1, 1, reference.UNET["cross_attention_dim"]),
        "class_labels": torch.ones(1, 2, 10),
    }
    latents = noise.repeat(1, 2, 1, 1).requires_grad_()
    output = pipe.denoise(latents, torch.tensor(500), condition)
    for answer, question in ((pipe.depth_channels, slice(4, 8)), (slice(4, 8), pipe.depth_channels)):
        (gradient,) = torch.autograd.grad(output[:, answer].square().sum(), latents, retain_graph=True)
        assert gradient[:, question].abs().max() > 1e-3
