"""The example model of the robustmvd benchmark: its form, its poses, its metrics."""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest

from examples.robustmvd.model import GeoDiffModel, benchmark_metrics
from examples.robustmvd.write_pairs import write_pairs
from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.tiny import guided_call

pytestmark = pytest.mark.end_to_end

FAST = {"guidance_steps": 0, "min_steps": 1, "pose": "given"}


@pytest.fixture
def sample(textured_plane):
    """Two views as the benchmark's loader collates them; the common frame is none of the cameras'."""
    pair = textured_plane
    common = np.eye(4)
    common[:3, 3] = 0.3, -0.2, 1.0
    poses = [common[None], (np.linalg.inv(pair.E) @ common)[None]]
    images = [view.transpose(2, 0, 1)[None].astype(np.float32) for view in (pair.left, pair.right)]
    intrinsics = [pair.K[None].astype(np.float32)] * 2
    return {"images": images, "poses": poses, "intrinsics": intrinsics, "keyview_idx": [0]}


def test_it_is_the_guided_call(sample, textured_plane):
    model, pair = GeoDiffModel(**FAST), textured_plane
    reported = model.input_adapter(**sample, depth_range=(np.array([0.1]), np.array([100.0])))
    np.testing.assert_allclose(reported["E"][0], pair.E, atol=1e-6)
    pred, aux = model.output_adapter(model(**reported))
    again = guided_call(model.pipe, pair, FAST).prediction
    np.testing.assert_allclose(pred["depth"][0, 0], again[0, ..., 0], rtol=1e-3)
    assert pred["depth_uncertainty"].shape == pred["depth"].shape == (1, 1, *pair.depth_m.shape)
    assert pred["depth_uncertainty"].min() >= 0 and pred["depth_uncertainty"].max() <= 1 and aux["verdict"]
    scores = benchmark_metrics(pred["depth"][0, 0], pair.depth_m, pred["depth_uncertainty"][0, 0])
    assert scores["absrel"] < 5 and 0 <= scores["ause"] < 1


def test_what_it_cannot_use_is_rejected(sample):
    model, one = GeoDiffModel(**FAST), {key: value[:1] for key, value in sample.items()}
    for changed, said in (
        (sample | {"intrinsics": None}, "intrinsics"),
        (sample | {"images": [np.zeros((2, 3, 4, 4))] * 2}, "one sample at a time"),
        (one, "source view"),
    ):
        with pytest.raises(ValueError, match=said):
            model(**model.input_adapter(**changed))


def test_samples_are_written_as_pairs_of_the_key_view_and_its_nearest_source(
    sample, textured_plane, tmp_path
):
    pair = textured_plane
    away = np.full_like(pair.left, 7)
    mine = {
        "images": [
            away.transpose(2, 0, 1),
            sample["images"][1][0],
            away.transpose(2, 0, 1),
            sample["images"][0][0],
        ],
        "poses": [np.eye(4), sample["poses"][1][0], np.eye(4), sample["poses"][0][0]],
        "intrinsics": [pair.K] * 4,
        "keyview_idx": np.array(3),
        "depth": pair.depth_m[None],
    }
    order = [0, 2, 1, 3]  # the source next to the key view is the pair's right view
    mine |= {name: [mine[name][i] for i in order] for name in ("images", "poses")}
    assert write_pairs(tmp_path, [mine, mine], "kitti") == 2
    first, second = find_pairs(tmp_path, ["mvsnet"])
    assert (first.name, second.name) == ("kitti-0000", "kitti-0001")
    read = load(second)
    np.testing.assert_array_equal(read.left, pair.left)
    np.testing.assert_array_equal(read.right, pair.right)
    np.testing.assert_allclose(read.E, pair.E, atol=1e-6)
    np.testing.assert_allclose(read.K_left, pair.K, rtol=1e-8)
    np.testing.assert_allclose(read.depth_m, pair.depth_m, rtol=1e-6)


def map_and_truth():
    drawn = np.random.default_rng(0)
    ground_truth = drawn.uniform(0.5, 90.0, (24, 32)).astype(np.float32)
    depth = ground_truth * np.exp(drawn.normal(0, 0.05, ground_truth.shape)).astype(np.float32)
    ground_truth[drawn.random(ground_truth.shape) < 0.2] = 0
    return depth, ground_truth, drawn.random(ground_truth.shape).astype(np.float32)


def test_metrics_by_hand():
    depth, ground_truth, uncertainty = map_and_truth()
    valid = ground_truth > 0
    error = np.where(valid, np.abs(depth - ground_truth) / (ground_truth + ~valid), 0)
    scores = benchmark_metrics(depth, ground_truth, error)
    assert scores["absrel"] == pytest.approx(100 * error[valid].mean(), rel=1e-5)
    inside = (depth[valid] < 1.03 * ground_truth[valid]) & (ground_truth[valid] < 1.03 * depth[valid])
    assert scores["inliers103"] == pytest.approx(100 * inside.mean(), rel=1e-5)
    assert scores["ause"] == pytest.approx(0, abs=1e-6)
    assert benchmark_metrics(depth, ground_truth, uncertainty)["ause"] > 0.1


@pytest.mark.skipif("ROBUSTMVD" not in os.environ, reason="ROBUSTMVD names no checkout of the benchmark")
def test_metrics_are_the_benchmarks(monkeypatch):
    stock = np.nan_to_num  # the benchmark's call is NumPy 1's
    monkeypatch.setattr(np, "nan_to_num", lambda x, copy=True, **fill: stock(x, **fill))
    path = Path(os.environ["ROBUSTMVD"]) / "rmvd" / "eval" / "metrics.py"
    spec = importlib.util.spec_from_file_location("benchmark_metrics_of_rmvd", path)
    theirs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(theirs)
    depth, ground_truth, uncertainty = map_and_truth()
    ours, mask = benchmark_metrics(depth, ground_truth, uncertainty), np.ones_like(ground_truth, dtype=bool)
    given = {"gt": ground_truth, "pred": np.clip(depth, 0.1, 100)}
    percent = given | {"output_scaling_factor": 100.0}
    assert ours["absrel"] == pytest.approx(theirs.m_rel_ae(**percent), rel=1e-5)
    assert ours["inliers103"] == pytest.approx(theirs.thresh_inliers(**percent, thresh=1.03), rel=1e-5)
    oracle = theirs.pointwise_rel_ae(**given, mask=mask)
    curves = [theirs.sparsification(**given, uncertainty=u, mask=mask.copy()) for u in (uncertainty, oracle)]
    assert ours["ause"] == pytest.approx(float((curves[0] - curves[1]).sum() / 100), abs=2e-3)
