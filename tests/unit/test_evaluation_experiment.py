"""Records of predictions (raw, aligned, capped, by region), cells of an experiment and its tables."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin.evaluation import experiment
from geodiff_plugin.evaluation.baselines import Method, NotApplicable, Prediction, Settings, find_method
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import with_perturbed_poses
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, out_of_view, regions, score
from geodiff_plugin.evaluation.tables import (
    DETAILS,
    details_table,
    headline,
    mean_with_interval,
    pairs_tables,
)
from tests.evaluating import write_scenes

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
    monkeypatch.setattr(experiment, "sweep", lambda sample, _: swept.append(sample.E) or sweep(sample, "cpu"))
    wrong, double = with_perturbed_poses(sample, (20.0, 0.5), "a"), Prediction(2 * sample.depth_m)
    assert not np.allclose(wrong.E, sample.E)
    np.testing.assert_array_equal(out_of_view(wrong), out_of_view(sample))
    assert score(wrong, double, None)["disparity"] == score(sample, double, None)["disparity"]
    np.testing.assert_array_equal(swept[0], sample.E)


def test_regions_split_what_the_right_camera_sees_and_tables_show_them():
    occluded, material = np.zeros(SHAPE, bool), np.zeros(SHAPE, np.uint8)
    occluded[2, 5], material[:, 6:] = True, 3
    sample = make_sample(occluded=occluded, material=material)
    # Shift: 1.04 px at 5 m (columns 0, 1), 2.6 px at 2 m: columns 0 and 2 leave.
    assert out_of_view(sample)[0].tolist() == [True, False, True] + [False] * 5
    sizes = {name: mask.sum() for name, mask in regions(sample).items()}
    assert (sizes["occluded"], sizes["visible"], sizes["material_3"]) == (1, 48 - 12 - 1, 12)
    records = []
    for each, factor in ((sample, 2.0), (make_sample("b"), 3.0)):
        head = {"dataset": each.dataset, "sample": each.name, "method": "guided", "status": "ok"}
        prediction = Prediction(factor * each.depth_m, uncertainty=np.ones(SHAPE))
        records.append(head | score(each, prediction, None))
    by_region, *_, areas = (details_table(records, title) for title in DETAILS)
    names = ("visible", "occluded", "ToM", "other material", "class 0", "class 3")
    header = [f"{name} (1 pair)" for name in names]
    header[2:2] = ["out of view (2 pairs)", "matched", "unmatched"]
    assert by_region.header == ("method", *header)
    assert by_region.rows == (("guided", "1.000", "1.000", "1.500", "-", "-", *["1.000"] * 4),)
    assert areas.rows == (("guided", "0.000", "-", "-"),)


def test_regions_split_by_whether_the_views_match_which_is_found_once_a_sample(monkeypatch, tmp_path):
    swept, whole = [], load(find_pairs(write_scenes(tmp_path, "wall"))[0])
    left, right, valid = whole.left.copy(), whole.right.copy(), whole.valid.copy()
    left[:, 80:], right[:, 72:], valid[:8] = 128, 128, False  # nothing to match on the right
    sample = replace(whole, left=left, right=right, valid=valid)
    monkeypatch.setattr(experiment, "sweep", lambda sample, device: swept.append(1) or sweep(sample, device))
    for factor in (1, 2):
        score(sample, Prediction(factor * sample.depth_m), None)
    masks = regions(sample)
    assert len(swept) == 1
    np.testing.assert_array_equal(masks["matched"] ^ masks["unmatched"], valid)
    assert masks["matched"][8:, 12:65].mean() > 0.8 and masks["matched"][8:, 100:].mean() < 0.1
    away = np.diag([-1.0, 1, -1, 1])
    away[0, 3] = 0.12
    assert set(regions(replace(sample, E=away))) == {"out_of_view"}  # no overlap


SIZES = {"a": 0.1, "b": 0.2, "c": 0.4}
REFS = [SampleRef("middlebury2014", name, {"left": Path(name)}) for name in SIZES]


class Bench:
    """Three samples, the last one posed, and methods that cost nothing, in the place of all others."""

    def __init__(self, monkeypatch, out):
        self.calls, self.methods, self.out, self.path = [], {}, out, out / RECORDS_NAME
        self.samples = {name: make_sample(name, rectified=name != "c") for name in SIZES}
        self.add("exact", lambda sample, seed: 1.0)
        self.add("double", lambda sample, seed: 2.0 if sample.rectified else None)
        self.add("noisy", lambda sample, seed: 1 + SIZES[sample.name] * seed, uses_prior=True)
        monkeypatch.setattr("geodiff_plugin.evaluation.baselines.METHODS", self.methods)
        monkeypatch.setattr(experiment, "load", lambda ref: self.samples[ref.name])
        monkeypatch.setattr(experiment.PriorCache, "fingerprint", lambda _, settings: settings.prior[::-1])

    def add(self, name, factor_of, knobs=None, uses_prior=False):
        def measure(sample, settings, priors):
            self.calls.append((name, sample.name))
            if (factor := factor_of(sample, settings.seed)) is None:
                raise NotApplicable("not rectified")
            return Prediction(factor * sample.depth_m.astype(float))

        def configure(settings):
            return knobs or ({"seed": settings.seed} if uses_prior else {})

        self.methods[name] = Method(name, name, name, measure, configure, uses_prior)

    def go(self, methods=("exact", "double"), settings=None, refs=REFS, **keywords):
        self.calls.clear()
        cells = experiment.method_cells(refs, list(methods), settings or Settings(), self.out, **keywords)
        return experiment.measure_cells(cells, SimpleNamespace(out=self.out, quiet=True))


@pytest.fixture
def bench(monkeypatch, tmp_path):
    return Bench(monkeypatch, tmp_path)


def test_a_run_does_only_what_is_missing(bench, monkeypatch):
    first = bench.go()
    assert len(bench.calls) == 6 and [r["status"] for r in first].count("not applicable") == 1
    os.truncate(bench.path, bench.path.stat().st_size - 2)  # killed while it wrote
    again = bench.go()
    assert len(bench.calls) == 1
    assert [r | {"seconds": 0} for r in again] == [r | {"seconds": 0} for r in first]
    bench.add("double", lambda *_: 3.0, {"factor": 3})  # another configuration is another result
    records = bench.go()
    assert [call[0] for call in bench.calls] == ["double"] * 3 and headline(records[1]) == pytest.approx(2)
    monkeypatch.setattr(experiment, "__version__", "0.2.0")
    assert bench.go() and len(bench.calls) == 6


def test_a_saved_map_is_that_of_the_record(bench):
    """Another configuration leaves its map in the same place; a finished run saves its maps when asked."""
    bench.go()
    one, target, maps = bench.methods["exact"], bench.out / "depth" / "exact" / "middlebury2014_a.npy", []
    bench.add("exact", lambda *_: 3.0, {"knob": 1})
    for method in (one, bench.methods["exact"], one):
        bench.methods["exact"] = method
        bench.go(save_depth=True)
        maps.append(np.load(target)[0, 0])
    assert maps == [5.0, 15.0, 5.0] and ("exact", "a") in bench.calls
    bench.go(save_depth=True)
    assert bench.calls == [] and len(list(bench.out.glob("depth/*/*.npy"))) == 5


def test_tables_hold_pairs_means_and_differences(bench):
    pairs, _, versus, metrics, *_ = pairs_tables(bench.go(), reference="exact")
    assert pairs.header == ("pair", "exact", "double")
    assert pairs.rows == (
        ("middlebury2014/a", "0.000", "1.000"),
        ("middlebury2014/b", "0.000", "1.000"),
        ("middlebury2014/c", "0.000", "-"),
        ("mean of 3 pairs", "0.000", "-"),
        ("mean of 2 rectified pairs", "0.000", "1.000"),
        ("mean of 1 posed pair", "0.000", "-"),
    )
    assert versus.rows == (("double", "2", "-1.000", "2 of 2"),)
    assert [row[0] for row in metrics.rows] == ["exact", "exact, aligned", "double", "double, aligned"]


def test_priors_and_seeds_make_rows_whose_results_are_those_of_the_settings(bench):
    bound = {"noisy#1": ("bundled", 1), "noisy@org/x": ("org/x", 0), "noisy@org/x#1": ("org/x", 1)}
    records = bench.go(("noisy", "exact", *bound))
    assert [r["method"] for r in records[:5]] == ["noisy", "exact", *bound] and len(bench.calls) == 15
    for method, (prior, seed) in bound.items():
        again = bench.go(["noisy"], Settings(prior, seed=seed))
        assert bench.calls == [] and {r["method"] for r in again} == {"noisy"}
        assert [r["key"] for r in again] == [r["key"] for r in records if r["method"] == method]
    header = ("pair", "noisy", "exact", "noisy, seed 1", "noisy (x)", "noisy (x), seed 1")
    assert pairs_tables(records, reference="exact")[0].header == header


def test_names_that_are_no_method_are_refused(bench, tmp_path):
    for said, names in (
        ("METHOD#SEED with a method that uses a prior", ("exact#1", "noisy#1#2")),
        ("METHOD@PRIOR with a method that uses a prior", ("noisy#1@org/x", "double@org/x")),
        ("methods must be one of", ("noisy#", "magic:1")),
        ("a knob of GeometryGuidance", ("paper:", "guided:speed=2", "guided:rule")),
    ):
        for name in names:
            with pytest.raises(ValueError, match=said):
                find_method(name)
    (tmp_path / "maps@work#3").mkdir()  # an @ or # of a folder binds nothing
    assert find_method(f"files:{tmp_path}/maps@work#3").title == "maps@work#3"


def test_intervals_cover_the_mean_and_need_five():
    assert mean_with_interval([1, 2, 3, 4, None]).low is None
    mean = mean_with_interval([1, 2, 3, 4, 5])
    assert mean.low < mean.value == 3 < mean.high and mean == mean_with_interval([1, 2, 3, 4, 5])
    assert mean.cell(1, "+") == f"+3.0 [{mean.low:+.1f}, {mean.high:+.1f}]"
    assert mean_with_interval([]).cell() == "-" and mean_with_interval([-0.5, 0.5]).cell(2) == "0.00"
    values = np.random.default_rng(3).normal(size=400)
    wide = mean_with_interval(values)
    assert wide.high - wide.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)  # normal theory
