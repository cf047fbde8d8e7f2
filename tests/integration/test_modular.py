"""Marigold as modular blocks: every stage alone, and both pipelines equal to the classic calls."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from diffusers import MarigoldDepthPipeline
from PIL import Image

from examples.modular import block
from geodiff_plugin import load_prior
from tests.tiny import guided_call, quiet, seeded

pytestmark = pytest.mark.end_to_end

FOLDER = Path(block.__file__).parent
PARAMETERS = {"min_steps": 3, "pose": "given"}
AT_96 = {"processing_resolution": 96}


@pytest.fixture(scope="module")
def prior():
    return quiet(load_prior("bundled"))


@pytest.fixture
def views(textured_plane):
    left, right = (Image.fromarray(getattr(textured_plane, side)) for side in ("left", "right"))
    return {"image": left, "right": right, "K": textured_plane.K, "E": textured_plane.E}


def assembled(blocks, prior):
    pipe = blocks.init_pipeline()
    parts = {name: part for name, part in prior.components.items() if name in pipe.component_names}
    pipe.update_components(**parts)
    return quiet(pipe)


def test_blocks_without_geometry_are_the_stock_pipeline(prior, views):
    reported = AT_96 | {"image": views["image"], "num_inference_steps": 2}
    mine = assembled(block.MarigoldBlocks(), prior)(**reported, generator=seeded()).get("relative_depth")
    np.testing.assert_array_equal(mine, prior(**reported, generator=seeded()).prediction)


@pytest.mark.parametrize("parameters", [{}, {"guidance_steps": 2}])
def test_blocks_with_geometry_are_the_guided_call(prior, views, textured_plane, parameters):
    reported = AT_96 | {
        "parameters": PARAMETERS | parameters,
        "prediction_type": prior.config.prediction_type,
    }
    state = assembled(block.GuidedMarigoldBlocks(), prior)(**views, **reported, generator=seeded())
    out = guided_call(quiet(load_prior("bundled")), textured_plane, PARAMETERS | parameters, **AT_96)
    np.testing.assert_array_equal(state.get("depth_m"), out.prediction[0, ..., 0])
    np.testing.assert_array_equal(state.get("confidence"), out.confidence[0, ..., 0])
    assert state.get("guided_output").verdict == out.verdict


def test_each_block_runs_alone(prior, views):
    def run(step, **reported):
        return assembled(step, prior)(**reported)

    assert run(block.TextStep()).get("prompt_embeds").shape[0] == 1
    state = run(block.ImageStep(), image=views["image"], **AT_96)
    code = state.get("image_latent")
    assert code.shape[0] == 1 and max(state.get("content")) == 96
    assert run(block.NoiseStep(), image_latent=code, generator=seeded()).get("latents").shape == code.shape
    assert len(run(block.TimestepsStep(), image_latent=code).get("timesteps")) == 4


def test_the_folder_is_what_would_be_pushed(tmp_path):
    block.GuidedMarigoldBlocks().save_pretrained(tmp_path)
    written, committed = (
        json.loads((folder / "modular_config.json").read_text()) for folder in (tmp_path, FOLDER)
    )
    assert committed["auto_map"] == written["auto_map"]
    assert committed["auto_map"] == {"ModularPipelineBlocks": "block.GuidedMarigoldBlocks"}
    assert set(committed["requirements"]) == {"geodiff_plugin"}


@pytest.mark.skipif(shutil.which("patch") is None, reason="needs patch")
def test_the_proposed_callback_applies_to_diffusers(prior, views, tmp_path):
    module, target = MarigoldDepthPipeline.__module__, tmp_path / "patched.py"
    shutil.copy(sys.modules[module].__file__, target)
    change = FOLDER / "callback_on_step_end.patch"
    subprocess.run(["patch", "--quiet", target, change], check=True, capture_output=True)
    spec = importlib.util.spec_from_file_location(f"{module}_patched", target)
    patched = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(patched)
    names = ("prediction_type", "scale_invariant", "shift_invariant")
    settings = {name: prior.config[name] for name in names}
    pipe, seen = patched.MarigoldDepthPipeline(**prior.components, **settings), []
    options = AT_96 | {"num_inference_steps": 3}

    def callback(pipe, step, timestep, tensors):
        seen.append(step)
        return {"latents": 0.5 * tensors["latents"]}

    stock, plain, changed = (
        run(views["image"], **options, generator=seeded(), **reported).prediction
        for run, reported in ((prior, {}), (pipe, {}), (pipe, {"callback_on_step_end": callback}))
    )
    np.testing.assert_array_equal(plain, stock)
    assert seen == [0, 1, 2] and not np.array_equal(changed, stock)
    with pytest.raises(ValueError, match="tensor_inputs"):
        pipe(views["image"], **options, callback_on_step_end_tensor_inputs=["text"])
