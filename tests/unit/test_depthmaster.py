"""DepthMaster: its U-Net, and how its folder is recognised."""

from __future__ import annotations

import copy
import json

import pytest
import torch
from diffusers import UNet2DConditionModel

from geodiff_plugin.priors.depthmaster import DepthMasterPrior
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.pipelines.fourier_unet import FourierBlock
from tests.contracts.tiny_depthmaster import make_depthmaster


@pytest.fixture(scope="module")
def pipe():
    return make_depthmaster()


@pytest.fixture
def folder(pipe, tmp_path):
    pipe.save_pretrained(tmp_path)
    return tmp_path


def answer(unet) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    latent, prompt = torch.randn(1, 4, 6, 8, generator=generator), torch.randn(1, 2, 8, generator=generator)
    with torch.no_grad():
        return unet(latent, 1, encoder_hidden_states=prompt, return_dict=False)[0]


def test_the_block_follows_the_middle(pipe):
    """Also in a copy, whose block is its own."""
    stock = UNet2DConditionModel.from_config(pipe.unet.config)
    state = {k: v for k, v in pipe.unet.state_dict().items() if not k.startswith("fftblock.")}
    stock.load_state_dict(state)
    assert not torch.allclose(answer(stock), answer(pipe.unet), atol=1e-3)
    twin = copy.deepcopy(pipe.unet)
    torch.testing.assert_close(answer(twin), answer(pipe.unet))
    with torch.no_grad():
        twin.fftblock.fuse.weight.zero_()
        twin.fftblock.fuse.bias.zero_()
    assert not torch.allclose(answer(twin), answer(pipe.unet), atol=1e-3)


@pytest.mark.parametrize("size", [(4, 6), (5, 7)])
def test_the_block_in_half_precision_and_for_odd_sizes(size):
    torch.manual_seed(0)
    block, features = FourierBlock(8, groups=4), torch.randn(2, 8, *size)
    wide = block(features)
    half = block.to(torch.bfloat16)(features.to(torch.bfloat16))
    assert half.dtype == torch.bfloat16 and wide.shape == features.shape
    assert torch.isfinite(half).all() and (half.float() - wide).abs().median() < 0.1


def test_a_folder_without_the_block_is_refused(pipe, folder):
    """Stable Diffusion has the same config; its weights are not DepthMaster's."""
    UNet2DConditionModel.from_config(pipe.unet.config).save_pretrained(folder / "unet")
    with pytest.raises(ValueError, match=r"missing: fftblock\.conv_f1\.bias"):
        DepthMasterPrior.load(Layout(folder, "sd"), torch.float32, None)


def test_told_from_its_relatives(folder):
    layout = Layout(folder, "it")
    assert DepthMasterPrior.recognises(layout)
    index, config = json.loads((folder / "model_index.json").read_text()), folder / "unet" / "config.json"
    (folder / "model_index.json").write_text(
        json.dumps(index | {"scheduler": ["diffusers", "DDIMScheduler"]})
    )
    assert not DepthMasterPrior.recognises(Layout(folder, "stable diffusion"))
    (folder / "model_index.json").write_text(json.dumps(index))
    config.write_text(json.dumps(json.loads(config.read_text()) | {"class_embed_type": "projection"}))
    assert not DepthMasterPrior.recognises(Layout(folder, "lotus d"))


def test_deterministic_and_of_one_step(pipe):
    image = torch.rand(1, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    a, b = (pipe(image, generator=torch.Generator().manual_seed(s)).prediction for s in (1, 2))
    assert (a == b).all() and a.shape == (1, 48, 64, 1)
    with pytest.raises(ValueError, match="num_inference_steps"):
        pipe(image, num_inference_steps=2)


def test_space_can_be_told(folder):
    pipe = DepthMasterPrior.load(Layout(folder, "it"), torch.float32, "disparity")
    assert DepthMasterPrior(pipe).space == "disparity"
