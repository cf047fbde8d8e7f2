"""Marigold as modular blocks: every stage alone, and both pipelines equal to the classic calls."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "modular"
KNOBS = {"min_steps": 3, "pose": "given"}


@pytest.fixture(scope="module")
def block():
    spec = importlib.util.spec_from_file_location("block", FOLDER / "block.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["block"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["block"]


@pytest.fixture(scope="module")
def prior():
    return load_prior("bundled")


@pytest.fixture
def views(textured_plane):
    left, right = (Image.fromarray(getattr(textured_plane, side)) for side in ("left", "right"))
    return {"image": left, "right": right, "K": textured_plane.K, "E": textured_plane.E}


def seeded():
    return torch.Generator().manual_seed(0)


def assembled(blocks, prior):
    pipe = blocks.init_pipeline()
    parts = {name: part for name, part in prior.components.items() if name in pipe.component_names}
    pipe.update_components(**parts)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def test_blocks_without_geometry_are_the_stock_pipeline(block, prior, views):
    pipe = assembled(block.MarigoldBlocks(), prior)
    mine = pipe(
        image=views["image"], num_inference_steps=2, processing_resolution=96, generator=seeded()
    ).get("relative_depth")
    stock = prior(views["image"], num_inference_steps=2, processing_resolution=96, generator=seeded())
    np.testing.assert_array_equal(mine, stock.prediction)


@pytest.mark.parametrize("knobs", [{}, {"inner_steps": 2}])
def test_blocks_with_geometry_are_the_guided_call(block, prior, views, knobs):
    pipe = assembled(block.GuidedMarigoldBlocks(), prior)
    space = prior.config.prediction_type
    state = pipe(
        **views, knobs=KNOBS | knobs, processing_resolution=96, generator=seeded(), prediction_type=space
    )
    guidance = GeometryGuidance(views["right"], views["K"], views["E"], **KNOBS, **knobs)
    out = enable_geometry_guidance(load_prior("bundled"))(
        views["image"], guidance=guidance, processing_resolution=96, generator=seeded()
    )
    np.testing.assert_array_equal(state.get("depth_m"), out.prediction[0, ..., 0])
    np.testing.assert_array_equal(state.get("confidence"), out.confidence[0, ..., 0])
    assert state.get("guided_output").verdict == out.verdict


def test_geometry_goes_into_a_pipeline_that_had_none(block, prior, views):
    blocks = block.MarigoldBlocks()
    loop = blocks.sub_blocks["denoise"]
    loop.sub_blocks.insert("geometry", block.GeometryStep(), 1)
    loop.sub_blocks.insert("after", block.AfterStep(), 3)
    blocks.sub_blocks.insert("evidence", block.GeometryEvidenceStep(), 3)
    blocks.sub_blocks.insert("plan", block.GeometryBeginStep(), 5)
    blocks.sub_blocks["decode"] = block.MetresStep()
    given = {"knobs": KNOBS, "processing_resolution": 96, "prediction_type": prior.config.prediction_type}
    by_hand = assembled(blocks, prior)(**views, **given, generator=seeded())
    ready = assembled(block.GuidedMarigoldBlocks(), prior)(**views, **given, generator=seeded())
    np.testing.assert_array_equal(by_hand.get("depth_m"), ready.get("depth_m"))


def test_each_block_runs_alone(block, prior, views):
    text = assembled(block.TextStep(), prior)
    assert text().get("prompt_embeds").shape[0] == 1
    image = assembled(block.ImageStep(), prior)
    state = image(image=views["image"], processing_resolution=96)
    assert state.get("image_latent").shape[0] == 1 and max(state.get("content")) == 96
    noise = assembled(block.NoiseStep(), prior)(image_latent=state.get("image_latent"), generator=seeded())
    assert noise.get("latents").shape == state.get("image_latent").shape
    timesteps = assembled(block.TimestepsStep(), prior)(image_latent=state.get("image_latent"))
    assert len(timesteps.get("timesteps")) == 4


def test_the_folder_is_what_would_be_pushed(block, tmp_path):
    block.GuidedMarigoldBlocks().save_pretrained(tmp_path)
    written = json.loads((tmp_path / "modular_config.json").read_text())
    committed = json.loads((FOLDER / "modular_config.json").read_text())
    assert committed["auto_map"] == written["auto_map"]
    assert committed["auto_map"] == {"ModularPipelineBlocks": "block.GuidedMarigoldBlocks"}
    assert set(committed["requirements"]) == {"geodiff_plugin"}


@pytest.mark.skipif(shutil.which("patch") is None, reason="needs patch")
def test_the_proposed_callback_applies_to_diffusers(prior, views, tmp_path):
    module = MarigoldDepthPipeline.__module__
    target = tmp_path / "patched.py"
    shutil.copy(sys.modules[module].__file__, target)
    change = FOLDER / "callback_on_step_end.patch"
    subprocess.run(["patch", "--quiet", target, change], check=True, capture_output=True)
    spec = importlib.util.spec_from_file_location(f"{module}_patched", target)
    patched = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(patched)
    pipe = patched.MarigoldDepthPipeline(**prior.components, **_settings(prior))
    options = {"num_inference_steps": 3, "processing_resolution": 96}
    seen = []

    def callback(pipe, step, timestep, tensors):
        seen.append((step, tensors["latents"].shape))
        return {"latents": 0.5 * tensors["latents"]}

    stock = prior(views["image"], **options, generator=seeded()).prediction
    plain = pipe(views["image"], **options, generator=seeded()).prediction
    changed = pipe(views["image"], **options, generator=seeded(), callback_on_step_end=callback).prediction
    np.testing.assert_array_equal(plain, stock)
    assert [step for step, _ in seen] == [0, 1, 2] and not np.array_equal(changed, stock)
    with pytest.raises(ValueError, match="tensor_inputs"):
        pipe(views["image"], **options, callback_on_step_end_tensor_inputs=["text"])


def _settings(prior):
    names = ("prediction_type", "scale_invariant", "shift_invariant")
    return {name: prior.config[name] for name in names}
