"""The cot of a real pair: bars at about 2 m, which match at 0.6 m as well, two periods away."""

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.bundled.demo_pair import REAL_PAIRS_FOLDER

pytestmark = pytest.mark.end_to_end

#: The bars above the horse, which are farther than anything nearer to the camera than its head.
BARS, HEAD = (slice(40, 115), slice(345, 462)), (slice(190, 250), slice(350, 400))


def test_bars_are_not_confidently_at_the_wrong_period():
    folder = REAL_PAIRS_FOLDER / "donkey_toy"
    rig = read_calibration(folder / "calib.txt")
    left, right = (Image.open(folder / f"{side}.png").convert("RGB") for side in ("left", "right"))
    pipe = enable_geometry_guidance(load_prior("bundled"))
    guidance = GeometryGuidance(right, (rig.K_left, rig.K_right), rig.E)
    out = pipe(left, guidance=guidance, generator=torch.Generator().manual_seed(0))
    depth_m, confidence = (np.asarray(each)[0, ..., 0] for each in (out.prediction, out.confidence))
    head_m = np.median(depth_m[HEAD])
    assert 0.8 < head_m < 1.2
    assert np.median(depth_m[BARS]) > 1.4 * head_m and depth_m[BARS].min() > head_m
    assert (confidence[BARS] < 0.9).mean() > 0.9
    assert out.verdict.trusted and "views.repeated-pattern" in {finding.code for finding in out.findings}
