"""DepthFM: ``geodiff convert`` and our pipeline against the authors' own code on the same random weights."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL
from PIL import Image

from geodiff_plugin.cli.convert import run_convert
from geodiff_plugin.priors.depthfm import DepthFMPrior
from geodiff_plugin.priors.loading import Layout
from tests.parity.depthfm_reference import HPARAMS, NOISING_STEP, STEPS, VAE, image_u8, noise, prompt
from tests.parity.named_weights import fill, weight

FIXTURE = Path(__file__).parent / "fixtures" / "depthfm.npz"


@pytest.fixture(scope="module")
def theirs():
    with np.load(FIXTURE) as file:
        return dict(file)


@pytest.fixture(scope="module")
def pipe(theirs, tmp_path_factory):
    """From a checkpoint as theirs, by their names, through the command and the loader."""
    folder = tmp_path_factory.mktemp("depthfm")
    shapes = json.loads(str(theirs["shapes"]))
    state = {name: torch.from_numpy(weight(f"unet.{name}", tuple(shape))) for name, shape in shapes.items()}
    checkpoint = {
        "state_dict": state,
        "ldm_hparams": HPARAMS,
        "noising_step": NOISING_STEP,
        "empty_text_embedding": prompt(),  # a numpy array, as theirs
    }
    torch.save(checkpoint, folder / "depthfm.ckpt")
    fill(AutoencoderKL(**VAE), "vae.").save_pretrained(folder / "vae")
    run_convert([folder / "depthfm.ckpt", folder / "converted"], str(folder / "vae"))
    layout = Layout(folder / "converted", "converted")
    assert DepthFMPrior.recognises(layout) and layout.licence == "mit"
    pipe = DepthFMPrior.load(layout, torch.float32, None)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def start(pipe, members: int) -> torch.Tensor:
    image = torch.from_numpy(image_u8()).permute(2, 0, 1)[None] / 127.5 - 1
    latents = pipe.image_latents(image, members, members)
    return pipe.add_noise(latents, noise(tuple(latents.shape)))


@torch.no_grad()
def test_unguided_equals_the_authors_code(pipe, theirs):
    velocities = []
    hook = pipe.unet.register_forward_hook(lambda module, inputs, output: velocities.append(output[0]))
    latents = start(pipe, 1)
    np.testing.assert_allclose(latents.numpy(), theirs["start"], atol=1e-4)
    output = pipe(
        Image.fromarray(image_u8()),
        num_inference_steps=STEPS,
        processing_resolution=0,
        latents=latents,
        output_latent=True,
    )
    hook.remove()
    np.testing.assert_allclose(torch.cat(velocities).numpy(), theirs["velocities"], atol=1e-4)
    np.testing.assert_allclose(output.latent.numpy(), theirs["end"], atol=1e-4)
    decoded = 2 * pipe.decode_relative(output.latent)[0, 0, ::8, ::8].numpy() - 1
    np.testing.assert_allclose(decoded, theirs["decoded"], atol=1e-4)
    np.testing.assert_allclose(output.prediction[0, ::8, ::8, 0], theirs["output"], atol=1e-4)


@torch.no_grad()
def test_members_are_averaged_before_the_exponential(pipe, theirs):
    output = pipe(
        Image.fromarray(image_u8()),
        num_inference_steps=STEPS,
        ensemble_size=2,
        batch_size=2,
        processing_resolution=0,
        latents=start(pipe, 2),
        output_uncertainty=True,
    )
    np.testing.assert_allclose(output.prediction[0, ::8, ::8, 0], theirs["output_of_two"], atol=1e-4)
    assert output.uncertainty.shape == output.prediction.shape and (output.uncertainty > 0).all()
