"""E2E-FT: our pipeline against the authors' own code on the same random weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from PIL import Image
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from geodiff_plugin.priors.e2e_ft import E2EFTPipeline, E2EFTPrior
from tests.parity.e2e_ft_reference import SCHEDULER, TEXT, UNET, VAE, image_u8, write_tokenizer
from tests.parity.named_weights import fill

FIXTURE = Path(__file__).parent / "fixtures" / "e2e_ft.npz"


def test_unguided_equals_the_authors_code(tmp_path):
    write_tokenizer(tmp_path)
    text_encoder = CLIPTextModel(CLIPTextConfig(**TEXT)).eval()
    pipe = E2EFTPipeline(
        unet=fill(UNet2DConditionModel(**UNET), "unet.").eval(),
        vae=fill(AutoencoderKL(**VAE), "vae.").eval(),
        scheduler=DDIMScheduler(**SCHEDULER),
        text_encoder=fill(text_encoder, "text_encoder.", lambda name: name.removeprefix("text_model.")),
        tokenizer=CLIPTokenizer(
            str(tmp_path / "vocab.json"), str(tmp_path / "merges.txt"), model_max_length=77
        ),
    )
    pipe.set_progress_bar_config(disable=True)
    outputs = []
    pipe.unet.register_forward_hook(lambda module, args, out: outputs.append(out[0]))
    ours = pipe(Image.fromarray(image_u8()), processing_resolution=0, output_latent=True)
    with np.load(FIXTURE) as theirs:
        assert np.abs(theirs["network_output"]).max() > 0.1
        for name, value in (
            ("network_output", outputs[0]),
            ("latent", ours.latent),
            ("unclipped", (2.0 * E2EFTPrior(pipe).decode(ours.latent) - 1.0)[0, 0, ::4, ::4]),
        ):
            np.testing.assert_allclose(torch.as_tensor(value).detach().numpy(), theirs[name], atol=1e-4)
        clipped = ours.prediction[0, ..., 0]
        stretched = (clipped - clipped.min()) / (clipped.max() - clipped.min())  # their last line
        np.testing.assert_allclose(stretched[::4, ::4], theirs["depth"], atol=1e-4)
