"""The report of a pair: every value that it states is worked out again from the run."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.evidence.unposed import EstimatedRig
from geodiff_plugin.formats.out import read_report
from geodiff_plugin.jobs.report import (
    build_report,
    depth_range_words,
    depth_summary,
    measurable_limit,
    measured_depth,
    plain,
    report_text,
    summary_line,
    used_poses,
)
from geodiff_plugin.pose.estimate import Scale
from geodiff_plugin.trust import FactSheet, KnownPoints, Verdict
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.types import PoseReport
from tests.unit.jobs import made_runs


@pytest.fixture(scope="module")
def run():
    return made_runs.run(seed=41)


@pytest.fixture(scope="module")
def report(run):
    return build_report(run)


def one_map(values) -> np.ndarray:
    return np.asarray(values)[0, :, :, 0]


def test_depth_is_summed_up_over_pixels_with_a_depth_alone(run, report):
    depth_m, confidence = one_map(run.output.prediction), one_map(run.output.confidence)
    kept = np.sort(depth_m[(depth_m > 0) & (confidence > 0)].astype(float))
    middle = kept[[(len(kept) - 1) // 2, len(kept) // 2]].mean()
    reported = report["depth"]
    assert reported["min_m"] == pytest.approx(kept[0]) and reported["max_m"] == pytest.approx(kept[-1])
    assert reported["median_m"] == pytest.approx(middle) and reported["mean_m"] == pytest.approx(
        kept.sum() / len(kept)
    )
    assert (reported["width"], reported["height"]) == made_runs.SIZES[0]
    assert reported["invalid_pixels"] == depth_m.size - len(kept) == 2 * 50 + 11
    assert reported["visible_fraction"] == pytest.approx(one_map(run.output.visible).mean())


def test_a_map_without_depth_or_without_a_second_view_is_summed_up_too():
    nothing = depth_summary(np.array([[0.0, math.nan, math.inf], [-1.0, 0.0, 0.0]]), None)
    assert math.isnan(nothing["median_m"]) and nothing["invalid_pixels"] == 6
    assert nothing["visible_fraction"] == 0.0 and (nothing["width"], nothing["height"]) == (3, 2)
    some = depth_summary(np.array([[0.0, 4.0, math.inf]]), np.array([[True, True, False]]))
    assert (some["min_m"], some["max_m"], some["invalid_pixels"]) == (4.0, 4.0, 2)
    assert some["visible_fraction"] == pytest.approx(2 / 3)


def test_depth_that_cannot_be_measured_is_no_maximum():
    """Two measured pixels, one beyond the range with a depth, one beyond it without, and a masked one."""
    depth_m, valid = np.array([[3.0, 60.0, 400.0, 593.0, 0.0]]), np.array([[True, True, True, False, False]])
    found = depth_summary(depth_m, None, valid, 71.2)
    assert (found["max_m"], found["beyond_m"], found["beyond_fraction"]) == (60.0, 71.2, 0.4)
    assert (found["min_m"], found["median_m"], found["invalid_pixels"]) == (3.0, 60.0, 2)
    assert depth_range_words(found, "m") == "3.00 m to beyond 71 m"
    assert depth_range_words(found, None) == "3.00 to beyond 71"
    near = depth_summary(depth_m[:, :2], None, valid[:, :2], 156.0)
    assert (near["max_m"], near["beyond_m"], near["beyond_fraction"]) == (60.0, None, 0.0)
    assert depth_range_words(near, "m") == "3.00 m to 60.00 m"
    far = depth_summary(depth_m[:, 2:], None, valid[:, 2:], 156.0)
    assert depth_range_words(far, "m") == depth_range_words(plain(far), "m") == "beyond 160 m"


def test_measured_depth_is_0_where_it_is_invalid_or_too_far():
    depth_m = np.array([[3.0, 60.0, 400.0, 593.0, 7.0, np.nan]], np.float32)
    valid = np.array([[True, True, True, False, False, False]])
    for limit, expected in ((71.2, [3, 60, 0, 0, 0, 0]), (None, [3, 60, 400, 0, 0, 0])):
        measurable = None if limit is None else np.array([limit])
        output = SimpleNamespace(
            prediction=depth_m[None, ..., None], valid=valid[None, ..., None], measurable_m=measurable
        )
        found = measured_depth(output)
        assert found.dtype == np.float32 and measurable_limit(output) == limit
        np.testing.assert_array_equal(found, [expected])


def test_errors_are_those_of_pixels_that_a_right_view_sees(run, report):
    output = run.output
    seen = one_map(output.visible)
    assert report["photometric_error_mean"] == pytest.approx(one_map(output.photometric_error)[seen].mean())
    assert report["uncertainty_median_m"] == pytest.approx(np.median(one_map(output.uncertainty)))
    nothing = replace(run, output=made_runs.output(visible=np.zeros((1, 36, 50, 1), bool)))
    assert build_report(nothing)["photometric_error_mean"] is None
    alone = made_runs.output(visible=None, photometric_error=None, uncertainty=None, poses=[])
    reported = build_report(replace(run, output=alone))
    assert reported["photometric_error_mean"] is reported["uncertainty_median_m"] is reported["pose"] is None
    assert reported["depth"]["visible_fraction"] == 0.0


def test_the_expected_error_is_the_median_sigma_of_known_depths(run, report):
    sigma_m = one_map(run.output.sigma)
    assert np.isnan(sigma_m).any()
    assert report["sigma_median_m"] == pytest.approx(np.median(sigma_m[np.isfinite(sigma_m)]))
    for changes in ({"confidence": None}, {"confidence": 0 * run.output.confidence}):
        unknown = replace(run, output=replace(run.output, **changes))
        assert build_report(unknown)["sigma_median_m"] is None


def test_the_farthest_measurable_depth_is_in_it(run, report):
    assert report["measurable_m"] is None
    output = replace(run.output, measurable_m=torch.tensor([71.5]))
    assert build_report(replace(run, output=output))["measurable_m"] == 71.5


def test_what_the_call_gave_stands_under_its_own_name(run, report):
    output = run.output
    for name in ("scale", "shift", "global_scale", "prior_scale", "prior_error", "K"):
        np.testing.assert_allclose(report[name], np.asarray(getattr(output, name)), err_msg=name)
    assert report["unit"] == "m"
    assert report["prior"] == run.prior and report["undistorted"] is False
    assert report["arguments"] == run.options.as_json() and report["arguments"]["seed"] == 41
    assert report["guidance"]["planes"] == 77 and report["guidance"]["guidance_steps"] == 0
    assert report["guidance"]["lr_latents"] == 0.03, "automatic choices are resolved"
    assert report["versions"]["torch"] == torch.__version__
    for reported, step in zip(report["history"], output.history, strict=True):
        assert reported["step"] == step.step and reported["timestep"] == step.timestep
        for name in ("s_hat", "t_hat", "g_s", "loss", "visible_fraction"):
            assert reported[name] == pytest.approx(getattr(step, name).tolist()), name
        assert reported["terms"] == {
            name: pytest.approx(value.tolist()) for name, value in step.terms.items()
        }


def test_the_verdict_and_all_findings_are_in_it_once(run, report):
    verdict = report["verdict"]
    assert verdict["status"] == "not trusted" and verdict["reasons"] == [made_runs.REASON]
    assert verdict["remarks"] == [made_runs.REMARK]
    assert verdict["facts"] == plain(run.output.verdict.facts.as_record())
    assert verdict["facts"]["matched_fraction"]["matched"] == 0.43
    found = [(each["code"], each["severity"], each["text"]) for each in report["findings"]]
    given = (made_runs.REASON, made_runs.REMARK, made_runs.OF_CALL, made_runs.ASSUMED, made_runs.WARNED)
    assert found == [(each.code, each.severity.value, str(each)) for each in given]


def test_the_pose_report_and_the_cameras_are_in_it(run, report):
    pose = report["pose"]
    assert pose["status"] == "refined" and pose["matches"] == [311.0, 287.0] and pose["depth_spread"] == 0.02
    assert (pose["residual_px_given"], pose["residual_px"]) == ([2.9, 3.1], [0.8, 0.9])
    np.testing.assert_allclose(pose["E_given"], made_runs.POSES)
    np.testing.assert_allclose(pose["E"], made_runs.REFINED)
    inputs = report["inputs"]
    assert (inputs["left_size"], inputs["right_size"]) == ([50, 36], [54, 40])
    assert inputs["calibration"] == "calib.txt"
    np.testing.assert_allclose(inputs["K_left"], made_runs.K_LEFT)
    np.testing.assert_allclose(inputs["K_right"], made_runs.K_RIGHTS[0])
    np.testing.assert_allclose(inputs["E"], made_runs.POSES[0])
    assert inputs["baseline_m"] == pytest.approx(math.dist((0, 0, 0), (0.31, 0.04, -0.06)))
    (view,) = inputs["further_views"]
    np.testing.assert_allclose(view["K"], made_runs.K_RIGHTS[1])
    np.testing.assert_allclose(view["E"], made_runs.POSES[1])


def test_poses_are_reported_in_the_unit_of_the_output():
    """A prior that knows metres makes all lengths 3.5 times as long; rotations stay."""
    run = made_runs.run(made_runs.output(rescaled=3.5, poses=[]))
    reported, longer = build_report(run)["inputs"], [np.array(E) for E in made_runs.POSES]
    for E in longer:
        E[:3, 3] *= 3.5
    np.testing.assert_allclose(reported["E"], longer[0])
    np.testing.assert_allclose(reported["further_views"][0]["E"], longer[1])
    assert reported["baseline_m"] == pytest.approx(np.linalg.norm(longer[0][:3, 3]))
    np.testing.assert_allclose(used_poses(run.output, run.inputs.guidance), longer)
    fits = made_runs.output(rescaled=3.5, poses=[PoseReport("fits", made_runs.POSES, made_runs.POSES)])
    np.testing.assert_allclose(used_poses(fits, run.inputs.guidance), longer)
    refined = used_poses(made_runs.output(rescaled=3.5), run.inputs.guidance)
    np.testing.assert_allclose(refined, made_runs.REFINED)


def test_an_estimated_pose_is_reported_with_the_source_of_its_scale():
    run = made_runs.run(made_runs.output(scale_from="known length", scale_rel_std=0.023))
    assert build_report(run)["estimated_pose"] is None
    measures = {
        "inliers": [83, 71],
        "parallax_deg": [4.5, 6.5],
        "residual_px": [0.6, 0.7],
        "depth_spread": 0.04,
    }
    Ks, unit = (made_runs.K_LEFT, *made_runs.K_RIGHTS), Scale("known length", 1.5)
    run.inputs.guidance.estimated = EstimatedRig(
        made_runs.SIZES[0], Ks, made_runs.POSES, *measures.values(), unit, (made_runs.ASSUMED,)
    )
    reported = build_report(run)["estimated_pose"]
    assert reported == measures | {"scale_from": "known length", "scale_rel_std": 0.023}


def test_a_report_is_json_and_is_read_back(report, tmp_path):
    assert json.loads(report_text(report)) == report
    assert read_report(tmp_path) == {}
    for text, read in ((report_text(report), report), ("[1]", {}), ("{", {}), ("[" * 100_000, {})):
        (tmp_path / "report.json").write_text(text)
        assert read_report(tmp_path) == read
    with pytest.raises(ValueError, match="nan"):
        report_text({"value": math.nan})


def test_numbers_that_json_has_no_name_for_become_none():
    value = {1: (np.float32(0.5), math.inf), "t": torch.tensor([[1.0, math.nan]]), "n": np.array([2, 3])}
    assert plain(value) == {"1": [0.5, None], "t": [[1.0, None]], "n": [2, 3]}
    assert plain(True) is True and plain(0.0) == 0.0 and plain(-math.inf) is None and plain("a") == "a"


def line_of(report: dict, seconds=(1.25, 2.5), **changes) -> str:
    return summary_line(report | {"seconds": dict(enumerate(seconds))} | changes, "out/")


def test_the_line_for_people_has_near_far_median_and_what_they_rest_on(report):
    depth = {"min_m": 0.0312, "max_m": 12.3456, "median_m": 3.456}
    trusted = report | {"depth": depth, "sigma_median_m": 0.0123}
    facts = {"matched_fraction": {"confidence": 0.61, "matched": 0.436}, "known_points": {"count": 123}}
    trusted["verdict"] = {"status": "trusted", "reasons": [], "facts": facts}
    line = line_of(trusted)
    assert line.startswith("0.031 m to 12.35 m, median 3.46 m; ") and line.endswith("; 3.8 s -> out/")
    for part in ("confidence 0.61", "median sigma 0.012 m", "44 % matched", "123 known depths"):
        assert part in line
    assert "prior's metric scale x 2.50" in line
    bare = {"matched_fraction": {"confidence": None, "matched": None}}
    changes = {"sigma_median_m": None, "prior_scale": None, "findings": []}
    line = line_of(trusted, verdict=trusted["verdict"] | {"facts": bare}, **changes)
    for part in ("confidence", "expected", "matched", "known", "own metres"):
        assert part not in line
    assumed = changes | {"findings": [made_runs.ASSUMED.as_record()]}
    assert line != line_of(trusted, verdict=trusted["verdict"] | {"facts": bare}, **assumed)


def test_the_line_leads_with_the_verdict_where_it_is_not_trusted(report):
    line = line_of(report)
    assert line.startswith(f"NOT TRUSTED: {made_runs.REASON} (Unreliable: 1.25 m to ")
    unjudged = {"status": "not judged", "reasons": [], "facts": report["verdict"]["facts"]}
    assert line_of(report, verdict=unjudged).startswith("NOT JUDGED: there are no matches")
    none = {"min_m": None, "max_m": None, "median_m": None}
    assert line_of(report, depth=none) == "no valid depth; 3.8 s -> out/"


@pytest.mark.parametrize(
    ("estimated", "words"), [(None, "the calibration's lengths"), ({"a": 1}, "baselines")]
)
def test_lengths_without_a_unit_are_reported_without_one(report, estimated, words):
    line = line_of(report, unit=None, estimated_pose=estimated)
    assert f"in {words} (no unit)" in line and " m," not in line and "1.25 to " in line


def test_the_verdict_of_a_report_is_that_of_the_worst_image():
    trusted, unjudged = (
        Verdict(status, (), FactSheet({KnownPoints: Points(count, 0, 0.5, None, None)}))
        for status, count in (("trusted", 1), ("not judged", 2))
    )
    both = made_runs.output(verdicts=[trusted, unjudged])
    assert build_report(made_runs.run(both))["verdict"]["facts"]["known_points"]["count"] == 2
