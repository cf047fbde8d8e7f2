"""Repeated patterns: a real cot, rendered rooms and a tiled wall are not confidently at the wrong period."""

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.bundled.demo_pair import REAL_PAIRS_FOLDER
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.jobs import DepthOptions, depth_pair
from tests.benchmarks.repetition import mean_scores, score, scores_of
from tests.contracts.test_datasets import REAL

pytestmark = pytest.mark.end_to_end

#: Minimum fraction of the pixels with a confidence of 0.9 or more that are correct.
MIN_KEPT = 0.85
#: A tiled wall whose tiles look the same one period away, with exact depth.
TILES = REAL / "inputs5" / "repeated_tiles"
#: The bars above the horse, which are farther than anything nearer to the camera than its head.
BARS, HEAD = (slice(40, 115), slice(345, 462)), (slice(190, 250), slice(350, 400))


@pytest.fixture(scope="module")
def pipe():
    pipe = enable_geometry_guidance(load_prior("bundled"))
    pipe.set_progress_bar_config(disable=True)
    return pipe


@pytest.mark.slow
def test_confident_pixels_of_rendered_patterns_are_correct(pipe):
    """Two rooms with each of five patterns; the arithmetic is in docs/appendix/results-trust.md."""
    found = [score(pipe, load(ref)) for ref in find_pairs("synthetic-repeated:10@448x336")]
    assert len(found) == 10 and mean_scores(found).sure > 0.2
    assert mean_scores(found).kept >= MIN_KEPT


@pytest.mark.slow
@pytest.mark.skipif(not TILES.is_dir(), reason="the tiled wall is not in this checkout")
def test_a_wall_of_tiles_is_not_trusted_because_its_pattern_repeats(tmp_path):
    images = {"left": TILES / "left.jpg", "right": TILES / "right.jpg"}
    run = depth_pair(DepthOptions(**images, fx=420.0, baseline=0.12, out=tmp_path / "out", device="cpu")).run
    verdict = run.output.verdict
    assert not verdict.trusted and verdict.reasons[0].code == "depth.repeated-pattern"
    truth_m = np.load(TILES / "truth.npy")  # of every fourth pixel
    maps = (np.asarray(each)[0, ::4, ::4, 0] for each in (run.output.prediction, run.output.confidence))
    found = scores_of(*maps, truth_m)
    assert found.sure - found.sure_and_within <= (1 - MIN_KEPT) * found.sure


def test_bars_are_not_confidently_at_the_wrong_period(pipe):
    folder = REAL_PAIRS_FOLDER / "donkey_toy"
    rig = read_calibration(folder / "calib.txt")
    left, right = (Image.open(folder / f"{side}.png").convert("RGB") for side in ("left", "right"))
    guidance = GeometryGuidance(right, (rig.K_left, rig.K_right), rig.E)
    out = pipe(left, guidance=guidance, generator=torch.Generator().manual_seed(0))
    depth_m, confidence = (np.asarray(each)[0, ..., 0] for each in (out.prediction, out.confidence))
    head_m = np.median(depth_m[HEAD])
    assert 0.8 < head_m < 1.2
    assert np.median(depth_m[BARS]) > 1.4 * head_m and depth_m[BARS].min() > head_m
    assert (confidence[BARS] < 0.9).mean() > 0.9
    assert out.verdict.trusted and "views.repeated-pattern" in {finding.code for finding in out.findings}
