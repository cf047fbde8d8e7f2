"""``crisp`` in a guided call: fewer pixels between two surfaces, and no depth that is worse for it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER as PAIR
from geodiff_plugin.formats import flying_points, read_depth_png


@pytest.mark.slow
def test_the_demo_pair_has_fewer_flying_points_with_it():
    truth_m, known = read_depth_png(PAIR / "depth_mm.png")
    pipe = enable_geometry_guidance(load_prior("bundled"))
    pipe.set_progress_bar_config(disable=True)
    flying, error = {}, {}
    for crisp in (False, True):
        guidance = GeometryGuidance.from_calibration(
            Image.open(PAIR / "right.png"), PAIR / "calib.txt", crisp=crisp
        )
        out = pipe(
            Image.open(PAIR / "left.png"),
            guidance=guidance,
            ensemble_size=3,
            output_uncertainty=True,
            generator=torch.Generator().manual_seed(0),
        )
        depth_m = out.prediction[0, ..., 0]
        flying[crisp] = flying_points(depth_m).mean()
        error[crisp] = (np.abs(depth_m - truth_m)[known] / truth_m[known]).mean()
        assert np.isfinite(out.uncertainty).all()
    assert flying[True] < 0.9 * flying[False]
    assert error[True] < 1.01 * error[False]
