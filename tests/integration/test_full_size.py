"""Marigold v1-1's own size, with random weights: the guided call fits, in both gradient modes."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.benchmarks.random_marigold import random_marigold
from tests.conftest import plane_pair


@pytest.mark.slow
@pytest.mark.parametrize("gradient", ["denoised", "full"])
def test_full_size_model_is_guided(gradient):
    pair = plane_pair(size=(192, 256), focal=240.0)
    pipe = enable_geometry_guidance(random_marigold())
    pipe.set_progress_bar_config(disable=True)
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, gradient=gradient, inner_steps=1)
    out = pipe(
        Image.fromarray(pair.left), guidance=guidance, num_inference_steps=1, processing_resolution=256
    )
    assert sum(p.numel() for p in pipe.unet.parameters()) > 860e6
    assert np.isfinite(out.prediction).all() and out.prediction.shape == (1, 192, 256, 1)
    assert all(p.grad is None for p in pipe.unet.parameters())
