"""Names, configurations and merged weights of converted checkpoints, against NumPy and diffusers."""

import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from safetensors.torch import load_file, save_file
from transformers import Dinov2Config, Dinov2Model

from geodiff_plugin.priors import convert
from geodiff_plugin.priors.ppd import PixelDiT, PPDPipeline
from tests.parity import depthfm_reference


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
    assert convert.Trained({}, {}).merged("w", weight) is weight
    assert torch.equal(convert.Trained({"w": other}, {}).merged("w", weight.half()), other.half())
    factors = {"w": {"A": down, "B": up}}
    trained, expected = convert.Trained({}, factors), weight.numpy() + up.numpy() @ down.numpy()
    np.testing.assert_allclose(trained.merged("w", weight), expected, rtol=1e-6)
    both = convert.Trained({"w": other}, factors).merged("w", weight)
    np.testing.assert_allclose(both, expected - weight.numpy() + other.numpy(), rtol=1e-6)
    assert trained.merged("w", weight.bfloat16()).dtype == torch.bfloat16
    assert trained.merged("x", weight) is weight


def test_names_of_trained_weights_are_those_of_the_base():
    state = {
        "Diffuser.block.base_layer.weight": 1,
        "Diffuser.block.lora_A.default.weight": 2,
        "Diffuser.block.lora_B.weight": 3,
        "VAE.conv.weight": 4,
    }
    factors = {"block.weight": {"A": 2, "B": 3}}
    assert convert._trained(state, "Diffuser") == convert.Trained({"block.weight": 1}, factors)
    assert convert._trained(state, "VAE") == convert.Trained({"conv.weight": 4}, {})
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


def test_tied_and_strided_weights_are_written_separately(tmp_path):
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
    with pytest.raises(ValueError, match="got a folder without some of them"):
        convert._base_files(tmp_path, "vae")
    for name in ("b", "a", "old"):
        save_file({f"{name}.weight": torch.zeros(1)}, folder / f"{name}.safetensors")
    files, shapes = convert._base_files(tmp_path, "vae")
    assert [f.name for f in files] == ["a.safetensors", "b.safetensors", "old.safetensors"]
    assert shapes == {"a.weight": (1,), "b.weight": (1,), "old.weight": (1,)}
    index = {"weight_map": {"x": "b.safetensors", "y": "a.safetensors"}}
    (folder / convert.INDEX).write_text(json.dumps(index))
    files, shapes = convert._base_files(tmp_path, "vae")
    assert [f.name for f in files] == ["a.safetensors", "b.safetensors"]
    assert set(shapes) == {"a.weight", "b.weight"}
    (folder / "a.safetensors").unlink()
    with pytest.raises(ValueError, match="without some of a.safetensors, b.safetensors"):
        convert._base_files(tmp_path, "vae")


@pytest.mark.parametrize(
    ("words", "space", "message"),
    [
        (("a",), None, "Pass two paths, SRC DST, or marigold-v2 BASE CHECKPOINT DST; got a"),
        ((), None, "got none"),
        (("a", "b", "c", "d"), None, "got a b c d"),
        (("marigold-v2", "b", "c"), None, "got marigold-v2 b c"),
        (("a", "b"), "log", "--space applies to marigold-v2 only: omit it for a"),
        (("a", "here"), None, "DST must be a folder that does not exist yet; got"),
        (("a", "no/b"), None, "DST must be a folder that can be created"),
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
        ValueError, match=r"SRC must be a checkpoint of a known type \(depthfm, ppd\)"
    ) as error:
        convert._convert_file(file, tmp_path, None)
    assert f"got {file} with the keys first, second. docs/reference/priors.md" in str(error.value)


def test_for_a_missing_prompt_the_error_states_how_to_pass_it(tmp_path):
    with pytest.raises(
        ValueError, match=r"--with must be the folder .* of huawei-bayerlab/marigold-v2-0"
    ) as error:
        convert._read_prompt(tmp_path / "weights.pt", None)
    assert "got none found. Pass it: --with .../" in str(error.value)
    with pytest.raises(ValueError, match=f"got {tmp_path / 'absent'}. Pass it"):
        convert._read_prompt(tmp_path / "weights.pt", str(tmp_path / "absent"))


# Whole checkpoints

#: Name of a factor of the LoRA in ``assets_of_marigold_v2``.
LORA = "Diffuser.block.lora_{}.default.weight"


def assets_of_marigold_v2(folder, name="Log-stage2", masked=2):
    """Tiny files laid out as the authors' downloads; the base's and the trained tensors, and the prompt."""
    base = {
        "transformer": {
            "block.weight": torch.rand(4, 6),
            "norm.weight": torch.rand(4),
            "out.bias": torch.rand(3),
        },
        "vae": {"conv.weight": torch.rand(2, 3), "conv.bias": torch.rand(2)},
    }
    for part, state in base.items():
        (folder / "base" / part).mkdir(parents=True)
        (folder / "base" / part / "config.json").write_text(json.dumps({"of": part}))
        names = sorted(state)
        shards = {names[0]: "a.safetensors"} | dict.fromkeys(names[1:], "b.safetensors")
        for shard in ("a.safetensors", "b.safetensors"):
            tensors = {n: state[n].bfloat16() for n in names if shards[n] == shard}
            save_file(tensors, folder / "base" / part / shard)
        if part == "transformer":
            (folder / "base" / part / convert.INDEX).write_text(json.dumps({"weight_map": shards}))
    trained = {
        "Diffuser.block.lora_A.default.weight": torch.rand(2, 6),
        "Diffuser.block.lora_B.default.weight": torch.rand(4, 2),
        "Diffuser.norm.base_layer.weight": torch.rand(4),
        "VAE.conv.weight": torch.rand(2, 3),
    }
    checkpoint = folder / "Marigold-V2" / "depth" / name
    checkpoint.mkdir(parents=True)
    save_file(trained, checkpoint / convert.TRAINABLES)
    prompts = folder / "Marigold-V2" / convert.PROMPT_FOLDER
    prompts.mkdir()
    embedding, mask = torch.rand(2, 5, 8).bfloat16(), torch.arange(5).expand(2, 5) < masked
    torch.save(embedding, prompts / f"{convert.PROMPT}_prompt_embeds.pt")
    torch.save(mask.long(), prompts / f"{convert.PROMPT}_prompt_mask.pt")
    return base, trained, embedding[:1, :masked]


def test_a_trained_checkpoint_and_its_base_become_one_folder(tmp_path):
    base, trained, prompt = assets_of_marigold_v2(tmp_path)
    paths = "marigold-v2", tmp_path / "base", tmp_path / "Marigold-V2/depth/Log-stage2", tmp_path / "out"
    assert convert.convert_prior([convert.Path(path) for path in paths]) == "marigold-v2"
    wanted = {part: {n: v.bfloat16() for n, v in state.items()} for part, state in base.items()}
    product = (
        trained["Diffuser.block.lora_B.default.weight"] @ trained["Diffuser.block.lora_A.default.weight"]
    )
    block = wanted["transformer"]["block.weight"].float() + product
    wanted["transformer"]["block.weight"] = block.bfloat16()
    wanted["transformer"]["norm.weight"] = trained["Diffuser.norm.base_layer.weight"].bfloat16()
    wanted["vae"]["conv.weight"] = trained["VAE.conv.weight"].bfloat16()
    for part, state in wanted.items():
        source, folder = tmp_path / "base" / part, tmp_path / "out" / part
        assert {p.name for p in folder.iterdir()} == {p.name for p in source.iterdir()}
        files = sorted(folder.glob("*.safetensors"))
        assert [set(load_file(f)) for f in files] == [set(load_file(source / f.name)) for f in files]
        found = {name: value for f in files for name, value in load_file(f).items()}
        assert all(torch.equal(found[name], value) for name, value in state.items())
        assert json.loads((folder / "config.json").read_text()) == {"of": part}
    saved = load_file(tmp_path / "out" / "prompt" / "diffusion_pytorch_model.safetensors")["embedding"]
    assert torch.equal(saved, prompt) and saved.dtype == torch.bfloat16
    index = json.loads((tmp_path / "out" / "model_index.json").read_text())
    assert index == convert.INDEX_OF_PRIOR | {"prediction_type": "log"}
    assert convert.Layout(tmp_path / "out", "x").licence == "apache-2.0"
    assert (tmp_path / "out" / "scheduler" / "scheduler_config.json").is_file()
    defaults = convert.MarigoldV2Pipeline.__init__
    options = {
        n: index[n] for n in ("sample_latent", "default_denoising_steps", "default_processing_resolution")
    }
    parameters = inspect.signature(defaults).parameters
    assert options == {name: parameters[name].default for name in options}
    assert {name for name, entry in index.items() if isinstance(entry, list)} == {
        name for name, p in parameters.items() if name != "self" and p.default is p.empty
    }


@pytest.mark.parametrize(
    ("name", "given", "space"),
    [
        ("Log-stage2", None, "log"),
        ("Uniform-stage1", None, "depth"),
        ("disparity", None, "disparity"),
        ("Log-stage2", "disparity", "disparity"),
        ("mine", "log", "log"),
        ("mine", None, None),
    ],
)
def test_the_space_is_the_users_or_the_first_word_of_the_checkpoints_folder(tmp_path, name, given, space):
    assets_of_marigold_v2(tmp_path, name)
    file = tmp_path / "Marigold-V2" / "depth" / name / convert.TRAINABLES
    call = tmp_path / "base", file, tmp_path / "out", None, given
    (tmp_path / "out").mkdir()
    if space is None:
        with pytest.raises(ValueError, match=r"CHECKPOINT must be in a folder called Log-.*; got 'mine'"):
            convert._convert_marigold_v2(*call)
        return
    convert._convert_marigold_v2(*call)
    assert json.loads((tmp_path / "out" / "model_index.json").read_text())["prediction_type"] == space


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.pop(LORA.format("B")), "missing: LoRA factor B of block.weight"),
        (lambda t: t.pop(LORA.format("A")), "missing: LoRA factor A of block.weight"),
        (lambda t: t.update({"VAE.other.weight": torch.ones(1)}), "unexpected: other.weight"),
        (
            lambda t: [t.pop(LORA.format(factor)) for factor in "AB"],
            r"a checkpoint of Marigold V2 with a LoRA \(Diffuser.*; got no LoRA",
        ),
        (
            lambda t: t.update({"Diffuser.norm.base_layer.weight": torch.rand(5)}),
            r"norm.weight in .* must be of the base's shape \(4,\); got \(5,\)",
        ),
        (
            lambda t: t.update({"VAE.conv.weight": torch.rand(2, 9)}),
            r"conv.weight in .* must be of the base's shape \(2, 3\); got \(2, 9\)",
        ),
        (
            lambda t: t.update({LORA.format("A"): torch.rand(2, 7)}),
            r"block.weight in .* must be of the base's shape \(4, 6\); got \(4, 2\) @ \(2, 7\)",
        ),
        (
            lambda t: t.update({LORA.format("A"): torch.rand(3, 6)}),
            r"block.weight in .* must be of the base's shape \(4, 6\); got \(4, 2\) @ \(3, 6\)",
        ),
        (
            lambda t: t.update({LORA.format("A"): torch.rand(2, 6, 1, 1)}),
            r"block.weight in .*; got \(4, 2\) @ \(2, 6, 1, 1\)",
        ),
    ],
)
def test_trained_weights_that_do_not_fit_the_base_are_named_before_anything_is_written(
    tmp_path, change, words
):
    _, trained, _ = assets_of_marigold_v2(tmp_path)
    change(trained)
    file = tmp_path / "trained.safetensors"
    save_file(trained, file)
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=words) as error:
        convert._merge_into_base(tmp_path / "base", file, out)
    assert str(file) in str(error.value) and not out.exists()


@pytest.mark.parametrize(
    "name",
    ["Marigold-V2/depth/Log-stage2/trainables.safetensors", "base/vae/b.safetensors"],
)
@pytest.mark.parametrize("length", [6, 60, -8])
def test_a_truncated_file_is_reported_by_its_name(tmp_path, name, length):
    assets_of_marigold_v2(tmp_path)
    file = tmp_path / name
    file.write_bytes(file.read_bytes()[:length])
    paths = "marigold-v2", tmp_path / "base", tmp_path / "Marigold-V2/depth/Log-stage2", tmp_path / "out"
    with pytest.raises(ValueError, match="must be a whole safetensors file; got a damaged one") as error:
        convert.convert_prior([Path(path) for path in paths])
    assert str(error.value).startswith(str(file))
    assert {path.name for path in tmp_path.iterdir()} == {"base", "Marigold-V2"}


def test_a_checkpoint_is_a_folder_with_the_authors_file_or_a_file_of_safetensors(tmp_path):
    assets_of_marigold_v2(tmp_path)
    (tmp_path / "x.pt").touch()
    for wrong in (tmp_path / "base", tmp_path / "x.pt", tmp_path / "absent.safetensors"):
        with pytest.raises(ValueError, match="CHECKPOINT must be a folder of huawei-bayerlab") as error:
            convert._convert_marigold_v2(tmp_path / "base", wrong, tmp_path / "out", None, None)
        assert f"got {wrong}. Check the path" in str(error.value)


@pytest.mark.parametrize("beside", [True, False])
def test_a_prompt_is_the_first_of_its_folder_without_its_padding(tmp_path, beside):
    *_, prompt = assets_of_marigold_v2(tmp_path, masked=3)
    file = tmp_path / "Marigold-V2" / "depth" / "Log-stage2" / convert.TRAINABLES
    folder = tmp_path / "Marigold-V2" / convert.PROMPT_FOLDER
    found = convert._read_prompt(file if beside else tmp_path / "x", None if beside else str(folder))
    assert torch.equal(found, prompt) and found.shape == (1, 3, 8)


SMALL = {
    "hidden_size": 24,
    "depth": 3,
    "num_heads": 3,
    "patch_size": 4,
    "semantic_size": 32,
    "mlp_ratio": 1.5,
}


def save_depth_anything(folder, width=32):
    """The encoder of a Depth Anything V2 as transformers saves it, and the encoder."""
    sizes = {"hidden_size": width, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_ratio": 2}
    sizes |= {"image_size": 42, "patch_size": 14}
    encoder = Dinov2Model(Dinov2Config(**sizes)).eval()
    folder.mkdir()
    state = {f"backbone.{name}": value.clone() for name, value in encoder.state_dict().items()}
    save_file(state | {"head.x": torch.ones(1)}, folder / "model.safetensors")
    backbone = sizes | {"out_features": ["stage1"], "reshape_hidden_states": False}
    (folder / "config.json").write_text(json.dumps({"backbone_config": backbone}))
    return encoder


def test_a_transformer_has_the_sizes_of_its_weights():
    dit = PixelDiT(**SMALL)
    found = convert._load_transformer(dit.state_dict())
    assert {name: found.config[name] for name in SMALL} == SMALL and not found.training
    assert all(torch.equal(value, found.state_dict()[name]) for name, value in dit.state_dict().items())
    lacking = dict(dit.state_dict())
    lacking["blocks.1.more"] = lacking.pop("blocks.2.attn.proj.bias")
    with pytest.raises(ValueError, match="missing: blocks.2.attn.proj.bias; unexpected: blocks.1.more"):
        convert._load_transformer(lacking)


def test_an_encoder_is_the_backbone_of_a_depth_anything(tmp_path):
    encoder = save_depth_anything(tmp_path / "da2")
    found = convert._load_encoder(str(tmp_path / "da2"))
    assert type(found) is Dinov2Model and found.dtype == torch.float32
    assert {name: found.config.to_dict()[name] for name in convert.SIZES} == {
        name: encoder.config.to_dict()[name] for name in convert.SIZES
    }
    image = torch.rand(1, 3, 42, 42)
    with torch.no_grad():
        torch.testing.assert_close(found(image).last_hidden_state, encoder(image).last_hidden_state)
    for part, got in ((None, "nothing"), (str(tmp_path), str(tmp_path))):
        with pytest.raises(ValueError, match="--with must be a folder of depth-anything") as error:
            convert._load_encoder(part)
        assert f"got {got}. Download it once" in str(error.value)
    (tmp_path / "da2" / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=r"got .*da2 \('backbone_config'\). Download it once"):
        convert._load_encoder(str(tmp_path / "da2"))


def test_a_checkpoint_on_pixels_becomes_a_pipeline_with_an_encoder_of_its_width(tmp_path):
    dit, encoder = PixelDiT(**SMALL), save_depth_anything(tmp_path / "da2")
    torch.save({f"dit.{name}": value for name, value in dit.state_dict().items()}, tmp_path / "ppd.pth")
    paths = [tmp_path / "ppd.pth", tmp_path / "out"]
    assert convert.convert_prior(paths, str(tmp_path / "da2")) == "ppd"
    layout = convert.Layout(tmp_path / "out", "x")
    assert layout.licence == "cc-by-nc-4.0" and PPDPipeline.recognises(layout)
    loaded = PPDPipeline.load(layout, torch.float32, None)
    assert torch.equal(loaded.dit.proj_fusion[0].weight, dit.proj_fusion[0].weight)
    key = "encoder.layer.1.mlp.fc1.weight"
    assert torch.equal(loaded.semantic_encoder.state_dict()[key], encoder.state_dict()[key])
    save_depth_anything(tmp_path / "base", 48)
    with pytest.raises(ValueError, match="the encoder of --with must be 32 wide, .*; got 48 wide"):
        convert.convert_prior([tmp_path / "ppd.pth", tmp_path / "other"], str(tmp_path / "base"))
    assert {p.name for p in tmp_path.iterdir()} == {"ppd.pth", "out", "da2", "base"}


def test_a_checkpoint_without_its_inner_parts_is_named_with_the_reason(tmp_path):
    checkpoint = {
        "state_dict": {},
        "ldm_hparams": {},
        "noising_step": 4,
        "empty_text_embedding": np.zeros((2, 3)),
    }
    torch.save(checkpoint, tmp_path / "x.ckpt")
    with pytest.raises(ValueError, match="SRC must be a complete checkpoint of its type") as error:
        convert.convert_prior([tmp_path / "x.ckpt", tmp_path / "out"])
    assert f"got {tmp_path / 'x.ckpt'} ('model_channels'). Download it again" in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["x.ckpt"]


def test_arrays_of_numpy_are_read_and_nothing_else_that_is_pickled(tmp_path):
    arrays = {kind: np.arange(3).astype(kind) for kind in ("float16", "float32", "float64", "int64")}
    torch.save(arrays, tmp_path / "arrays.pt")
    found = convert._read_checkpoint(tmp_path / "arrays.pt")
    assert all(np.array_equal(found[kind], value) for kind, value in arrays.items())
    assert {kind: found[kind].dtype.name for kind in arrays} == {kind: kind for kind in arrays}
    torch.save({"path": tmp_path}, tmp_path / "code.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "arrays.pt").read_bytes()[:-200])
    torch.save([torch.ones(1)], tmp_path / "list.pt")
    torch.save(torch.ones(2), tmp_path / "tensor.pt")
    for name, words in (
        ("code.pt", "it contains more than tensors.*Ask its authors for safetensors"),
        ("cut.pt", r"\(truncated\?\).*Download it again"),
        ("list.pt", "must be a checkpoint with a mapping; got list"),
        ("tensor.pt", "must be a checkpoint with a mapping; got Tensor"),
    ):
        with pytest.raises(ValueError, match=words) as error:
            convert._read_checkpoint(tmp_path / name)
        assert str(error.value).startswith(str(tmp_path / name))
    assert torch.equal(convert._read_checkpoint(tmp_path / "tensor.pt", torch.Tensor), torch.ones(2))


def test_a_checkpoint_of_depthfm_becomes_a_pipeline_with_its_prompt_noise_and_vae(tmp_path):
    """Renamed as CompVis' code has it: the parity test compares a whole network, here a name or two."""
    with np.load(Path(__file__).parents[2] / "parity" / "fixtures" / "depthfm.npz") as fixture:
        shapes = json.loads(str(fixture["shapes"]))
    state = {name: torch.rand(shape) for name, shape in shapes.items()}
    prompt = np.random.default_rng(0).random((5, 16))
    checkpoint = {"state_dict": state, "ldm_hparams": depthfm_reference.HPARAMS}
    checkpoint |= {"noising_step": 17, "empty_text_embedding": prompt, "more": 1}
    vae = AutoencoderKL(**depthfm_reference.VAE)
    vae.save_pretrained(tmp_path / "vae")
    torch.save(checkpoint, tmp_path / "depthfm.ckpt")
    for source, target in (
        (tmp_path / "vae", "out"),
        (tmp_path, "out2"),
    ):  # of the VAE, or of the whole model
        assert convert.convert_prior([tmp_path / "depthfm.ckpt", tmp_path / target], str(source)) == "depthfm"
    layout = convert.Layout(tmp_path / "out", "x")
    loaded = convert.DepthFMPipeline.load(layout, torch.float32, None)
    assert (layout.licence, loaded.config.noising_step, loaded.space) == ("mit", 17, "log")
    np.testing.assert_allclose(loaded.prompt()[0], prompt, rtol=1e-6)
    assert torch.equal(loaded.unet.conv_in.weight, state["input_blocks.0.0.weight"])
    assert torch.equal(loaded.vae.post_quant_conv.weight, vae.post_quant_conv.weight)
    assert (tmp_path / "out2" / "vae" / "config.json").is_file()
    state["more"] = state.pop("out.2.bias")
    torch.save(checkpoint, tmp_path / "broken.ckpt")
    with pytest.raises(
        ValueError, match="weights in the checkpoint's state_dict .*missing: .*unexpected: more"
    ):
        convert.convert_prior([tmp_path / "broken.ckpt", tmp_path / "out3"], str(tmp_path / "vae"))
    with pytest.raises(
        ValueError, match="--with must be a folder or Hugging Face model ID of Stable Diffusion 1.5"
    ):
        convert.convert_prior([tmp_path / "depthfm.ckpt", tmp_path / "out3"], str(tmp_path / "absent"))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"ldm_hparams": {}}, "'model_channels'"),  # KeyError
        ({"ldm_hparams": 3}, "'int' object is not subscriptable"),  # TypeError
        (
            {"ldm_hparams": HPARAMS, "state_dict": [1]},
            "'list' object has no attribute 'items'",
        ),  # AttributeError
    ],
)
def test_whatever_a_torn_checkpoint_leads_to_is_a_sentence_about_the_source(tmp_path, change, reason):
    whole = {
        "state_dict": {},
        "ldm_hparams": HPARAMS,
        "noising_step": 4,
        "empty_text_embedding": torch.zeros(2, 3),
    }
    torch.save(whole | change, tmp_path / "x.ckpt")
    with pytest.raises(ValueError, match="SRC must be a complete checkpoint of its type") as error:
        convert.convert_prior([tmp_path / "x.ckpt", tmp_path / "out"])
    assert f"got {tmp_path / 'x.ckpt'} ({reason})" in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["x.ckpt"]


def test_weights_of_another_shape_than_their_transformer_are_named(tmp_path):
    state = {f"dit.{name}": value for name, value in PixelDiT(**SMALL).state_dict().items()}
    state["dit.blocks.1.mlp.fc2.bias"] = torch.zeros(3)
    torch.save(state, tmp_path / "ppd.pth")
    with pytest.raises(
        ValueError, match=r"SRC must be a complete .*\(Error\(s\) in loading state_dict for PixelDiT"
    ):
        convert.convert_prior([tmp_path / "ppd.pth", tmp_path / "out"], "unused")


def test_a_file_that_torch_cannot_open_is_called_unreadable(tmp_path):
    for content in (b"", b"a text", b"\x80\x02"):
        (tmp_path / "x.pt").write_bytes(content)
        with pytest.raises(
            ValueError, match="x.pt must be a checkpoint written by torch.save; got an unreadable file"
        ):
            convert._read_checkpoint(tmp_path / "x.pt")


def test_an_unknown_checkpoint_is_described_by_its_first_eight_keys(tmp_path):
    torch.save({f"key{i}": 0 for i in range(10)}, tmp_path / "x.pt")
    with pytest.raises(ValueError, match="with the keys key0, key1, .*, key7. docs"):
        convert._convert_file(tmp_path / "x.pt", tmp_path, None)
    torch.save({}, tmp_path / "x.pt")
    with pytest.raises(ValueError, match=r"with the keys \(none\)\. docs"):
        convert._convert_file(tmp_path / "x.pt", tmp_path, None)


def test_an_index_of_shards_names_the_files_that_are_written(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "unet").mkdir(parents=True)
    shards = {
        "a": "diffusion_pytorch_model-00001-of-00002.bin",
        "b": "diffusion_pytorch_model-00002-of-00002.bin",
    }
    for number, (key, name) in enumerate(shards.items()):
        torch.save({key: torch.full((2,), float(number))}, source / "unet" / name)
    index = {"metadata": {"total_size": 16}, "weight_map": shards}
    (source / "unet" / "diffusion_pytorch_model.bin.index.json").write_text(json.dumps(index))
    convert.convert_prior([source, target])
    found = json.loads((target / "unet" / "diffusion_pytorch_model.safetensors.index.json").read_text())
    assert found["metadata"] == index["metadata"] and set(found["weight_map"]) == {"a", "b"}
    for number, (key, name) in enumerate(found["weight_map"].items()):
        assert load_file(target / "unet" / name)[key].tolist() == [number] * 2
    assert len(list((target / "unet").iterdir())) == 3
    (source / "unet" / "diffusion_pytorch_model.bin.index.json").unlink()
    for path in (source / "unet").iterdir():
        path.unlink()
    with pytest.raises(ValueError, match=f"The folder {source} has no .bin weights to convert"):
        convert.convert_prior([source, tmp_path / "other"])
