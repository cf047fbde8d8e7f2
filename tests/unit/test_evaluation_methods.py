"""What every entry of METHODS owes, and what the methods beside guidance answer: maps, models, SGBM."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.evaluation.baselines import METHODS, NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.baselines.unguided import sgbm_shift
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample, make_sample
from geodiff_plugin.evaluation.experiment import score
from geodiff_plugin.formats import write_depth_mm, write_pfm
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.types import Rig
from tests.contracts.tiny_transformers import MODELS, make_transformers
from tests.evaluating import write_scenes

SHAPE = (32, 48)


def plane_sample(pair, E=None) -> StereoSample:
    rig = Rig(pair.K, pair.K, pair.E if E is None else E)
    return make_sample(SampleRef("folder", "plane", {}), (pair.left, pair.right), rig, pair.depth_m, {})


class OnePipe(PriorCache):
    """A cache that holds one pipeline, whatever prior but a map it is asked for."""

    def __init__(self, pipe):
        super().__init__()
        self._pipe = enable_geometry_guidance(pipe)

    def get(self, settings):
        return super().get(settings) if settings.prior == "map" else self._pipe


@pytest.fixture
def priors(make_pipeline):
    return OnePipe(make_pipeline())


@pytest.mark.parametrize("name", METHODS)
def test_method_answers_for_a_rectified_pair_and_a_posed_one_or_says_why_not(name, priors, textured_plane):
    E = textured_plane.E.copy()
    E[1, 3] = 0.05
    for sample in (plane_sample(textured_plane), plane_sample(textured_plane, E)):
        if name == "sgbm-wls" and sample.rectified and not hasattr(cv2, "ximgproc"):
            with pytest.raises(NotApplicable, match="opencv-contrib-python"):
                METHODS[name].run(sample, Settings(), priors)
        elif name in ("sgbm", "sgbm-wls") and not sample.rectified:
            with pytest.raises(NotApplicable, match="not rectified"):
                METHODS[name].run(sample, Settings(), priors)
        else:
            prediction = METHODS[name].run(sample, Settings(steps=1), priors)
            assert (prediction.depth_m is None) != (prediction.relative is None)
            assert score(sample, prediction, cap_m=None)["all_pixels"]["aligned"]["coverage"] > 0.5
            json.dumps(dict(prediction.notes))


@pytest.mark.parametrize("name", [*METHODS, "hf:somewhere/model"])
def test_configuration_is_json_and_names_what_matters(name):
    """Seconds of another device are another result, but of SGBM, which OpenCV runs on the CPU."""
    method = find_method(name)
    assert method.name == name and method.summary
    settings = Settings(), Settings(seed=1), Settings(device="cuda")
    plain, other, on_cuda = (json.dumps(method.configuration(s), sort_keys=True) for s in settings)
    assert (plain != other) == method.uses_prior and (on_cuda == plain) == (name in ("sgbm", "sgbm-wls"))
    assert "bundled" not in plain  # the prior has its own place in the key


def test_an_ensemble_brings_uncertainty_and_metres_are_aligned_in_the_priors_space(
    make_pipeline, textured_plane
):
    sample, priors = plane_sample(textured_plane), OnePipe(make_pipeline(prediction_type="log"))
    spread = METHODS["search-only"].run(sample, Settings(steps=1, ensemble=3), priors)
    assert spread.uncertainty.shape == sample.depth_m.shape and spread.space == "log"


def test_fingerprint_tells_priors_and_decoders_apart(make_pipeline, tmp_path):
    pipes = [make_pipeline() for _ in range(4)]
    next(pipes[2].unet.parameters()).data += 1
    pipes[3].register_to_config(prediction_type="disparity")
    same, again, trained, other_space = (OnePipe(pipe).fingerprint(Settings()) for pipe in pipes)
    assert same == again and len({same, trained, other_space}) == 3
    for name in (f"guided:decoder={tmp_path}", f"hf:{tmp_path}", f"files:{tmp_path}"):
        before = find_method(name).configuration(Settings())
        (tmp_path / f"{len(name)}.safetensors").write_bytes(b"trained further")
        assert find_method(name).configuration(Settings()) != before


@pytest.mark.parametrize("name", ["paper", "guided:gradient=full"])
def test_no_gradient_goes_through_a_network_that_does_not_see_z_t(name, textured_plane):
    with pytest.raises(NotApplicable, match="does not see"):
        find_method(name).run(plane_sample(textured_plane), Settings(), OnePipe(make_transformers("glpn")))


def slope() -> StereoSample:
    """A slope from 1 to 2.5 m; the right camera's principal point lies 2 px further (doffs)."""
    image, E = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8), np.eye(4)
    K, K_right = (np.array([[30.0, 0, cx], [0, 30.0, 15.5], [0, 0, 1]]) for cx in (23.5, 25.5))
    E[0, 3], depth_m = 0.2, np.linspace(1.0, 2.5, SHAPE[1], dtype=np.float32)[None].repeat(SHAPE[0], 0)
    return make_sample(SampleRef("folder", "mine", {}), (image, image), Rig(K, K_right, E), depth_m, {})


def run(name, sample):
    return find_method(name).run(sample, Settings(), PriorCache())


def write_disparity_png(path, values):
    Image.fromarray(np.rint(256 * values).astype(np.uint16)).save(path)


@pytest.mark.parametrize(
    ("kind", "suffix", "save", "hole", "tolerance"),
    [
        ("depth", ".pfm", write_pfm, 0, 1e-6),
        ("depth", ".png", write_depth_mm, 0, 1e-3),
        ("disparity", ".npy", np.save, np.inf, 1e-5),
        ("disparity", ".png", write_disparity_png, 0, 2e-3),
    ],
)
def test_metric_maps_are_read_and_holes_stay(tmp_path, kind, suffix, save, hole, tolerance):
    sample = slope()
    values = sample.depth_m.copy() if kind == "depth" else 30.0 * 0.2 / sample.depth_m - 2
    values[:3, :3] = hole
    save(tmp_path / f"folder_mine{suffix}", values)
    prediction = run(f"files:{kind}:{tmp_path}", sample)
    assert np.isnan(prediction.depth_m[:3, :3]).all()
    np.testing.assert_allclose(prediction.depth_m[3:], sample.depth_m[3:], rtol=tolerance)


def test_relative_maps_are_aligned_only_and_another_size_is_resized_in_value_too(tmp_path):
    sample, path = slope(), tmp_path / "folder_mine.npy"
    np.save(path, 7 - 3 / sample.depth_m)  # no map of inverse depth falls with it
    record = score(sample, run(f"files:relative-disparity:{tmp_path}", sample), None)["all_pixels"]
    assert record["raw"] is None and record["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    np.save(path, np.full((2 * SHAPE[0], 2 * SHAPE[1]), 2 * 3.0))
    np.testing.assert_allclose(run(f"files:disparity:{tmp_path}", sample).depth_m, 6.0 / (3 + 2), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "changes", "error", "said"),
    [
        ("files:{}", None, {}, NotApplicable, "no map"),
        ("files:disparity:{}", np.ones(SHAPE), {"rectified": False}, NotApplicable, "not rectified"),
        ("files:{}", np.full(SHAPE, 2000), {}, ValueError, r"metres as floats.*int64.*1000 for millimetres"),
        ("files:{}/nowhere", None, {}, ValueError, "files:KIND:DIR with an existing folder"),
        ("hf:", None, {}, ValueError, "hf:MODEL"),
        ("sgbm", None, {"right": np.zeros((16, 48, 3), np.uint8)}, NotApplicable, "different sizes"),
    ],
)
def test_what_does_not_apply_is_a_reason_and_what_is_wrong_is_named(
    tmp_path, name, content, changes, error, said
):
    if content is not None:
        np.save(tmp_path / "folder_mine.npy", content)
    with pytest.raises(error, match=said):
        run(name.format(tmp_path), replace(slope(), **changes))


@pytest.mark.parametrize(("kind", "metric"), [("dpt", False), ("glpn", True)])
def test_depth_models_of_transformers_answer(tmp_path, kind, metric):
    torch.manual_seed(0)
    model, preparation = MODELS[kind]()
    model.save_pretrained(tmp_path / "tiny-model")
    (tmp_path / "tiny-model" / "preprocessor_config.json").write_text(json.dumps(preparation))
    name = f"hf:{tmp_path / 'tiny-model'}"
    method, prediction = find_method(name), run(name, slope())
    assert method.title == "tiny-model" and not method.uses_prior
    assert prediction.space == ("depth" if metric else "disparity")
    assert prediction.relative.shape == SHAPE and np.isfinite(prediction.relative).all()
    assert (prediction.depth_m is not None) == metric


@pytest.mark.parametrize("doffs", [0.0, 3.5])
def test_sgbm_recovers_a_known_shift(tmp_path, doffs):
    wall = load(find_pairs(write_scenes(tmp_path, "wall"))[0])
    sample = replace(wall, K_right=wall.K_right + np.array([[0, 0, doffs], [0, 0, 0], [0, 0, 0]]))
    shift = sgbm_shift(sample)
    assert np.isfinite(shift).mean() > 0.8 and np.nanmedian(shift) == pytest.approx(8 + doffs, abs=1 / 16)
    assert np.median(run("sgbm", sample).depth_m) == pytest.approx(10 / (8 + doffs), rel=0.02)
