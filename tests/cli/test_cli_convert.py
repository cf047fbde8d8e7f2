"""``geodiff convert``: pickled weights to a folder that loads, clear refusals, and nothing half-written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL
from safetensors.torch import load_file

from geodiff_plugin.cli.converters.depthfm import diffusers_name, unet_config
from geodiff_plugin.priors.depthfm import DepthFMPrior
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, DepthMasterPrior
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.pipelines.fourier_unet import FourierUNet
from tests.conftest import make_text_encoder, make_vae
from tests.parity.depthfm_reference import HPARAMS, VAE
from tests.parity.depthmaster_reference import UNET
from tests.parity.named_weights import fill, named_state

FIXTURE = Path(__file__).parents[1] / "parity" / "fixtures" / "depthfm.npz"


@pytest.fixture(scope="module")
def vae_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sd15") / "vae"
    fill(AutoencoderKL(**VAE), "vae.").save_pretrained(folder)
    return folder.parent


@pytest.fixture(scope="module")
def checkpoint():
    with np.load(FIXTURE) as file:
        shapes = json.loads(str(file["shapes"]))
    return {
        "state_dict": {name: value.float() for name, value in named_state(shapes).items()},
        "ldm_hparams": HPARAMS,
        "noising_step": 400,
        "empty_text_embedding": torch.zeros(1, 5, 16),
    }


@pytest.fixture
def convert(geodiff, tmp_path, vae_folder):
    """Save an object, convert it to ``out``; the answer, and what stands in the folder afterwards."""

    def run(content):
        torch.save(content, tmp_path / "weights.ckpt")
        answer = geodiff("convert", tmp_path / "weights.ckpt", tmp_path / "out", "--with", vae_folder)
        return answer, {path.name for path in tmp_path.iterdir()}

    return run


def refused(answer, left: set[str], *parts: str) -> None:
    assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
    assert all(part in answer.err for part in parts), answer.err
    assert left == {"weights.ckpt"}, "something was left behind"


def test_a_checkpoint_of_depthfm_loads(convert, checkpoint, tmp_path):
    answer, left = convert(checkpoint)
    assert answer.code == 0, answer.err
    assert left == {"weights.ckpt", "out"} and "(depthfm)" in answer.out and "--prior" in answer.out
    layout = Layout(tmp_path / "out", "out")
    assert DepthFMPrior.recognises(layout) and not DepthMasterPrior.recognises(layout)
    assert layout.licence == "mit"
    pipe = DepthFMPrior.load(layout, torch.float32, None)
    assert pipe.config.noising_step == 400 and pipe.config.prediction_type == "log"
    torch.testing.assert_close(
        pipe.unet.conv_in.weight, checkpoint["state_dict"]["input_blocks.0.0.weight"], rtol=0, atol=0
    )
    again, _ = convert(checkpoint)
    assert again.code == 2 and "does not exist yet" in again.err


def test_weights_that_do_not_fit_are_listed(convert, checkpoint):
    state = dict(checkpoint["state_dict"])
    del state["middle_block.1.proj_in.weight"]
    state |= {"middle_block.0.in_layers.1.weight": torch.ones(1), "label_emb.weight": torch.ones(1)}
    answer, left = convert(checkpoint | {"state_dict": state})
    refused(answer, left, "missing: mid_block.attentions.0.proj_in.weight", "unexpected: label_emb.weight")
    assert "middle_block.0.in_layers.1.weight" in answer.err


def test_options_beyond_the_network_are_named(convert, checkpoint):
    refused(*convert(checkpoint | {"ldm_hparams": {**HPARAMS, "num_classes": 4}}), "num_classes", "4")
    refused(*convert(checkpoint | {"ldm_hparams": {**HPARAMS, "colour": 1}}), "colour")
    short = {key: value for key, value in HPARAMS.items() if key != "context_dim"}
    refused(*convert(checkpoint | {"ldm_hparams": short}), "context_dim")


def test_an_unknown_checkpoint_is_named_by_its_keys(convert):
    content = {f"layer{i}.weight": torch.zeros(1) for i in range(10)}
    refused(*convert(content), "depthfm", "layer0.weight", "layer7.weight and 2 more")
    refused(*convert([1, 2]), "holds a mapping", "list")


class Foreign:
    """Not plain data."""


def test_nothing_is_run(convert):
    answer, left = convert({"state_dict": Foreign(), "empty_text_embedding": np.zeros(1)})
    refused(answer, left, "Foreign", "never done")
    assert "numpy" not in answer.err, "arrays are plain data"


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 torn"])
def test_files_that_are_no_checkpoints(geodiff, tmp_path, content):
    (tmp_path / "weights.ckpt").write_bytes(content)
    answer = geodiff("convert", tmp_path / "weights.ckpt", tmp_path / "out")
    refused(answer, {path.name for path in tmp_path.iterdir()}, "written by torch.save")


def test_paths_are_checked(geodiff, tmp_path, checkpoint):
    torch.save(checkpoint, tmp_path / "weights.ckpt")
    refused(geodiff("convert", tmp_path / "no.ckpt", tmp_path / "out"), {"weights.ckpt"}, "no.ckpt")
    refused(
        geodiff("convert", tmp_path / "weights.ckpt", tmp_path / "a/b"), {"weights.ckpt"}, "Make the folder"
    )
    missing = geodiff("convert", tmp_path / "weights.ckpt", tmp_path / "out", "--with", tmp_path / "sd")
    refused(missing, {path.name for path in tmp_path.iterdir()}, "--with", "Stable Diffusion 1.5")


def test_a_folder_of_bin_files(geodiff, tmp_path, tokenizer):
    """As DepthMaster's trainer writes them; index without a scheduler and with the authors' class names."""
    source = tmp_path / "theirs"
    text_encoder = make_text_encoder()
    unet = fill(FourierUNet(**UNET | {"cross_attention_dim": 8, "block_out_channels": (32, 32)}))
    DepthMasterPipeline(unet, make_vae(), text_encoder, tokenizer).save_pretrained(source)
    index = json.loads((source / "model_index.json").read_text())
    index["unet"] = ["depthmaster.modules.unet_2d_condition_s2", "UNet2DConditionModel"]
    index["_class_name"] = "DepthMasterPipeline"
    del index["prediction_type"], index["default_denoising_steps"]
    (source / "model_index.json").write_text(json.dumps(index))
    for path in list(source.rglob("*.safetensors")):
        torch.save(
            load_file(path),
            path.with_name("pytorch_model.bin" if path.stem == "model" else f"{path.stem}.bin"),
        )
        path.unlink()
    assert not list(source.rglob("*.safetensors"))

    answer = geodiff("convert", source, tmp_path / "out")
    assert answer.code == 0, answer.err
    assert not list((tmp_path / "out").rglob("*.bin"))
    layout = Layout(tmp_path / "out", "out")
    assert DepthMasterPrior.recognises(layout)
    pipe = DepthMasterPrior.load(layout, torch.float32, None)
    assert pipe.config.prediction_type == "sqrt_disparity"
    loaded = pipe.unet.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in unet.state_dict().items())

    again = geodiff("convert", tmp_path / "out", tmp_path / "more")
    assert again.code == 2 and "needs no conversion" in again.err


def test_shards_keep_their_index(geodiff, tmp_path):
    """As transformers names them; tensors that share memory are written each for itself."""
    source, weight = tmp_path / "theirs", torch.ones(2, 2)
    source.mkdir()
    shards = {"a": "pytorch_model-00001-of-00002.bin", "b": "pytorch_model-00002-of-00002.bin"}
    torch.save({"a": weight, "tied": weight}, source / shards["a"])
    torch.save({"b": weight.T}, source / shards["b"])
    (source / "pytorch_model.bin.index.json").write_text(json.dumps({"metadata": {}, "weight_map": shards}))
    assert geodiff("convert", source, tmp_path / "out").code == 0
    index = json.loads((tmp_path / "out" / "model.safetensors.index.json").read_text())["weight_map"]
    assert index == {k: f"model-0000{i}-of-00002.safetensors" for i, k in ((1, "a"), (2, "b"))}
    assert set(load_file(tmp_path / "out" / index["a"])) == {"a", "tied"}


def test_names_and_options_of_the_published_checkpoint():
    """Options as ``depthfm-v1.ckpt`` holds them: the U-Net of Stable Diffusion 2 with 8 heads."""
    hparams = HPARAMS | {
        "model_channels": 320,
        "attention_resolutions": [4, 2, 1],
        "channel_mult": [1, 2, 4, 4],
        "num_heads": 8,
        "context_dim": 1024,
    }
    config = unet_config(hparams)
    assert config["block_out_channels"] == (320, 640, 1280, 1280)
    assert config["down_block_types"] == ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",)
    assert config["up_block_types"] == ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3
    by_width = unet_config({**hparams, "num_head_channels": 64})
    assert config["attention_head_dim"] == 8 and by_width["attention_head_dim"] == (5, 10, 20, 20)
    assert diffusers_name("input_blocks.3.0.op.bias", 2) == "down_blocks.0.downsamplers.0.conv.bias"
    assert diffusers_name("output_blocks.2.1.conv.bias", 2) == "up_blocks.0.upsamplers.0.conv.bias"
    assert diffusers_name("output_blocks.5.2.conv.bias", 2) == "up_blocks.1.upsamplers.0.conv.bias"
    assert diffusers_name("betas", 2) is None
