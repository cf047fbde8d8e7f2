"""Names, configurations and merged weights of converted checkpoints, against NumPy and diffusers."""

import json

import numpy as np
import pytest
import torch
from diffusers import UNet2DConditionModel
from safetensors.torch import load_file, save_file

from geodiff_plugin.priors import convert


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


HPARAMS = {
    **{"in_channels": 8, "out_channels": 4, "model_channels": 32, "num_res_blocks": 1, "num_heads": 4},
    **{"channel_mult": [1, 2, 3], "attention_resolutions": [4, 2], "context_dim": 12},
}


def test_a_unets_options_make_the_network_that_they_describe():
    config = convert.unet_config(HPARAMS | {"use_linear_in_transformer": True})
    unet = UNet2DConditionModel(**config, norm_num_groups=8)
    assert (unet.conv_in.weight.shape[:2], unet.conv_out.weight.shape[0]) == ((32, 8), 4)
    assert [block.resnets[0].conv1.out_channels for block in unet.down_blocks] == [32, 64, 96]
    assert [hasattr(block, "attentions") for block in unet.down_blocks] == [False, True, True]
    assert [hasattr(block, "attentions") for block in unet.up_blocks] == [True, True, False]
    assert [len(block.resnets) for block in (*unet.down_blocks, *unet.up_blocks)] == [1, 1, 1, 2, 2, 2]
    attention = unet.down_blocks[1].attentions[0]
    assert attention.transformer_blocks[0].attn2.to_k.in_features == 12
    assert attention.transformer_blocks[0].attn1.heads == 4
    assert isinstance(attention.proj_in, torch.nn.Linear)
    assert convert.unet_config(HPARAMS)["use_linear_projection"] is False


def test_a_weight_is_replaced_or_has_the_product_of_its_factors_added():
    rng = torch.Generator().manual_seed(0)
    weight, other = torch.rand(5, 7, generator=rng), torch.rand(5, 7, generator=rng)
    down, up = torch.rand(2, 7, generator=rng), torch.rand(5, 2, generator=rng)
    assert convert.merged("w", weight, {}) is weight
    assert torch.equal(convert.merged("w", weight.half(), {"w": other}), other.half())
    factors = {"w A": down, "w B": up, "v A": other}
    expected = weight.numpy() + up.numpy() @ down.numpy()
    np.testing.assert_allclose(convert.merged("w", weight, factors), expected, rtol=1e-6)
    both = convert.merged("w", weight, factors | {"w": other})
    np.testing.assert_allclose(both, expected - weight.numpy() + other.numpy(), rtol=1e-6)
    assert convert.merged("w", weight.bfloat16(), factors).dtype == torch.bfloat16
    assert convert.merged("x", weight, factors) is weight


def test_names_of_trained_weights_are_those_of_the_base():
    state = {
        "Diffuser.block.base_layer.weight": 1,
        "Diffuser.block.lora_A.default.weight": 2,
        "Diffuser.block.lora_B.weight": 3,
        "VAE.conv.weight": 4,
    }
    assert convert._trained(state, "Diffuser") == {
        "block.weight": 1,
        "block.weight A": 2,
        "block.weight B": 3,
    }
    assert convert._trained(state, "VAE") == {"conv.weight": 4}
    assert convert._part({"dit.a": 1, "dit.b.dit.c": 2, "dita": 3, 5: 6}, "dit.") == {"a": 1, "b.dit.c": 2}


def test_safe_names_are_those_of_each_library():
    names = {
        "pytorch_model.bin": "model.safetensors",
        "pytorch_model-00001-of-00002.bin": "model-00001-of-00002.safetensors",
        "pytorch_model.bin.index.json": "model.safetensors.index.json",
        "diffusion_pytorch_model.bin": "diffusion_pytorch_model.safetensors",
        "config.json": "config.json",
    }
    assert {name: convert._safe_name(name) for name in names} == names


def test_tied_and_strided_weights_are_written_apart(tmp_path):
    weight = torch.rand(4, 6)
    state = {"a": weight, "b": weight, "c": weight.T, "d": weight[:, ::2]}
    convert._save_weights(state, tmp_path / "w.safetensors")
    found = load_file(tmp_path / "w.safetensors")
    assert set(found) == set(state) and all(torch.equal(found[k], v) for k, v in state.items())


def test_a_prompt_and_a_card_are_written_as_they_are_read(tmp_path):
    embedding = torch.rand(1, 4, 6, dtype=torch.float64)
    prompt = convert._fixed_prompt(embedding)
    assert torch.equal(prompt(), embedding.float()) and (prompt.config.length, prompt.config.width) == (4, 6)
    convert._write_card(tmp_path, "mit", "From somewhere.")
    assert (tmp_path / "README.md").read_text() == "---\nlicense: mit\n---\n\nFrom somewhere.\n"
    assert convert.Layout(tmp_path, "x").licence == "mit"


def test_files_of_a_base_are_those_of_its_index(tmp_path):
    folder = tmp_path / "vae"
    with pytest.raises(ValueError, match="BASE must be a folder of Qwen"):
        convert._base_files(tmp_path, "vae")
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    with pytest.raises(ValueError, match="got one without all of them"):
        convert._base_files(tmp_path, "vae")
    for name in ("b", "a", "old"):
        save_file({f"{name}.weight": torch.zeros(1)}, folder / f"{name}.safetensors")
    files, tensors = convert._base_files(tmp_path, "vae")
    assert [f.name for f in files] == ["a.safetensors", "b.safetensors", "old.safetensors"]
    assert tensors == {"a.weight", "b.weight", "old.weight"}
    index = {"weight_map": {"x": "b.safetensors", "y": "a.safetensors"}}
    (folder / convert.INDEX).write_text(json.dumps(index))
    files, tensors = convert._base_files(tmp_path, "vae")
    assert [f.name for f in files] == ["a.safetensors", "b.safetensors"] and tensors == {
        "a.weight",
        "b.weight",
    }
    (folder / "a.safetensors").unlink()
    with pytest.raises(ValueError, match="without all of a.safetensors, b.safetensors"):
        convert._base_files(tmp_path, "vae")


@pytest.mark.parametrize(
    ("words", "space", "message"),
    [
        (("a",), None, "Give two paths, SRC DST, or marigold-v2 BASE CHECKPOINT DST; got a"),
        ((), None, "got none"),
        (("a", "b", "c", "d"), None, "got a b c d"),
        (("marigold-v2", "b", "c"), None, "got marigold-v2 b c"),
        (("a", "b"), "log", "--space is for marigold-v2 alone: leave it out for a"),
        (("a", "here"), None, "DST must be a folder that does not exist yet; got"),
        (("a", "no/b"), None, "DST must be a folder that can be made"),
        (("missing", "b"), None, "SRC must be a checkpoint file or a folder"),
    ],
)
def test_paths_are_checked_before_anything_is_written(tmp_path, monkeypatch, words, space, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    with pytest.raises(ValueError, match=message):
        convert.convert_prior([convert.Path(word) for word in words], space=space)
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_a_folder_keeps_what_it_had_but_for_bin_files(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "unet").mkdir(parents=True)
    torch.save({"w": torch.ones(2)}, source / "unet" / "diffusion_pytorch_model.bin")
    torch.save({"w": torch.ones(3)}, source / "pytorch_model.bin")
    save_file({"w": torch.zeros(4)}, source / "model.safetensors")  # wins over its .bin
    for name in ("LICENSE", "licence.rst", "unet/config.json", "vocab.txt", "code.py", "a.msgpack"):
        (source / name).write_text("{}")
    assert convert.convert_prior([source, target]) == "folder"
    names = {str(p.relative_to(target)) for p in target.rglob("*") if p.is_file()}
    assert names == {
        *("unet/diffusion_pytorch_model.safetensors", "model.safetensors", "LICENSE", "licence.rst"),
        *("unet/config.json", "vocab.txt"),
    }
    assert load_file(target / "unet" / "diffusion_pytorch_model.safetensors")["w"].tolist() == [1, 1]
    assert load_file(target / "model.safetensors")["w"].tolist() == [0] * 4
    assert target.stat().st_mode & 0o777 == 0o755 and len(list(tmp_path.iterdir())) == 2


def test_a_checkpoint_of_an_unknown_kind_is_named_with_its_keys(tmp_path):
    file = tmp_path / "other.pt"
    torch.save({"first": torch.ones(2), "second": torch.ones(3)}, file)
    with pytest.raises(
        ValueError, match=r"SRC must be a checkpoint of a known kind \(depthfm, ppd\)"
    ) as error:
        convert._convert_file(file, tmp_path, None)
    assert f"got {file} with the keys first, second. docs/reference/priors.md" in str(error.value)


def test_a_prompt_that_is_nowhere_near_says_how_to_name_it(tmp_path):
    with pytest.raises(
        ValueError, match=r"--with must be the folder .* of huawei-bayerlab/marigold-v2-0"
    ) as error:
        convert._read_prompt(tmp_path / "weights.pt", None)
    assert "got none beside. Name it: --with .../" in str(error.value)
    with pytest.raises(ValueError, match=f"got {tmp_path / 'absent'}. Name it"):
        convert._read_prompt(tmp_path / "weights.pt", str(tmp_path / "absent"))
