"""Marigold-DC: our preset against the authors' own code on the same random weights and the same points."""

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import MarigoldDepthPipeline
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.parity.marigold_dc_reference import CASES, SEED, build, image_u8, keep, sparse_depth

FIXTURE = Path(__file__).parent / "fixtures" / "marigold_dc.npz"


@pytest.fixture(scope="module")
def pipe():
    return enable_geometry_guidance(build(MarigoldDepthPipeline))


@pytest.mark.parametrize("case", CASES)
def test_completed_depth_is_theirs(pipe, case):
    (height, width), resolution, steps, members = CASES[case]
    K = np.array([[60.0, 0, width / 2], [0, 60.0, height / 2], [0, 0, 1]])
    out = pipe(
        Image.fromarray(image_u8(case)),
        guidance=GeometryGuidance.marigold_dc(sparse_depth(case), K),
        num_inference_steps=steps,
        ensemble_size=members,
        processing_resolution=resolution,
        generator=torch.Generator().manual_seed(SEED),
    )
    theirs = np.load(FIXTURE)[case]
    assert theirs.std() > 0.05
    np.testing.assert_allclose(keep(out.prediction[0, ..., 0]), theirs, atol=1e-4, rtol=0)


def test_without_steps_it_takes_fifty():
    points = np.array([[0.0, 0.0, 2.0], [0.1, 0.1, 3.0]])
    guidance = GeometryGuidance.marigold_dc(points, np.diag([60.0, 60.0, 1.0]) + np.eye(3, k=2)[:3] * 30)
    assert guidance.config.min_steps == 50
