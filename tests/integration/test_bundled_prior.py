"""The bundled prior as a user meets it, and a short training from scratch."""

import json
import socket
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline
from diffusers.utils import logging as diffusers_logging
from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars
from transformers.utils import logging as transformers_logging

from examples.training import data
from examples.training.models import save_prior
from examples.training.train import parse, run
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.jobs.notices import silent
from geodiff_plugin.jobs.prior import load_guided_prior
from geodiff_plugin.priors import BUNDLED_FOLDER, load_prior
from tests.tiny import guided_call, quiet

pytestmark = pytest.mark.end_to_end


def test_the_folder_is_small_and_holds_no_pickle():
    files = [path for path in BUNDLED_FOLDER.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 16e6
    assert {path.suffix for path in files} <= {".safetensors", ".json", ".md", ".txt"}
    assert not any("_name_or_path" in path.read_text() for path in BUNDLED_FOLDER.rglob("*.json"))
    scheduler = json.loads((BUNDLED_FOLDER / "scheduler" / "scheduler_config.json").read_text())
    assert scheduler["timestep_spacing"] == "trailing" and scheduler["rescale_betas_zero_snr"]


def test_diffusers_alone_loads_it_without_a_dtype_and_saves_it_again(textured_plane, tmp_path):
    pipe = quiet(MarigoldDepthPipeline.from_pretrained(BUNDLED_FOLDER))
    assert {part.dtype for part in (pipe.unet, pipe.vae, pipe.text_encoder)} == {torch.float32}
    assert (pipe.vae_scale_factor, pipe.config.prediction_type) == (4, "disparity")
    again = save_prior(pipe, tmp_path / "again")
    assert json.loads((again / "text_encoder" / "config.json").read_text())["dtype"] == "float32"
    out = guided_call(pipe, textured_plane, num_inference_steps=1, processing_resolution=64)
    assert np.isfinite(out.prediction).all()


def test_the_loader_gives_a_new_quiet_pipeline_each_time_without_a_network(capfd, monkeypatch):
    monkeypatch.setattr(socket.socket, "connect", Mock(side_effect=OSError("network")))
    first, second = load_bundled_prior(), load_bundled_prior(dtype=torch.bfloat16)
    assert type(first) is MarigoldDepthPipeline and first is not second
    assert first.unet.dtype == torch.float32 and second.unet.dtype == torch.bfloat16
    assert first.device.type == "cpu" and capfd.readouterr().err == ""


@pytest.mark.parametrize("hub_is_quiet", [False, True])
def test_no_bar_shows_where_the_bundled_prior_loads_and_bars_are_left_as_they_were(capfd, hub_is_quiet):
    hosts, quiet_before = (diffusers_logging, transformers_logging), are_progress_bars_disabled()
    enabled_before = [host.is_progress_bar_enabled() for host in hosts]
    try:
        for host in hosts:
            host.enable_progress_bar()
        if hub_is_quiet:
            disable_progress_bars()
        load_prior("bundled")
        load_guided_prior("bundled", torch.device("cpu"), notify=silent)
        assert "Loading" not in capfd.readouterr().err
        assert all(host.is_progress_bar_enabled() for host in hosts)
        assert are_progress_bars_disabled() is hub_is_quiet
    finally:
        for host, enabled in zip(hosts, enabled_before, strict=True):
            (host.enable_progress_bar if enabled else host.disable_progress_bar)()
        (disable_progress_bars if quiet_before else enable_progress_bars)()


@pytest.mark.slow
def test_a_short_training_learns_and_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "SHAPES", ((64, 96),))
    cache = tmp_path / "cache"
    assert len(list(data.render_shards(cache, 0, 3))) == 3
    common = f"--cache {cache} --renderers 0 --scenes 48 --first-scenes 48 --batch 4"
    common += " --vae-steps 60 --validation-scenes 4 --validate-minutes 99"

    def train(name, steps, *more):
        run(parse([*common.split(), "--out", str(tmp_path / name), "--steps", str(steps), *more]))
        return [json.loads(line) for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]

    train("run", 10)
    first, last = train("run", 90)
    assert (first["step"], last["step"]) == (10, 90)
    assert last["loss"] < first["loss"] and last["abs_rel_1"] < 1.05 * first["abs_rel_1"]
    (line,) = train("next", 3, "--init-from", str(tmp_path / "run" / "prior"))
    assert line["loss"] < first["loss"]
    assert (tmp_path / "next" / "contact.png").stat().st_size > 1000
