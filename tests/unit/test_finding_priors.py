"""Which prior a name or a folder is: by configs, by an explicit key, or not at all and why."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from geodiff_plugin.priors import PRIORS, REFUSED, find_prior, load_prior
from geodiff_plugin.priors.folders import Layout, refuse

UNET = {"in_channels": 8, "out_channels": 4}
V1_0 = {"timestep_spacing": "leading", "steps_offset": 1}
V1_1 = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": True}
LCM = {"timestep_spacing": "trailing", "original_inference_steps": 50}
TUNED = {"timestep_spacing": "trailing", "rescale_betas_zero_snr": False}


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
    ("key", "scheduler", "index"),
    [
        ("marigold", V1_0, {}),
        ("marigold", V1_1, {"default_denoising_steps": 4}),
        ("marigold", LCM, {"default_denoising_steps": 1}),
        ("marigold", TUNED, {"default_denoising_steps": 10}),  # v1-0, saved again with trailing steps
        ("e2e-ft", TUNED, {"requires_safety_checker": True}),  # what the authors' training script saves
        ("e2e-ft", TUNED, {"default_denoising_steps": 1}),
        ("e2e-ft", V1_0, {"initial_latents": "zeros"}),
    ],
)
def test_schedule_tells_marigold_from_its_one_step_tuning(tmp_path, key, scheduler, index):
    assert find_prior(write_configs(tmp_path, scheduler=scheduler, **index)).key == key


def test_name_or_key_decides_where_configs_cannot(tmp_path):
    folder = write_configs(tmp_path / "somewhere", scheduler=V1_0)
    assert find_prior(folder).key == "marigold"
    assert find_prior(f"e2e-ft:{folder}").key == "e2e-ft"
    folder = write_configs(tmp_path / "marigold-e2e-ft-depth", scheduler=V1_0)
    assert find_prior(folder).key == "e2e-ft"


def test_class_embedding_tells_lotus(tmp_path):
    labels = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4}
    folder = write_configs(tmp_path, unet=labels | {"_class_name": "UNet2DConditionModel"})
    assert find_prior(folder).key == "lotus"


@pytest.mark.parametrize(
    "name",
    [
        "developy/ApDepth",
        "jingheya/Lotus-2",
        "prs-eth/marigold-depth-hr-v1-1",
        "GonzaloMG/geowizard-e2e-ft",
        "duanyiqun/DiffusionDepth",
        "JiYuanFeng/DDP",
    ],
)
def test_refused_with_the_reason(name):
    with pytest.raises(ValueError, match="It is refused because") as error:
        find_prior(name)
    assert any(reason in str(error.value) for reason in REFUSED.values())


@pytest.mark.parametrize(
    "name", ["jingheya/lotus-depth-g-v2-1-disparity", "prs-eth/marigold-depth-v1-1", "bundled"]
)
def test_not_refused(name):
    refuse(name)


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


def test_layout_reads_no_more_than_json(tmp_path):
    layout = Layout(tmp_path, "x")
    assert layout.index == {} and layout.config("unet") == {} and layout.licence is None
    (tmp_path / "model_index.json").write_text("[]")
    with pytest.raises(ValueError, match="must be a JSON object"):
        Layout(tmp_path, "x").index  # noqa: B018


@pytest.fixture
def saved(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "saved")
    return tmp_path / "saved"


def test_hub_snapshot_is_read_offline(saved, tmp_path, make_pipeline):
    cache = tmp_path / "cache" / "models--somebody--depth"
    (cache / "refs").mkdir(parents=True)
    (cache / "refs" / "main").write_text("abc")
    (cache / "snapshots").mkdir()
    saved.rename(cache / "snapshots" / "abc")
    hub = {"cache_dir": tmp_path / "cache", "local_files_only": True}
    pipe = load_prior("somebody/depth", **hub)
    assert pipe.config._name_or_path == "somebody/depth"
    ours, theirs = (dict(p.unet.named_parameters()) for p in (pipe, make_pipeline()))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    with pytest.raises(ValueError, match="cached or can be reached"):
        load_prior("somebody/else", **hub)


def test_space_is_checked_and_overrides(saved):
    assert load_prior(saved, space="log").config.prediction_type == "log"
    with pytest.raises(ValueError, match="space must be one of"):
        load_prior(saved, space="metres")


def test_weights_that_do_not_fit_are_listed(saved):
    file = saved / "unet" / "diffusion_pytorch_model.safetensors"
    weights = load_file(file)
    weights["conv_inn.weight"] = weights.pop("conv_in.weight")
    save_file(weights, file, metadata={"format": "pt"})
    with pytest.raises(ValueError, match=r"missing: conv_in.weight; unexpected: conv_inn.weight"):
        load_prior(saved)


def test_pickled_weights_are_not_read(saved):
    file = saved / "vae" / "diffusion_pytorch_model.safetensors"
    file.rename(file.with_name("diffusion_pytorch_model.bin"))
    with pytest.raises(ValueError, match="geodiff convert SRC DST"):
        load_prior(saved)


def test_classes_come_from_libraries_only(saved):
    index = saved / "model_index.json"
    index.write_text(
        index.read_text().replace('"UNet2DConditionModel"', '"system"').replace('"diffusers",', '"os",')
    )
    with pytest.raises(ValueError, match="Code that comes with weights is never run"):
        load_prior(saved)
