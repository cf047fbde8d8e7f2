"""The modular block: a guided call like any other, alone and with a block of diffusers' own."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from diffusers.modular_pipelines import SequentialPipelineBlocks
from diffusers.modular_pipelines.qwenimage.encoders import QwenImageEditResizeStep
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.contracts.tiny_priors import make_depthmaster

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "modular"
KNOBS = {"inner_steps": 1, "min_steps": 1}


@pytest.fixture(scope="module")
def block():
    spec = importlib.util.spec_from_file_location("block", FOLDER / "block.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["block"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["block"]


@pytest.fixture
def views(textured_plane):
    left, right = (Image.fromarray(getattr(textured_plane, side)) for side in ("left", "right"))
    return {"image": left, "right": right, "K": textured_plane.K, "E": textured_plane.E, "knobs": KNOBS}


@pytest.fixture
def pipe(block):
    pipe = block.GuidedDepthBlock().init_pipeline()
    pipe.update_components(prior=make_depthmaster())
    return pipe


def test_it_is_the_guided_call(pipe, views):
    state = pipe(**views)
    guidance = GeometryGuidance(views["right"], views["K"], views["E"], **KNOBS)
    out = enable_geometry_guidance(make_depthmaster())(views["image"], guidance=guidance)
    assert np.array_equal(state.get("depth_m"), out.prediction[0, ..., 0])
    assert np.array_equal(state.get("confidence"), out.confidence[0, ..., 0])
    assert state.get("guided_output").history


def test_it_composes_with_a_block_of_diffusers(block, views):
    parts = {"depth": block.GuidedDepthBlock(picture_as="image"), "resize": QwenImageEditResizeStep()}
    both = SequentialPipelineBlocks.from_blocks_dict(parts)
    assert {"image", "right", "K", "E", "points"} <= set(both.input_names)
    pipe = both.init_pipeline()
    pipe.update_components(prior=make_depthmaster())
    state = pipe(**views)
    (resized,) = state.get("resized_image")
    picture = np.asarray(resized.resize(views["image"].size).convert("L"), dtype=float)
    assert resized.width > 3 * views["image"].width  # to the area that diffusers' editor works at
    nearness = 1.0 / state.get("depth_m")
    assert np.corrcoef(picture.ravel(), nearness.ravel())[0, 1] > 0.9


def test_points_alone_and_a_calibration_file(pipe, views, textured_plane, tmp_path):
    points = np.zeros_like(textured_plane.depth_m)
    points[::6, ::6] = textured_plane.depth_m[::6, ::6]
    depth_m = pipe(image=views["image"], K=views["K"], points=points, knobs=KNOBS, output="depth_m")
    assert np.median(np.abs(depth_m / textured_plane.depth_m - 1)) < 0.1
    height, width = textured_plane.depth_m.shape
    K = textured_plane.K
    camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
    baseline = 1000 * textured_plane.E[0, 3]
    (tmp_path / "calib.txt").write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={baseline}\n"
        f"width={width}\nheight={height}\nndisp=32\n"
    )
    given = {key: views[key] for key in ("image", "right", "knobs")}
    by_file = pipe(**given, calibration=tmp_path / "calib.txt", output="depth_m")
    assert np.allclose(by_file, pipe(**views, output="depth_m"), rtol=1e-3)


def test_the_prior_of_the_package_is_the_default_component(block):
    pipe = block.GuidedDepthBlock().init_pipeline()
    pipe.load_components()
    assert type(pipe.prior).__name__ == "GuidedMarigoldDepthPipeline"


def test_the_folder_is_what_would_be_pushed(block, tmp_path):
    block.GuidedDepthBlock().save_pretrained(tmp_path)
    written = json.loads((tmp_path / "modular_config.json").read_text())
    committed = json.loads((FOLDER / "modular_config.json").read_text())
    assert committed["auto_map"] == written["auto_map"] == {"ModularPipelineBlocks": "block.GuidedDepthBlock"}
    assert set(committed["requirements"]) == {"geodiff_plugin"}
