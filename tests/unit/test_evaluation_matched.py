"""AbsRel split by whether the two views match, once a sample and the same for every method."""

import numpy as np
import pytest

from geodiff_plugin.evaluation import experiment, scoring
from geodiff_plugin.evaluation.baselines.base import Prediction
from geodiff_plugin.evaluation.baselines.stereo import sweep
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.scoring import matched, regions, score
from geodiff_plugin.evaluation.tables import regions_table


def textured_sample(**changes) -> StereoSample:
    """A wall with texture on its left half, 6 px of disparity, and nothing to match on its right half."""
    wide = np.random.default_rng(0).integers(0, 256, (64, 134, 3), dtype=np.uint8)
    wide[:, 70:] = 128
    camera, E = np.array([[100.0, 0, 64], [0, 100.0, 32], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.12
    depth_m = np.full((64, 128), 2.0, np.float32)
    given = {"K_left": camera, "K_right": camera, "E": E, "depth_m": depth_m, "valid": depth_m > 0}
    return StereoSample("synthetic", "wall", wide[:, :128], wide[:, 6:], **(given | changes))


def test_regions_split_by_whether_the_views_match():
    valid = np.ones((64, 128), bool)
    valid[:8] = False
    sample = textured_sample(valid=valid)
    masks = regions(sample)
    np.testing.assert_array_equal(masks["matched"] | masks["unmatched"], valid)
    assert not (masks["matched"] & masks["unmatched"]).any()
    assert masks["matched"][8:, 10:55].mean() > 0.8 and masks["matched"][8:, 90:].mean() < 0.1
    errors = score(sample, Prediction(np.where(matched(sample), 2.0, 4.0)), None)["regions"]
    assert errors["matched"] == 0 and errors["unmatched"] == pytest.approx(1)


def test_views_are_matched_once_a_sample_and_left_out_where_they_do_not_overlap(monkeypatch):
    swept = []
    monkeypatch.setattr(scoring, "sweep", lambda sample, device: swept.append(1) or sweep(sample, device))
    sample = textured_sample()
    for factor in (1, 2):
        score(experiment._cropped(sample, "none"), Prediction(factor * sample.depth_m), None)
    assert len(swept) == 1
    away = np.diag([-1.0, 1, -1, 1])
    away[0, 3] = 0.12
    behind = textured_sample(E=away)
    assert matched(behind) is None and set(regions(behind)) == {"out_of_view"}


def test_crop_makes_one_object_of_a_sample(monkeypatch):
    monkeypatch.setattr(experiment, "crop_mask", lambda crop, shape: np.arange(shape[1]) > 3)
    sample = textured_sample()
    first = experiment._cropped(sample, "garg")
    assert first is experiment._cropped(sample, "garg") and first.valid.sum() == 64 * 124


def test_matched_and_unmatched_have_columns():
    sample = textured_sample()
    scores = score(sample, Prediction(np.where(matched(sample), 2.0, 4.0)), None)
    record = {"dataset": sample.dataset, "sample": sample.name, "method": "guided", "status": "ok"} | scores
    table = regions_table([record])
    cells = dict(zip(table.header, table.rows[0], strict=True))
    assert (cells["matched (1 pair)"], cells["unmatched (1 pair)"]) == ("0.000", "1.000")
