"""``geodiff convert marigold-v2``: merged, kept apart, in shards; clear refusals, nothing half-written."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLQwenImage, QwenImageTransformer2DModel
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from geodiff_plugin.cli.converters.marigold_v2 import Trainables, read_prompt
from geodiff_plugin.priors import find_prior, load_prior, unmerged_lora
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from tests.parity import marigold_v2_reference as reference

IMAGE = np.random.default_rng(0).random((32, 48, 3), np.float32)


@pytest.fixture
def assets(tmp_path):
    """A tiny base, one checkpoint, the prompt's two files."""
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
def convert(geodiff, assets):
    def run(*options, checkpoint="V2/depth/Log-stage2"):
        paths = ("marigold-v2", assets / "base", assets / checkpoint, assets / "out")
        return geodiff("convert", *paths, *options)

    return run


def refused(answer, assets, *parts):
    assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
    assert all(part in answer.err for part in parts), answer.err
    assert {path.name for path in assets.iterdir()} <= {"base", "V2", "elsewhere"}, (
        "something was left behind"
    )


def test_a_merged_folder_loads_by_both_doors_and_is_saved_again(convert, assets, tmp_path):
    answer = convert()
    assert answer.code == 0, answer.err
    assert "(marigold-v2)" in answer.out and "--prior" in answer.out
    found = find_prior(assets / "out")
    assert (found.key, found.licence) == ("marigold-v2", "apache-2.0")
    ours, stock = load_prior(assets / "out"), MarigoldV2Pipeline.from_pretrained(assets / "out")
    ours.save_pretrained(tmp_path / "again")
    maps = []
    for pipe in (ours, stock, load_prior(tmp_path / "again")):
        pipe.set_progress_bar_config(disable=True)
        maps.append(pipe(IMAGE, processing_resolution=0).prediction)
    assert np.array_equal(maps[0], maps[1]) and np.allclose(maps[0], maps[2])
    assert ours.prompt.embedding.shape == (1, reference.KNOWN, 16)  # without its padding


def test_merging_adds_the_factors_product_and_replaces_the_decoder(convert, assets):
    convert()
    checkpoint = load_file(assets / "V2/depth/Log-stage2/trainables.safetensors")
    pipe = load_prior(assets / "out")
    name = "transformer_blocks.1.attn.to_out.0"
    base = QwenImageTransformer2DModel.from_pretrained(assets / "base" / "transformer", dtype=torch.float32)
    down, up = (checkpoint[f"Diffuser.{name}.lora_{f}.default.weight"].float() for f in "AB")
    wanted = (base.get_submodule(name).weight + up @ down).to(torch.bfloat16).float()
    assert torch.equal(pipe.transformer.get_submodule(name).weight, wanted)
    untouched = "transformer_blocks.1.img_mod.1.weight"
    assert torch.equal(pipe.transformer.get_parameter(untouched), base.get_parameter(untouched))
    decoder = checkpoint["VAE.decoder.conv_out.weight"].float()
    assert torch.equal(pipe.vae.decoder.conv_out.weight, decoder)


def test_the_files_of_the_base_keep_their_names_and_index(convert, assets):
    assert convert().code == 0
    folder = assets / "out" / "transformer"
    files = sorted(folder.glob("*.safetensors"))
    assert len(files) > 1
    index = json.loads((folder / "diffusion_pytorch_model.safetensors.index.json").read_text())
    assert set(index["weight_map"].values()) == {file.name for file in files}
    for file in files:
        with safe_open(file, "pt") as opened:
            assert {index["weight_map"][key] for key in opened.keys()} == {file.name}  # noqa: SIM118
    load_prior(assets / "out")


def test_a_lora_apart_is_put_on_by_peft(convert, assets):
    pytest.importorskip("peft", reason="peft is an extra")
    assert convert("--lora", "apart").code == 0
    kept = load_file(assets / "out" / "lora" / "lora.safetensors")
    assert "transformer_blocks.0.attn.to_q.lora_A.weight" in kept
    pipe = load_prior(assets / "out")
    assert unmerged_lora.has_lora(pipe.transformer)
    again = MarigoldV2Pipeline.from_pretrained(assets / "out")
    pipe.set_progress_bar_config(disable=True)
    again.set_progress_bar_config(disable=True)
    assert np.array_equal(pipe(IMAGE).prediction, again(IMAGE).prediction)
    with pytest.raises(ValueError, match="merged LoRA"):
        pipe.save_pretrained(assets / "elsewhere")


def test_a_base_without_its_lora_is_no_prior(convert, assets):
    convert("--lora", "apart")
    index = MarigoldV2Pipeline.load_config(assets / "out")
    assert index["lora"] == "apart" and index["prediction_type"] == "log"
    bare = QwenImageTransformer2DModel(**reference.TRANSFORMER)
    with pytest.raises(ValueError, match="LoRA that its folder keeps apart"):
        MarigoldV2Pipeline(bare, None, None, None, lora="apart")


def test_without_peft_the_sentence_says_what_to_install(convert, assets, monkeypatch):
    convert("--lora", "apart")
    monkeypatch.setattr(unmerged_lora, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"geodiff-plugin\[peft\]"):
        load_prior(assets / "out")


def test_four_bits_are_refused_without_cuda_in_a_sentence(convert, assets, monkeypatch):
    assert convert("--lora", "4bit").code == 0
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="CUDA device for a base in 4 bits"):
        load_prior(assets / "out")


def test_four_bits_are_asked_for_as_the_authors_hold_them(convert, assets, monkeypatch):
    pytest.importorskip("peft", reason="peft is an extra")
    convert("--lora", "4bit")
    asked = {}

    def load(layout, name, cls, dtype, extra=None):
        asked.update(extra)
        return load_component(layout, name, cls, dtype)

    load_component = unmerged_lora.load_component
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(unmerged_lora, "find_spec", lambda name: name)
    monkeypatch.setattr(unmerged_lora, "BitsAndBytesConfig", dict)
    monkeypatch.setattr(unmerged_lora, "load_component", load)
    pipe = load_prior(assets / "out", dtype=torch.bfloat16)
    config = asked["quantization_config"]
    assert config["bnb_4bit_quant_type"] == "nf4" and config["bnb_4bit_compute_dtype"] == torch.bfloat16
    assert config["llm_int8_skip_modules"] == ["transformer_blocks.0.img_mod"]
    assert unmerged_lora.has_lora(pipe.transformer)


@pytest.mark.parametrize(
    ("name", "space"),
    [("Log-layered", "log"), ("Uniform-base", "depth"), ("Disparity-layered", "disparity")],
)
def test_the_folders_name_tells_the_space(convert, assets, name, space):
    (assets / "V2/depth/Log-stage2").rename(assets / "V2/depth" / name)
    assert convert(checkpoint=f"V2/depth/{name}/trainables.safetensors").code == 0
    assert load_prior(assets / "out").config.prediction_type == space


def test_a_renamed_folder_needs_to_be_told(convert, assets):
    (assets / "V2/depth/Log-stage2").rename(assets / "V2/depth/mine")
    refused(convert(checkpoint="V2/depth/mine"), assets, "'mine'", "--space")
    assert convert("--space", "disparity", checkpoint="V2/depth/mine").code == 0
    assert load_prior(assets / "out").config.prediction_type == "disparity"


def test_what_is_missing_or_does_not_fit_is_named(convert, assets):
    file = assets / "V2/depth/Log-stage2/trainables.safetensors"
    good = load_file(file)
    key = "Diffuser.img_in.lora_A.default.weight"
    save_file(good | {"Diffuser.nowhere.weight": torch.zeros(2)}, file)
    refused(convert(), assets, "unexpected: nowhere.weight")
    save_file({k: v for k, v in good.items() if k != key}, file)
    refused(convert(), assets, "img_in.weight of factor A")
    save_file(good | {key: torch.zeros(4, 9)}, file)
    refused(convert(), assets, "img_in.weight", "factors of a matrix")
    save_file({k: v for k, v in good.items() if k.startswith("VAE.")}, file)
    refused(convert(), assets, "with a LoRA")
    save_file(good, file)
    (assets / "base/vae/config.json").unlink()
    refused(convert(), assets, "BASE", "vae/")
    refused(convert(checkpoint="V2/depth/nothing"), assets, "CHECKPOINT", "trainables.safetensors")


def test_prompts_are_looked_for_beside_and_read_as_plain_data(convert, assets, geodiff):
    prompts = assets / "V2" / "qwen_text_embeddings"
    prompts.rename(assets / "elsewhere")
    refused(convert(), assets, "--with", "qwen_text_embeddings")
    assert convert("--with", assets / "elsewhere").code == 0
    torch.save(torch.nn.Linear(2, 2), assets / "elsewhere" / f"{reference.PREFIX}_prompt_embeds.pt")
    with pytest.raises(ValueError, match="would run code"):
        read_prompt(assets / "elsewhere")
    torch.save({"a": 1}, assets / "elsewhere" / f"{reference.PREFIX}_prompt_embeds.pt")
    with pytest.raises(ValueError, match="holds a tensor"):
        read_prompt(assets / "elsewhere")


def test_a_prompt_with_holes_is_refused(tmp_path):
    torch.save(torch.zeros(1, 3, 4), tmp_path / f"{reference.PREFIX}_prompt_embeds.pt")
    torch.save(torch.tensor([[1, 0, 1]]), tmp_path / f"{reference.PREFIX}_prompt_mask.pt")
    with pytest.raises(ValueError, match="padded at its end"):
        read_prompt(tmp_path)


def test_a_layer_that_was_trained_whole_takes_the_bases_place(tmp_path):
    factors = {"Diffuser.a.base_layer.weight": torch.ones(2, 2), "Diffuser.b.bias": torch.ones(2)}
    save_file(factors, tmp_path / "t.safetensors")
    found = Trainables.of(tmp_path / "t.safetensors", "Diffuser")
    assert torch.equal(found.merged("a.weight", torch.zeros(2, 2)), torch.ones(2, 2))
    assert torch.equal(found.merged("c.weight", torch.zeros(2, 2)), torch.zeros(2, 2))


@pytest.mark.parametrize("paths", [("one",), ("a", "b", "c"), ("marigold", "a", "b", "c")])
def test_another_number_of_paths_is_refused(geodiff, paths):
    answer = geodiff("convert", *paths)
    assert answer.code == 2 and "SRC DST, or marigold-v2 BASE CHECKPOINT DST" in answer.err


def test_the_options_are_marigold_v2s_alone(geodiff, tmp_path):
    answer = geodiff("convert", tmp_path / "a.ckpt", tmp_path / "b", "--lora", "apart")
    assert answer.code == 2 and "marigold-v2 alone" in answer.err
