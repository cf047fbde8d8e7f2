"""The record of one prediction: raw, aligned and capped, by region, with holes and wrong poses."""

import numpy as np
import pytest

from geodiff_plugin.evaluation import experiment, scoring
from geodiff_plugin.evaluation.baselines import Prediction
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.evaluation.datasets.sample import with_perturbed_poses
from geodiff_plugin.evaluation.scoring import matched, out_of_view, regions, score
from geodiff_plugin.evaluation.tables import details_tables, headline

SHAPE = (6, 8)


def make_sample(name="a", **changes) -> StereoSample:
    """A wall 2 m away, 5 m in its first two columns; 0.52 m of baseline; fy is not fx."""
    K, E = np.array([[10.0, 0, 3.5], [0, 12.0, 2.5], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.52
    image, depth_m = np.zeros((*SHAPE, 3), np.uint8), np.full(SHAPE, 2.0, np.float32)
    depth_m[:, :2] = 5.0
    cameras = {"K_left": K, "K_right": K, "E": E}
    given = cameras | {"depth_m": depth_m, "valid": depth_m > 0, "rectified": True}
    return StereoSample("middlebury2014", name, image, image, **(given | changes))


def textured_sample(**changes) -> StereoSample:
    """A wall with texture on its left half, 6 px of disparity, and nothing to match on its right half."""
    wide = np.random.default_rng(0).integers(0, 256, (64, 134, 3), dtype=np.uint8)
    wide[:, 70:] = 128
    camera, E = np.array([[100.0, 0, 64], [0, 100.0, 32], [0, 0, 1]]), np.eye(4)
    E[0, 3] = 0.12
    depth_m = np.full((64, 128), 2.0, np.float32)
    given = {"K_left": camera, "K_right": camera, "E": E, "depth_m": depth_m, "valid": depth_m > 0}
    return StereoSample("synthetic", "wall", wide[:, :128], wide[:, 6:], **(given | changes))


def test_raw_aligned_and_capped():
    sample = make_sample()
    exact = score(sample, Prediction(sample.depth_m), None)
    assert exact["all_pixels"]["raw"]["abs_rel"] == 0 and exact["capped"] is exact["all_pixels"]
    double = score(sample, Prediction(2 * sample.depth_m), None)
    assert double["all_pixels"]["raw"]["abs_rel"] == pytest.approx(1)
    assert double["all_pixels"]["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    # A doubled depth halves the shift of f b / z = 5.2 / z: by 0.52 px in 12 of 48 pixels, by 1.3 px in 36.
    assert double["disparity"]["epe"] == pytest.approx(0.25 * 0.52 + 0.75 * 1.3, rel=1e-5)
    assert double["disparity"]["bad1"] == 0.75
    capped = score(sample, Prediction(np.full(SHAPE, 4.0)), cap_m=3.0)
    assert capped["all_pixels"]["raw"]["pixels"] == 48 and capped["capped"]["raw"]["pixels"] == 36
    assert capped["capped"]["raw"]["abs_rel"] == pytest.approx(0.5)  # clipped from 4 to the cap of 3


def test_relative_depth_has_no_raw_column_and_holes_no_errors():
    sample = make_sample()
    relative = score(sample, Prediction(None, relative=0.1 * sample.depth_m + 0.3), None)
    assert relative["all_pixels"]["raw"] is relative["disparity"] is None
    assert headline({"status": "ok"} | relative) == pytest.approx(0, abs=1e-6)
    holes = score(sample, Prediction(np.full(SHAPE, np.nan), space="disparity"), None)
    raw, aligned = holes["all_pixels"]["raw"], holes["all_pixels"]["aligned"]
    assert raw["abs_rel"] is aligned["abs_rel"] is None and raw["coverage"] == 0
    assert headline({"status": "ok"} | holes) is None


def test_poses_given_wrongly_change_no_mask_and_no_true_disparity(monkeypatch):
    sample, swept = make_sample(), []
    wrong = with_perturbed_poses(sample, (20.0, 0.5), "a")
    assert not np.allclose(wrong.E, sample.E)
    np.testing.assert_array_equal(out_of_view(wrong), out_of_view(sample))
    double = Prediction(2 * sample.depth_m)
    assert score(wrong, double, None)["disparity"] == score(sample, double, None)["disparity"]
    monkeypatch.setattr(scoring, "sweep", lambda sample, _: swept.append(sample.E) or sweep(sample, "cpu"))
    assert matched(with_perturbed_poses(sample, (20.0, 0.5), "b")) is None  # too small an image
    np.testing.assert_array_equal(swept[0], sample.E)


def test_regions_split_what_the_right_camera_sees_and_tables_show_them():
    occluded, material = np.zeros(SHAPE, bool), np.zeros(SHAPE, np.uint8)
    occluded[2, 5], material[:, 6:] = True, 3
    sample = make_sample(occluded=occluded, material=material)
    # Shift: 1.04 px at 5 m (columns 0, 1), 2.6 px at 2 m: columns 0 and 2 leave.
    assert out_of_view(sample)[0].tolist() == [True, False, True] + [False] * 5
    masks = regions(sample)
    assert masks["occluded"].sum() == 1 and masks["visible"].sum() == 48 - 12 - 1
    assert masks["material_3"].sum() == 12
    records = []
    for each, factor in ((sample, 2.0), (make_sample("b"), 3.0)):
        head = {"dataset": each.dataset, "sample": each.name, "method": "guided", "status": "ok"}
        prediction = Prediction(factor * each.depth_m, uncertainty=np.ones(SHAPE))
        records.append(head | score(each, prediction, None))
    by_region, *_, areas = details_tables(records)
    one, two = "(1 pair)", "(2 pairs)"
    header = ["method", f"visible {one}", f"occluded {one}", f"out of view {two}", "matched", "unmatched"]
    header += [f"{name} {one}" for name in ("ToM", "other material", "class 0", "class 3")]
    assert list(by_region.header) == header
    assert by_region.rows == (("guided", "1.000", "1.000", "1.500", "-", "-", *["1.000"] * 4),)
    assert areas.rows == (("guided", "0.000", "-", "-"),)
    bare = [records[1] | {"disparity": None, "ause": None, "regions": {}, "boundaries": None}]
    assert all(table.rows == () for table in details_tables(bare))


def test_regions_split_by_whether_the_views_match_which_is_found_once_a_sample(monkeypatch):
    swept, valid = [], np.ones((64, 128), bool)
    valid[:8] = False
    monkeypatch.setattr(scoring, "sweep", lambda sample, device: swept.append(1) or sweep(sample, device))
    sample = textured_sample(valid=valid)
    for factor in (1, 2):
        score(experiment.cropped(sample, "none"), Prediction(factor * sample.depth_m), None)
    masks = regions(sample)
    assert len(swept) == 1
    np.testing.assert_array_equal(masks["matched"] ^ masks["unmatched"], valid)
    assert masks["matched"][8:, 10:55].mean() > 0.8 and masks["matched"][8:, 90:].mean() < 0.1
    away = np.diag([-1.0, 1, -1, 1])
    away[0, 3] = 0.12
    assert set(regions(textured_sample(E=away))) == {"out_of_view"}  # no overlap
