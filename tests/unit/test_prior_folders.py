"""Which prior a name or a folder is; damaged folders end in a sentence, and nothing in one is run."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline
from safetensors.torch import load_file, save_file

from examples.training.models import save_prior
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.bundled import PRIOR_FOLDER, open_pipeline
from geodiff_plugin.priors import PRIORS, REFUSED, find_prior, load_prior
from geodiff_plugin.priors.loading import Layout, refuse

UNET = {"in_channels": 8, "out_channels": 4}
V1_0 = {"timestep_spacing": "leading", "steps_offset": 1}
V1_1 = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": True}
LCM = {"timestep_spacing": "trailing", "original_inference_steps": 50}
TUNED = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": False}
LOTUS = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4}
QUICK = {"num_inference_steps": 1, "processing_resolution": 64}


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
    ("key", "unet", "scheduler", "index"),
    [
        ("marigold", {}, V1_0, {}),
        ("marigold", {}, V1_1, {"default_denoising_steps": 4}),
        ("marigold", {}, LCM, {"default_denoising_steps": 1}),
        ("marigold", {}, TUNED, {"default_denoising_steps": 10}),  # v1-0, saved again with trailing steps
        ("e2e-ft", {}, TUNED, {"requires_safety_checker": True}),  # what the authors' training script saves
        ("e2e-ft", {}, TUNED, {"default_denoising_steps": 1}),
        ("e2e-ft", {}, V1_0, {"initial_latents": "zeros"}),
        ("lotus", LOTUS | {"_class_name": "UNet2DConditionModel"}, {}, {}),
    ],
)
def test_configs_tell_relatives_apart(tmp_path, key, unet, scheduler, index):
    assert find_prior(write_configs(tmp_path, unet, scheduler, **index)).key == key


def test_name_or_key_decides_where_configs_cannot(tmp_path):
    folder = write_configs(tmp_path / "somewhere", scheduler=V1_0)
    assert find_prior(folder).key == "marigold"
    assert find_prior(f"e2e-ft:{folder}").key == "e2e-ft"
    folder = write_configs(tmp_path / "marigold-e2e-ft-depth", scheduler=V1_0)
    assert find_prior(folder).key == "e2e-ft"


@pytest.mark.parametrize(
    ("name", "works"),
    [
        ("developy/ApDepth", False),
        ("jingheya/Lotus-2", False),
        ("prs-eth/marigold-depth-hr-v1-1", False),
        ("GonzaloMG/geowizard-e2e-ft", False),
        ("duanyiqun/DiffusionDepth", False),
        ("JiYuanFeng/DDP", False),
        ("jingheya/lotus-depth-g-v2-1-disparity", True),
        ("prs-eth/marigold-depth-v1-1", True),
        ("bundled", True),
    ],
)
def test_refused_with_the_reason(name, works):
    if works:
        refuse(name)
        return
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
    with pytest.raises(ValueError, match="Check the path"):
        find_prior(tmp_path / "nothing")
    with pytest.raises(ValueError, match="of no known kind"):
        find_prior(write_configs(tmp_path / "odd", unet={"in_channels": 9}))


def test_licence_of_the_card_goes_before_what_is_known(tmp_path):
    folder = write_configs(tmp_path, scheduler=V1_1)
    assert find_prior(folder).licence == "licence unknown"
    (folder / "README.md").write_text("---\nlanguage: en\nlicense: cc-by-nc-4.0\n---\nlicense: no\n")
    assert find_prior(folder).licence == "cc-by-nc-4.0"
    assert PRIORS["marigold"].licence["prs-eth/marigold-depth-v1-1"].startswith("openrail++")
    layout = Layout(tmp_path / "none", "x")
    assert layout.index == {} and layout.config("unet") == {} and layout.licence is None


@pytest.fixture
def folder(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return tmp_path / "prior"


def test_hub_snapshot_is_read_offline(folder, tmp_path, make_pipeline, monkeypatch):
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
    with pytest.raises(ValueError, match="cached or can be reached"):
        load_prior("somebody/else", **hub)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(ValueError, match="cached or can be reached"):
        load_prior("transformers:nobody/nothing")


def test_space_device_and_dtype_are_checked(folder):
    assert load_prior(folder, space="log").config.prediction_type == "log"
    with pytest.raises(ValueError, match="space must be one of"):
        load_prior(folder, space="metres")
    for device in ("cuda:99", "tpu", ""):
        with pytest.raises(ValueError, match="device must be one that PyTorch has on this machine"):
            load_prior(folder, device=device)
    for dtype in (torch.int8, "float32"):
        with pytest.raises(ValueError, match="dtype must be"):
            load_prior(folder, dtype=dtype)


def cut_off(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def with_infinity(file):
    state = load_file(file)
    state[sorted(state)[-1]].view(-1)[0] = float("inf")
    save_file(state, file, metadata={"format": "pt"})


def with_another_name(file):
    state = load_file(file)
    state["conv_inn.weight"] = state.pop("quant_conv.weight")
    save_file(state, file, metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (cut_off, r"component 'vae' of .* must be one that can be read.*cut off"),
        (with_infinity, "weights in .*vae must be finite; got NaN or infinity in quant_conv.weight"),
        (with_another_name, "missing: quant_conv.weight; unexpected: conv_inn.weight"),
        (lambda file: file.rename(file.with_suffix(".bin")), "geodiff convert SRC DST"),
    ],
)
def test_damaged_weights(folder, damage, sentence):
    damage(folder / "vae" / "diffusion_pytorch_model.safetensors")
    with pytest.raises(ValueError, match=sentence):
        load_prior(folder)


@pytest.mark.parametrize("name", ["model_index.json", "vae/config.json", "scheduler/scheduler_config.json"])
@pytest.mark.parametrize("text", ["[" * 100_000, "{", "[]", '{"_class_name": 7}', "\xff"])
def test_damaged_json(folder, name, text):
    (folder / name).write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


def test_a_pipeline_that_gives_nan(make_pipeline, textured_plane):
    """One that diffusers loaded, which looks at no weights."""
    pipe = enable_geometry_guidance(make_pipeline())
    with torch.no_grad():
        next(pipe.unet.parameters()).fill_(float("nan"))
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E)
    with pytest.raises(ValueError, match="the prior's output of denoising step 1 must be finite"):
        pipe(textured_plane.left, guidance=guidance, **QUICK)


@pytest.mark.parametrize(
    "entry", [["os", "system"], ["builtins", "eval"], ["transformers", "pipeline"], ["x"], 3]
)
def test_a_component_of_no_known_class(folder, entry):
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


def test_the_bundled_folder_by_diffusers_alone(textured_plane, tmp_path):
    """``from_pretrained`` without a dtype, as everybody types it: stock and guided; and saved again."""
    pipe = MarigoldDepthPipeline.from_pretrained(PRIOR_FOLDER)
    assert {part.dtype for part in (pipe.unet, pipe.vae, pipe.text_encoder)} == {torch.float32}
    pipe.set_progress_bar_config(disable=True)
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E)
    assert np.isfinite(pipe(textured_plane.left, **QUICK).prediction).all()
    out = enable_geometry_guidance(pipe)(textured_plane.left, guidance=guidance, **QUICK)
    assert np.isfinite(out.prediction).all()
    again = save_prior(open_pipeline(PRIOR_FOLDER), tmp_path / "again")
    assert json.loads((again / "text_encoder" / "config.json").read_text())["dtype"] == "float32"


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_on_a_cpu(dtype, textured_plane):
    """Image resizing has no half-precision kernel there; the depth is that of float32 but for rounding."""
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, inner_steps=0)

    def depth(dtype):
        pipe = enable_geometry_guidance(load_prior("bundled", dtype=dtype))
        pipe.set_progress_bar_config(disable=True)
        seeded = torch.Generator().manual_seed(0)
        return pipe(textured_plane.left, guidance=guidance, generator=seeded, **QUICK).prediction

    assert np.median(np.abs(depth(dtype) / depth(torch.float32) - 1.0)) < 0.03
