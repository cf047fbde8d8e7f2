"""DepthMaster: our pipeline against the authors' own code on the same random weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL
from PIL import Image

from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, FourierUNet
from tests.conftest import make_text_encoder
from tests.parity.depthmaster_reference import UNET, VAE, image_u8, prompt
from tests.parity.named_weights import fill

FIXTURE = Path(__file__).parent / "fixtures" / "depthmaster.npz"


@pytest.fixture(scope="module")
def theirs():
    with np.load(FIXTURE) as file:
        return dict(file)


@pytest.fixture
def pipe(tokenizer, monkeypatch):
    monkeypatch.setattr(DepthMasterPipeline, "prompt_embedding", lambda *_: prompt())
    unet, vae = fill(FourierUNet(**UNET), "unet."), fill(AutoencoderKL(**VAE), "vae.")
    pipe = DepthMasterPipeline(unet.eval(), vae.eval(), make_text_encoder(), tokenizer)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def test_unguided_equals_the_authors_code(pipe, theirs):
    output = pipe(Image.fromarray(image_u8()), processing_resolution=0, output_latent=True)
    np.testing.assert_allclose(output.latent.numpy(), theirs["network"], atol=1e-4)
    with torch.no_grad():
        decoded = 2 * pipe.decode_relative(output.latent)[0, 0, ::4, ::4].numpy() - 1
    np.testing.assert_allclose(decoded, theirs["decoded"], atol=1e-4)
    assert np.abs(decoded).max() > 1, "the fixture must show that the decode does not clip"
    np.testing.assert_allclose(output.prediction[0, ::4, ::4, 0], theirs["output"], atol=1e-4)


def test_the_block_after_the_middle_matters(pipe, theirs):
    with torch.no_grad():
        for parameter in pipe.unet.fftblock.fuse.parameters():
            parameter.zero_()
    latent = pipe(Image.fromarray(image_u8()), processing_resolution=0, output_latent=True).latent
    assert np.abs(latent.numpy() - theirs["network"]).max() > 0.01
