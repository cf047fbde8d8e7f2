"""Both views guided, each with what the other is sure of."""

from __future__ import annotations

import numpy as np
import pytest

from geodiff_plugin import enable_geometry_guidance, guide_both_views, load_bundled_prior
from tests.scenes import render_pair

CALL = {"processing_resolution": 64, "num_inference_steps": 2}


@pytest.fixture(scope="module")
def pair():
    return render_pair(4, size=(96, 128), exposure=False)


@pytest.fixture(scope="module")
def pipe():
    pipe = enable_geometry_guidance(load_bundled_prior())
    pipe.set_progress_bar_config(disable=True)
    return pipe


def _error(output, view) -> float:
    depth, truth, valid = output.prediction[0, ..., 0], view.depth_m[0].numpy(), view.valid[0].numpy()
    return float(np.mean(np.abs(depth - truth)[valid] / truth[valid]))


def test_each_view_gets_metres_of_its_own(pipe, pair):
    knobs = {"inner_steps": 2}
    K, E = (pair.K_left.numpy(), pair.K_right.numpy()), pair.E.numpy()
    left, right = guide_both_views(
        pipe, pair.left.image_01, pair.right.image_01, K, E, knobs=knobs, min_confidence=0.6, **CALL
    )
    assert left.prediction.shape == right.prediction.shape == (1, 96, 128, 1)
    assert _error(left, pair.left) < 0.3 and _error(right, pair.right) < 0.3
    assert np.allclose(right.K[0], K[1])


def test_a_preset_that_does_not_know_how_sure_it_is_is_refused(pipe, pair):
    K, E = (pair.K_left.numpy(), pair.K_right.numpy()), pair.E.numpy()
    with pytest.raises(ValueError, match="refine=True"):
        guide_both_views(
            pipe,
            pair.left.image_01,
            pair.right.image_01,
            K,
            E,
            knobs={"refine": False, "inner_steps": 0},
            **CALL,
        )
