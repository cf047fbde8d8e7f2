"""The bundled prior as a user meets it, and a short training from scratch."""

import json
import socket

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline

from examples.training.train import parse, run
from geodiff_plugin.bundled import PRIOR_FOLDER, load_bundled_prior


def test_folder_is_small_and_holds_no_pickle():
    files = [path for path in PRIOR_FOLDER.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 16e6
    assert {path.suffix for path in files} <= {".safetensors", ".json", ".md", ".txt"}
    index = json.loads((PRIOR_FOLDER / "model_index.json").read_text())
    assert index["_class_name"] == "MarigoldDepthPipeline"
    assert index["prediction_type"] == "disparity"
    assert index["scale_invariant"] and index["shift_invariant"]
    assert index["default_denoising_steps"] >= 1 and index["default_processing_resolution"] % 4 == 0
    assert not any("_name_or_path" in path.read_text() for path in PRIOR_FOLDER.rglob("*.json"))
    scheduler = json.loads((PRIOR_FOLDER / "scheduler" / "scheduler_config.json").read_text())
    assert scheduler["timestep_spacing"] == "trailing" and scheduler["rescale_betas_zero_snr"]


def test_loads_as_the_stock_pipeline():
    pipeline = MarigoldDepthPipeline.from_pretrained(str(PRIOR_FOLDER), local_files_only=True)
    assert type(pipeline) is MarigoldDepthPipeline
    assert pipeline.vae_scale_factor == 4
    assert pipeline.tokenizer.model_max_length == 77


def test_loader_gives_a_new_quiet_pipeline_each_time_without_a_network(capfd, monkeypatch):
    def refuse(*_):
        raise OSError("network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    first, second = load_bundled_prior(), load_bundled_prior(dtype=torch.bfloat16)
    assert type(first) is MarigoldDepthPipeline and first is not second
    assert first.unet.dtype == torch.float32 and second.unet.dtype == torch.bfloat16
    assert first.device.type == "cpu"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("size", [(48, 64), (40, 132), (64, 48)])
def test_stock_call_is_finite_and_seeded(size):
    pipeline = load_bundled_prior()
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    first, second = (
        pipeline(image, processing_resolution=0, generator=torch.Generator().manual_seed(1)).prediction
        for _ in range(2)
    )
    assert first.shape == (1, *size, 1)
    assert np.isfinite(first).all() and first.min() >= 0.0 and first.max() <= 1.0
    assert np.array_equal(first, second)


def test_ground_is_nearer_below():
    """A rendered corridor's floor comes closer towards the bottom of the picture."""
    pipeline = load_bundled_prior()
    rows = torch.linspace(0.0, 1.0, 96)[:, None].expand(96, 128)
    floor = torch.where(rows > 0.5, 0.35 + 0.1 * torch.sin(60.0 / (rows - 0.45)), 0.85)
    nearness = pipeline(floor.expand(1, 3, 96, 128).clone(), processing_resolution=0).prediction[0, ..., 0]
    assert nearness[-8:].mean() > nearness[:40].mean()


@pytest.mark.slow
def test_a_short_training_learns_and_resumes(tmp_path, monkeypatch):
    from examples.training import data

    monkeypatch.setattr(data, "SHAPES", ((64, 96),))
    cache = tmp_path / "cache"
    assert len(list(data.render_shards(cache, 0, 3))) == 3
    common = f"--out {tmp_path / 'run'} --cache {cache} --renderers 0 --scenes 48 --first-scenes 48 --batch 4"
    common += " --vae-steps 60 --validation-scenes 4 --validate-minutes 99"
    run(parse([*common.split(), "--steps", "10"]))
    progress = run(parse([*common.split(), "--steps", "90"]))
    assert progress.step == 90
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [10, 90]
    assert lines[1]["loss"] < lines[0]["loss"]
    assert lines[1]["abs_rel_1"] < 1.05 * lines[0]["abs_rel_1"]
    common = common.replace(str(tmp_path / "run"), str(tmp_path / "next"))
    run(parse([*common.split(), "--steps", "3", "--init-from", str(tmp_path / "run" / "prior")]))
    line = json.loads((tmp_path / "next" / "log.jsonl").read_text())
    assert line["loss"] < lines[0]["loss"]
    assert (tmp_path / "next" / "contact.png").stat().st_size > 1000
