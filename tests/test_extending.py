"""Every block of docs/extending.md runs, and what it adds to the tables works."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import UNet2DModel
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.priors import PRIORS
from geodiff_plugin.priors.pipelines.direct_scheduler import DirectScheduler
from geodiff_plugin.terms import TERMS
from geodiff_plugin.updates import RULES
from tests.conftest import make_vae

PAGE = Path(__file__).resolve().parents[1] / "docs" / "extending.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def page():
    """The names that the page's blocks define, the tables with what they add; all as before afterwards."""
    before = [(table, dict(table)) for table in (PRIORS, TERMS, RULES)]
    names: dict = {}
    for block in BLOCKS:
        exec(compile(block, PAGE.name, "exec"), names)
    yield names
    for table, entries in before:
        table.clear()
        table.update(entries)


def test_a_prior_takes_less_than_40_lines():
    (prior,) = [block for block in BLOCKS if 'PRIORS["' in block]
    assert len([line for line in prior.splitlines() if line.strip()]) < 40
    assert max(map(len, prior.splitlines())) <= 120


def test_what_the_page_adds_works(page, textured_plane, tmp_path):
    torch.manual_seed(0)
    unet = UNet2DModel(
        in_channels=4,
        out_channels=4,
        block_out_channels=(8, 8),
        down_block_types=("DownBlock2D",) * 2,
        up_block_types=("UpBlock2D",) * 2,
        norm_num_groups=4,
    )
    tiny = page["InkPipeline"](unet, make_vae(), DirectScheduler(), default_processing_resolution=64)
    tiny.save_pretrained(tmp_path)
    pipe = enable_geometry_guidance(load_prior(tmp_path))
    pipe.set_progress_bar_config(disable=True)
    assert isinstance(pipe, page["InkPipeline"])
    guidance = GeometryGuidance(
        textured_plane.right,
        textured_plane.K,
        textured_plane.E,
        rule="sign",
        weights={"photometric": 1.0, "far_pull": 0.1},
        inner_steps=2,
        min_steps=2,
        loss_resolution=64,
    )
    out = pipe(Image.fromarray(textured_plane.left), guidance=guidance)
    assert (out.prediction > 0).all() and np.isfinite(out.prediction).all()
    assert "far_pull" in out.history[0].terms and len(out.history) == 2
