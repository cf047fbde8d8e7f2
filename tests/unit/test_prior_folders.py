"""Which prior a name or a folder is; damaged folders end in a sentence, and nothing in one is run."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from geodiff_plugin.priors import find_prior, load_prior
from geodiff_plugin.priors.loading import REFUSED, refuse

UNET = {"in_channels": 8, "out_channels": 4}
V1_0 = {"timestep_spacing": "leading", "steps_offset": 1}
V1_1 = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": True}
LCM = {"timestep_spacing": "trailing", "original_inference_steps": 50}
TUNED = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": False}
LOTUS = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4}


def write_configs(folder, unet=None, scheduler=None, **index):
    """The small files of a folder in diffusers' layout; no weights."""
    files = {
        "unet/config.json": UNET | (unet or {}),
        "vae/config.json": {"latent_channels": 4},
        "scheduler/scheduler_config.json": scheduler or {},
        "model_index.json": {"text_encoder": ["transformers", "CLIPTextModel"]} | index,
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("key", "name", "unet", "scheduler", "index"),
    [
        ("marigold", "x", {}, V1_0, {}),
        ("marigold", "x", {}, V1_1, {"default_denoising_steps": 4}),
        ("marigold", "x", {}, LCM, {"default_denoising_steps": 1}),
        ("marigold", "x", {}, TUNED, {"default_denoising_steps": 10}),  # v1-0, saved with trailing steps
        ("e2e-ft", "x", {}, TUNED, {"requires_safety_checker": True}),  # what the authors' script saves
        ("e2e-ft", "x", {}, V1_0, {"initial_latents": "zeros"}),
        ("e2e-ft", "marigold-e2e-ft-depth", {}, V1_0, {}),
        ("lotus", "x", LOTUS | {"_class_name": "UNet2DConditionModel"}, {}, {}),
    ],
)
def test_configs_and_names_tell_relatives_apart(tmp_path, key, name, unet, scheduler, index):
    folder = write_configs(tmp_path / name, unet, scheduler, **index)
    assert find_prior(folder).key == key
    assert find_prior(f"e2e-ft:{folder}").key == "e2e-ft"


@pytest.mark.parametrize(
    "name", ["developy/ApDepth", "GonzaloMG/marigold-e2e-ft-normals", "jingheya/lotus-normal-g-v1-1"]
)
def test_priors_that_cannot_run_are_refused_with_the_reason(name):
    refuse("jingheya/lotus-depth-g-v2-1-disparity")
    with pytest.raises(ValueError, match="It is refused because") as error:
        find_prior(name)
    assert any(reason in str(error.value) for reason in REFUSED.values())


def test_unknown_folders_say_what_to_do(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"without model_index.json.*docs/reference/priors.md"):
        find_prior(tmp_path / "empty")
    (tmp_path / "empty" / "depthfm-v1.ckpt").touch()
    with pytest.raises(ValueError, match="geodiff convert SRC DST"):
        find_prior(tmp_path / "empty")
    with pytest.raises(ValueError, match="got the file .*depthfm-v1.ckpt. Name its folder"):
        find_prior(tmp_path / "empty" / "depthfm-v1.ckpt")
    with pytest.raises(ValueError, match="Check the path"):
        find_prior(tmp_path / "nothing")
    with pytest.raises(ValueError, match="of no known kind"):
        find_prior(write_configs(tmp_path / "odd", unet={"in_channels": 9}))


@pytest.fixture
def folder(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return tmp_path / "prior"


def test_a_hub_snapshot_is_read_offline(folder, tmp_path, make_pipeline, monkeypatch):
    cache = tmp_path / "cache" / "models--somebody--depth"
    (cache / "refs").mkdir(parents=True)
    (cache / "refs" / "main").write_text("abc")
    (cache / "snapshots").mkdir()
    folder.rename(cache / "snapshots" / "abc")
    hub = {"cache_dir": tmp_path / "cache", "local_files_only": True}
    pipe = load_prior("somebody/depth", **hub)
    assert pipe.config._name_or_path == "somebody/depth"
    ours, theirs = (dict(p.unet.named_parameters()) for p in (pipe, make_pipeline()))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    for name, told in (("somebody/else", hub), ("transformers:nobody/nothing", {})):
        with pytest.raises(ValueError, match="cached or can be reached"):
            load_prior(name, **told)


@pytest.mark.parametrize(
    ("told", "sentence"),
    [
        ({"space": "metres"}, "space must be one of"),
        ({"device": "cuda:99"}, "device must be one that PyTorch has on this machine"),
        ({"device": "tpu"}, "device must be one that PyTorch has on this machine"),
        ({"dtype": torch.int8}, "dtype must be"),
        ({"dtype": "float32"}, "dtype must be"),
    ],
)
def test_space_device_and_dtype_are_checked(folder, told, sentence):
    assert load_prior(folder, space="log").config.prediction_type == "log"
    with pytest.raises(ValueError, match=sentence):
        load_prior(folder, **told)


def cut_off(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def with_another_name(file):
    state = load_file(file)
    state["conv_inn.weight"] = state.pop("quant_conv.weight")
    save_file(state, file, metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (cut_off, r"component 'vae' of .* must be one that can be read.*cut off"),
        (with_another_name, "missing: quant_conv.weight; unexpected: conv_inn.weight"),
        (lambda file: file.rename(file.with_suffix(".bin")), "geodiff convert SRC DST"),
    ],
)
def test_damaged_weights_are_refused(folder, damage, sentence):
    damage(folder / "vae" / "diffusion_pytorch_model.safetensors")
    with pytest.raises(ValueError, match=sentence):
        load_prior(folder)


@pytest.mark.parametrize("name", ["model_index.json", "vae/config.json", "scheduler/scheduler_config.json"])
@pytest.mark.parametrize("text", ["[" * 100_000, "{", "[]", '{"_class_name": 7}', "\xff"])
def test_damaged_json_is_refused(folder, name, text):
    (folder / name).write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


@pytest.mark.parametrize(
    "entry", [["os", "system"], ["builtins", "eval"], ["transformers", "pipeline"], ["x"], 3]
)
def test_a_component_of_no_known_class_is_refused(folder, entry):
    index = json.loads((folder / "model_index.json").read_text())
    (folder / "model_index.json").write_text(json.dumps(index | {"vae": entry}))
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


@pytest.mark.parametrize("kind", ["CLIPTokenizer", "AutoTokenizer", "depth model"])
def test_nothing_that_comes_with_a_folder_is_run(folder, kind, tmp_path, monkeypatch):
    marker = tmp_path / "marker"
    evil = f"open({str(marker)!r}, 'w').close()\nfrom transformers import CLIPTokenizer as Evil\n"
    if kind == "depth model":
        folder, auto = tmp_path, {"AutoConfig": "evil.C", "AutoModelForDepthEstimation": "evil.M"}
        config = {"model_type": "evil", "auto_map": auto, "architectures": ["DPTForDepthEstimation"]}
        (folder / "config.json").write_text(json.dumps(config))
        (folder / "preprocessor_config.json").write_text('{"image_processor_type": "DPTImageProcessor"}')
        (folder / "model.safetensors").write_bytes(b"")
        (folder / "evil.py").write_text(evil)
    else:
        path = folder / "tokenizer" / "tokenizer_config.json"
        named = {"auto_map": {"AutoTokenizer": ["evil.Evil", None]}, "tokenizer_class": "Evil"}
        path.write_text(json.dumps(json.loads(path.read_text()) | named))
        (folder / "tokenizer" / "evil.py").write_text(evil)
        index = json.loads((folder / "model_index.json").read_text())
        (folder / "model_index.json").write_text(json.dumps(index | {"tokenizer": ["transformers", kind]}))
    monkeypatch.setattr("builtins.input", lambda *_: "y")  # `yes |`
    try:
        load_prior(folder)
    except ValueError as error:
        assert "component" in str(error)
    assert not marker.exists()
