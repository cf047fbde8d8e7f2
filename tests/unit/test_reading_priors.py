"""Damaged folders of weights end in a sentence, and nothing that lies in a folder is run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline
from safetensors.torch import load_file, save_file

from examples.training.models import save_prior
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled import PRIOR_FOLDER
from geodiff_plugin.bundled.loading import open_pipeline
from geodiff_plugin.priors.hf_model import HFDepthModel

QUICK = {"num_inference_steps": 1, "processing_resolution": 64}


@pytest.fixture
def folder(make_pipeline, tmp_path) -> Path:
    make_pipeline().save_pretrained(tmp_path / "prior")
    return tmp_path / "prior"


def weights_of(folder: Path) -> Path:
    return next((folder / "vae").glob("*.safetensors"))


def test_truncated_weights(folder):
    file = weights_of(folder)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(ValueError, match=r"component 'vae' of .* must be one that can be read.*cut off"):
        load_prior(folder)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite(folder, value):
    state = load_file(weights_of(folder))
    name = sorted(state)[-1]
    state[name].view(-1)[0] = value
    save_file(state, weights_of(folder), metadata={"format": "pt"})
    with pytest.raises(ValueError, match=f"weights in .*vae must be finite; got NaN or infinity in {name}"):
        load_prior(folder)


def test_a_pipeline_that_gives_nan(make_pipeline, textured_plane):
    """One that diffusers loaded, which looks at no weights."""
    pipe = enable_geometry_guidance(make_pipeline())
    with torch.no_grad():
        next(pipe.unet.parameters()).fill_(float("nan"))
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E)
    with pytest.raises(ValueError, match="the prior's output of denoising step 1 must be finite"):
        pipe(textured_plane.left, guidance=guidance, **QUICK)


@pytest.mark.parametrize("name", ["model_index.json", "vae/config.json", "scheduler/scheduler_config.json"])
@pytest.mark.parametrize("text", ["[" * 100_000, "{", "[]", '{"_class_name": 7}', "\xff"])
def test_damaged_json(folder, name, text):
    (folder / name).write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


def evil(folder: Path, marker: Path) -> None:
    """A tokenizer whose class comes with the folder, as ``trust_remote_code`` would run it."""
    (folder / "evil.py").write_text(
        f"from pathlib import Path\nPath({str(marker)!r}).write_text('run')\n"
        "from transformers import CLIPTokenizer\n\nclass Evil(CLIPTokenizer):\n    pass\n"
    )
    path = folder / "tokenizer_config.json"
    config = json.loads(path.read_text())
    config |= {"auto_map": {"AutoTokenizer": ["evil.Evil", None]}, "tokenizer_class": "Evil"}
    path.write_text(json.dumps(config))


@pytest.mark.parametrize("named", ["CLIPTokenizer", "AutoTokenizer"])
def test_a_tokenizer_never_runs_code(folder, tmp_path, monkeypatch, named):
    marker = tmp_path / "marker"
    evil(folder / "tokenizer", marker)
    index = json.loads((folder / "model_index.json").read_text())
    index["tokenizer"] = ["transformers", named]
    (folder / "model_index.json").write_text(json.dumps(index))
    monkeypatch.setattr("builtins.input", lambda *_: "y")  # `yes |`
    try:
        load_prior(folder)
    except ValueError as error:
        assert "component 'tokenizer'" in str(error)
    assert not marker.exists()


def test_a_depth_model_never_runs_code(tmp_path, monkeypatch):
    marker = tmp_path / "marker"
    (tmp_path / "evil.py").write_text(f"open({str(marker)!r}, 'w').close()\n")
    config = {
        "model_type": "evil",
        "auto_map": {"AutoConfig": "evil.C", "AutoModelForDepthEstimation": "evil.M"},
    }
    (tmp_path / "config.json").write_text(json.dumps(config | {"architectures": ["DPTForDepthEstimation"]}))
    (tmp_path / "preprocessor_config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"")
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    for load in (HFDepthModel.from_pretrained, load_prior):
        with pytest.raises(ValueError, match="must be"):
            load(tmp_path)
    assert not marker.exists()


@pytest.mark.parametrize(
    "entry", [["os", "system"], ["builtins", "eval"], ["transformers", "pipeline"], ["x"], 3]
)
def test_a_component_of_no_known_class(folder, entry):
    index = json.loads((folder / "model_index.json").read_text())
    index["vae"] = entry
    (folder / "model_index.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match="must be"):
        load_prior(folder)


def test_a_hub_model_while_offline(monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(ValueError, match="the depth model must be a folder, or a hub id that is cached"):
        HFDepthModel.from_pretrained("nobody/nothing")


def test_a_device_or_dtype_that_is_not_here(folder):
    for device in ("cuda:99", "tpu", ""):
        with pytest.raises(ValueError, match="device must be one that PyTorch has on this machine"):
            load_prior(folder, device=device)
    for dtype in (torch.int8, "float32"):
        with pytest.raises(ValueError, match="dtype must be"):
            load_prior(folder, dtype=dtype)


def test_the_bundled_folder_by_diffusers_alone(textured_plane):
    """``from_pretrained`` without a dtype, as everybody types it: stock and guided."""
    pipe = MarigoldDepthPipeline.from_pretrained(PRIOR_FOLDER)
    assert {part.dtype for part in (pipe.unet, pipe.vae, pipe.text_encoder)} == {torch.float32}
    pipe.set_progress_bar_config(disable=True)
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E)
    assert np.isfinite(pipe(textured_plane.left, **QUICK).prediction).all()
    out = enable_geometry_guidance(pipe)(textured_plane.left, guidance=guidance, **QUICK)
    assert np.isfinite(out.prediction).all()


def test_a_saved_prior_keeps_its_text_encoder_wide(tmp_path):
    folder = save_prior(open_pipeline(PRIOR_FOLDER), tmp_path / "again")
    assert json.loads((folder / "text_encoder" / "config.json").read_text())["dtype"] == "float32"
    index = MarigoldDepthPipeline.from_pretrained(folder)
    assert index.text_encoder.dtype == index.unet.dtype == torch.float32
    shutil.rmtree(folder)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_on_a_cpu(dtype, textured_plane):
    """Image resizing has no half-precision kernel there; the depth is that of float32 but for rounding."""
    guidance = GeometryGuidance(textured_plane.right, textured_plane.K, textured_plane.E, inner_steps=0)

    def depth(dtype):
        pipe = enable_geometry_guidance(load_prior("bundled", dtype=dtype))
        pipe.set_progress_bar_config(disable=True)
        seeded = torch.Generator().manual_seed(0)
        out = pipe(textured_plane.left, guidance=guidance, generator=seeded, **QUICK).prediction
        assert "preprocess" not in vars(pipe.image_processor)
        return out

    wide = depth(torch.float32)
    assert np.median(np.abs(depth(dtype) / wide - 1.0)) < 0.03
