"""``geodiff convert``: folders that load, and refusals; numbers and other checkpoints: tests/parity."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, AutoencoderKLQwenImage, QwenImageTransformer2DModel
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline, FourierUNet
from tests.parity import marigold_v2_reference as reference
from tests.parity.depthfm_reference import HPARAMS, VAE
from tests.parity.depthmaster_reference import UNET
from tests.parity.named_weights import fill, named_state
from tests.tiny import make_text_encoder, make_tokenizer, make_vae

FIXTURE = Path(__file__).parents[1] / "parity" / "fixtures" / "depthfm.npz"


def refused(answer, folder, left: set[str], *parts: str) -> None:
    assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
    assert all(part in answer.err for part in parts), answer.err
    assert {path.name for path in folder.iterdir()} <= left, "something was left behind"


# A checkpoint (DepthFM) and what is wrong with others ----------------------------------------------------


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
def convert(geodiff, tmp_path, tmp_path_factory):
    """Save an object and convert it to ``out``."""

    def run(content):
        vae = tmp_path_factory.mktemp("vae")
        torch.save(content, tmp_path / "weights.ckpt")
        fill(AutoencoderKL(**VAE), "vae.").save_pretrained(vae)
        return geodiff("convert", tmp_path / "weights.ckpt", tmp_path / "out", "--with", vae)

    return run


def test_a_checkpoint_of_depthfm_loads(convert, checkpoint, tmp_path):
    answer = convert(checkpoint)
    assert answer.code == 0 and "(depthfm)" in answer.out and "--prior" in answer.out, answer.err
    assert {path.name for path in tmp_path.iterdir()} == {"weights.ckpt", "out"}
    found = find_prior(tmp_path / "out")
    assert (found.key, found.licence) == ("depthfm", "mit")
    pipe = found.load()
    assert pipe.config.noising_step == 400 and pipe.config.prediction_type == "log"
    assert torch.equal(pipe.unet.conv_in.weight, checkpoint["state_dict"]["input_blocks.0.0.weight"])


class Foreign:
    """Not plain data."""


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("weights", ("missing: mid_block.attentions.0.proj_in.weight", "label_emb.weight", "in_layers.1")),
        ({f"layer{i}.weight": torch.zeros(1) for i in range(10)}, ("layer0.weight", "layer7.weight")),
        ([1, 2], ("with a mapping", "list")),
        ({"state_dict": Foreign(), "empty_text_embedding": np.zeros(1)}, ("never done",)),
    ],
)
def test_checkpoints_that_do_not_fit(convert, checkpoint, content, parts, tmp_path):
    if content == "weights":
        state = dict(checkpoint["state_dict"])
        del state["middle_block.1.proj_in.weight"]
        state |= {"middle_block.0.in_layers.1.weight": torch.ones(1), "label_emb.weight": torch.ones(1)}
        content = checkpoint | {"state_dict": state}
    answer = convert(content)
    refused(answer, tmp_path, {"weights.ckpt"}, *parts)


# Folders of .bin files -----------------------------------------------------------------------------------


def test_a_folder_of_bin_files(geodiff, tmp_path):
    """As DepthMaster's trainer writes them; index without a scheduler and with the authors' class names."""
    source = tmp_path / "theirs"
    unet = fill(FourierUNet(**UNET | {"cross_attention_dim": 8, "block_out_channels": (32, 32)}))
    DepthMasterPipeline(unet, make_vae(), make_text_encoder(), make_tokenizer()).save_pretrained(source)
    index = json.loads((source / "model_index.json").read_text())
    index["unet"] = ["depthmaster.modules.unet_2d_condition_s2", "UNet2DConditionModel"]
    del index["prediction_type"], index["default_denoising_steps"]
    (source / "model_index.json").write_text(json.dumps(index))
    for path in list(source.rglob("*.safetensors")):
        name = "pytorch_model.bin" if path.stem == "model" else f"{path.stem}.bin"
        torch.save(load_file(path), path.with_name(name))
        path.unlink()
    answer = geodiff("convert", source, tmp_path / "out")
    assert answer.code == 0, answer.err
    assert not list((tmp_path / "out").rglob("*.bin"))
    found = find_prior(tmp_path / "out")
    pipe = found.load()
    assert found.key == "depthmaster" and pipe.config.prediction_type == "sqrt_disparity"
    torch.testing.assert_close(dict(pipe.unet.state_dict()), dict(unet.state_dict()), rtol=0, atol=0)


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


# Marigold V2 ---------------------------------------------------------------------------------------------


KEPT = {"base", "V2", "elsewhere"}


@pytest.fixture
def assets(tmp_path):
    """A tiny base in shards, one checkpoint, the prompt's two files."""
    transformer = QwenImageTransformer2DModel(**reference.TRANSFORMER)
    vae = AutoencoderKLQwenImage(**reference.VAE)
    transformer.load_state_dict(reference.base_state(transformer, "transformer."))
    transformer.to(torch.bfloat16).save_pretrained(tmp_path / "base" / "transformer", max_shard_size="100KB")
    vae.save_pretrained(tmp_path / "base" / "vae")
    folder = tmp_path / "V2" / "depth" / "Log-stage2"
    folder.mkdir(parents=True)
    save_file(reference.trainables("Log-stage2", transformer, vae), folder / "trainables.safetensors")
    (tmp_path / "V2" / "qwen_text_embeddings").mkdir()
    for part, value in zip(("embeds", "mask"), reference.prompts(), strict=True):
        name = f"{reference.PREFIX}_prompt_{part}.pt"
        torch.save(value, tmp_path / "V2" / "qwen_text_embeddings" / name)
    return tmp_path


@pytest.fixture
def convert_v2(geodiff, assets):
    def run(*options, checkpoint="V2/depth/Log-stage2"):
        paths = ("marigold-v2", assets / "base", assets / checkpoint, assets / "out")
        return geodiff("convert", *paths, *options)

    return run


def test_a_merged_v2_loads_and_keeps_files_and_index(convert_v2, assets):
    """Its numbers are those of the parity tests."""
    answer = convert_v2()
    assert answer.code == 0, answer.err
    found = find_prior(assets / "out")
    assert (found.key, found.licence) == ("marigold-v2", "apache-2.0")
    assert found.load().prompt.embedding.shape == (1, reference.KNOWN, 16), "not padded"
    folder = assets / "out" / "transformer"
    files = sorted(folder.glob("*.safetensors"))
    index = json.loads((folder / "diffusion_pytorch_model.safetensors.index.json").read_text())
    assert len(files) > 1 and set(index["weight_map"].values()) == {file.name for file in files}
    for file in files:
        with safe_open(file, "pt") as opened:
            assert {index["weight_map"][key] for key in opened.keys()} == {file.name}  # noqa: SIM118


def test_what_is_missing_or_does_not_fit_v2_is_named(convert_v2, assets):
    file = assets / "V2/depth/Log-stage2/trainables.safetensors"
    good, key = load_file(file), "Diffuser.img_in.lora_A.default.weight"
    for state, parts in (
        (good | {"Diffuser.nowhere.weight": torch.zeros(2)}, ("unexpected: nowhere.weight",)),
        ({k: v for k, v in good.items() if k != key}, ("LoRA factor A of img_in.weight",)),
        ({k: v for k, v in good.items() if k.startswith("VAE.")}, ("with a LoRA",)),
    ):
        save_file(state, file)
        refused(convert_v2(), assets, KEPT, *parts)
    save_file(good, file)
    (assets / "base/vae/config.json").unlink()
    refused(convert_v2(), assets, KEPT, "BASE", "vae/")
    refused(convert_v2(checkpoint="V2/depth/nothing"), assets, KEPT, "CHECKPOINT", "trainables.safetensors")


def test_prompts_of_v2_are_looked_up_next_to_the_checkpoint_or_given(convert_v2, assets):
    (assets / "V2" / "qwen_text_embeddings").rename(assets / "elsewhere")
    refused(convert_v2(), assets, KEPT, "--with", "qwen_text_embeddings")
    assert convert_v2("--with", assets / "elsewhere").code == 0
