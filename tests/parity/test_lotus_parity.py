"""Lotus: our pipeline against the authors' own code on the same random weights and the same draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from diffusers.models.autoencoders import vae as vae_module
from PIL import Image
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.lotus import LotusPipeline
from tests.parity.lotus_reference import CASES, TEXT, UNET, VAE, drawn, image_u8, keep, loud, write_tokenizer
from tests.parity.named_weights import fill

FIXTURE = Path(__file__).parent / "fixtures" / "lotus.npz"


@pytest.fixture(scope="module")
def theirs():
    with np.load(FIXTURE) as file:
        return dict(file)


@pytest.fixture
def make_lotus(tmp_path):
    def make(channels: int) -> LotusPipeline:
        text_encoder = CLIPTextModel(CLIPTextConfig(**TEXT)).eval()
        pipe = LotusPipeline(
            unet=fill(UNet2DConditionModel(**UNET, in_channels=channels), "unet.").eval(),
            vae=loud(fill(AutoencoderKL(**VAE), "vae.")).eval(),
            text_encoder=fill(text_encoder, "text_encoder.", lambda name: name.removeprefix("text_model.")),
            tokenizer=CLIPTokenizer(*write_tokenizer(tmp_path), model_max_length=77),
            scheduler=DirectScheduler(timestep=999),
            prediction_type="depth",
        )
        pipe.set_progress_bar_config(disable=True)
        return pipe

    return make


@pytest.mark.parametrize("case", CASES)
def test_unguided_equals_the_authors_code(case, make_lotus, theirs, monkeypatch):
    channels, _, resolution = CASES[case]
    pipe = make_lotus(channels)
    seen = {}

    def spy(module, arguments, options, output):
        seen["image_latent"], seen["prompt"] = arguments[0][0, :4], options["encoder_hidden_states"][0]
        seen["network_output"] = output[0][0]

    pipe.unet.register_forward_hook(spy, with_kwargs=True)

    def posterior(shape, **_):
        return torch.from_numpy(drawn(case, "posterior", tuple(shape)))

    monkeypatch.setattr(vae_module, "randn_tensor", posterior)
    latents = None
    if channels == 8:
        latents = torch.from_numpy(drawn(case, "noise", (1, *theirs[f"{case}/network_output"].shape)))
    out = pipe(
        Image.fromarray(image_u8(case)),
        processing_resolution=resolution,
        latents=latents,
        output_latent=True,
    )
    with torch.no_grad():
        unclipped = pipe.decode_relative(out.latent)[0, 0]
    height, width = (8 * cells for cells in out.latent.shape[-2:])
    seen["unclipped"] = keep(unclipped[:height, :width])
    seen["final"] = keep(out.prediction[0, ..., 0])
    for name, ours in seen.items():
        expected = theirs[f"{case}/{name}"]
        assert ours.shape == expected.shape, name
        np.testing.assert_allclose(np.asarray(ours), expected, rtol=0, atol=1e-4, err_msg=name)


def test_the_fixture_tells_something(theirs):
    for case in CASES:
        assert theirs[f"{case}/network_output"].std() > 0.1
        final = theirs[f"{case}/final"]
        assert final.std() > 0.01 and not np.isin(final, (0.0, 1.0)).all()
    unclipped = np.concatenate([theirs[f"{case}/unclipped"].ravel() for case in CASES])
    assert unclipped.min() < 0.0 < 1.0 < unclipped.max()  # where clipping or not makes a difference
