"""What every entry of METHODS owes: an answer of the left image's shape, or a reason why it has none."""

import json

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.evaluation.baselines import METHODS, NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.baselines.stereo import fill_background, sgbm_shift
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.geometry import is_rectified
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from tests.contracts.tiny_transformers import make_transformers

NAN = np.nan


def make_sample(pair, E=None) -> StereoSample:
    E = pair.E if E is None else E
    valid = np.ones(pair.depth_m.shape, bool)
    return StereoSample(
        "middlebury2014",
        "plane",
        pair.left,
        pair.right,
        pair.K,
        pair.K,
        E,
        pair.depth_m,
        valid,
        rectified=bool(is_rectified(*(torch.as_tensor(m) for m in (pair.K, pair.K, np.linalg.inv(E))))),
    )


@pytest.fixture
def priors(make_pipeline):
    """A cache that holds one tiny random prior, whatever it is asked for."""

    class Tiny(PriorCache):
        def __init__(self, pipe):
            super().__init__()
            enable_geometry_guidance(pipe)
            self._pipe = pipe

        def get(self, settings):
            return self._pipe

    return Tiny(make_pipeline())


@pytest.mark.parametrize("name", METHODS)
def test_method_answers_for_a_rectified_pair(name, priors, textured_plane):
    sample = make_sample(textured_plane)
    if name == "sgbm-wls" and not hasattr(cv2, "ximgproc"):
        pytest.skip("opencv-contrib is not installed")
    prediction = METHODS[name].run(sample, Settings(steps=1), priors)
    assert (prediction.depth_m is None) != (prediction.relative is None)
    record = score(sample, prediction, cap_m=None)
    assert record["all_pixels"]["aligned"]["coverage"] > 0.5
    json.dumps(dict(prediction.notes))


@pytest.mark.parametrize("name", METHODS)
def test_method_answers_for_a_posed_pair_or_says_why_not(name, priors, textured_plane):
    E = textured_plane.E.copy()
    E[1, 3] = 0.05
    sample = make_sample(textured_plane, E)
    try:
        prediction = METHODS[name].run(sample, Settings(steps=1), priors)
    except NotApplicable as reason:
        assert name.startswith("sgbm") and "rectified" in str(reason)
    else:
        values = prediction.depth_m if prediction.relative is None else prediction.relative
        assert values.shape == sample.depth_m.shape


@pytest.mark.parametrize("name", METHODS)
def test_configuration_is_json_and_names_what_matters(name):
    method = METHODS[name]
    assert method.name == name and method.summary
    plain = json.dumps(method.configuration(Settings()), sort_keys=True)
    other = json.dumps(method.configuration(Settings(seed=1)), sort_keys=True)
    assert (plain != other) == method.uses_prior
    assert "bundled" not in plain  # the prior has its own place in the key


@pytest.mark.parametrize(
    "name", [*(key for key in METHODS if not key.startswith("sgbm")), "hf:somewhere/model"]
)
def test_seconds_of_another_device_are_another_result(name):
    """All but SGBM, which OpenCV runs on the CPU."""
    method = find_method(name)
    assert method.configuration(Settings(device="cuda")) != method.configuration(Settings())


def test_same_seed_gives_the_same_depth(priors, textured_plane):
    sample = make_sample(textured_plane)
    first, second = (METHODS["guided"].run(sample, Settings(steps=1), priors) for _ in range(2))
    np.testing.assert_array_equal(first.depth_m, second.depth_m)


def test_ensemble_brings_uncertainty(priors, textured_plane):
    sample = make_sample(textured_plane)
    prediction = METHODS["search-only"].run(sample, Settings(steps=1, ensemble=3), priors)
    assert prediction.uncertainty.shape == sample.depth_m.shape


def test_fingerprint_tells_priors_apart(make_pipeline, monkeypatch):
    pipes = [make_pipeline(), make_pipeline(), make_pipeline(), make_pipeline()]
    next(pipes[2].unet.parameters()).data += 1
    pipes[3].register_to_config(prediction_type="disparity")

    def fingerprint(pipe):
        cache = PriorCache()
        monkeypatch.setattr(cache, "get", lambda settings: pipe)
        return cache.fingerprint(Settings())

    same, again, trained, other_space = (fingerprint(pipe) for pipe in pipes)
    assert same == again and len({same, trained, other_space}) == 3


def test_a_decoder_in_a_folder_counts_by_its_files(tmp_path):
    method = find_method(f"guided:decoder={tmp_path}")
    before = method.configuration(Settings())
    (tmp_path / "diffusion_pytorch_model.safetensors").write_bytes(b"trained further")
    assert method.configuration(Settings()) != before
    plain = METHODS["guided"].configuration(Settings())
    assert plain["guidance"]["decoder"] == "full" and "decoder_files" not in plain


@pytest.mark.parametrize("name", ["paper", "guided:gradient=full"])
def test_no_gradient_goes_through_a_network_that_does_not_see_z_t(name, textured_plane, monkeypatch):
    cache, pipe = PriorCache(), enable_geometry_guidance(make_transformers("glpn"))
    monkeypatch.setattr(cache, "get", lambda settings: pipe)
    with pytest.raises(NotApplicable, match="does not see"):
        find_method(name).run(make_sample(textured_plane), Settings(), cache)


@pytest.mark.parametrize("doffs", [0.0, 3.5])
def test_sgbm_recovers_a_known_shift(doffs):
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (48, 160, 3), dtype=np.uint8)
    left, right = wide[:, :144], wide[:, 6:150]  # x_left - x_right = 6
    K = np.array([[100.0, 0, 70], [0, 100.0, 24], [0, 0, 1]])
    K_right = K.copy()
    K_right[0, 2] += doffs
    E = np.eye(4)
    E[0, 3] = 0.1
    truth = np.full((48, 144), 10.0 / (6 + doffs), np.float32)
    sample = StereoSample("folder", "shift", left, right, K, K_right, E, truth, truth > 0, rectified=True)
    shift = sgbm_shift(sample)
    assert np.isfinite(shift).mean() > 0.8
    assert np.nanmedian(shift) == pytest.approx(6 + doffs, abs=1 / 16)
    depth_m = METHODS["sgbm"].run(sample, Settings(), PriorCache()).depth_m
    assert np.median(np.abs(depth_m / truth - 1)) < 0.02


def test_background_fill_takes_the_farther_neighbour():
    holes = np.array(
        [
            [NAN, NAN, NAN, NAN, NAN],
            [NAN, 5.0, NAN, 2.0, NAN],
            [NAN, NAN, NAN, NAN, NAN],
            [3.0, NAN, NAN, 9.0, 9.0],
        ]
    )
    expected = [[5, 5, 2, 2, 2], [5, 5, 2, 2, 2], [5, 5, 2, 2, 2], [3, 3, 3, 9, 9]]
    np.testing.assert_array_equal(fill_background(holes), expected)
    assert np.isnan(fill_background(np.full((2, 3), NAN))).all()
