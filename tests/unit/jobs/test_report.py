"""The report of a pair: every value that it states is worked out again from the run."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from geodiff_plugin.evidence.photographs import EstimatedRig
from geodiff_plugin.jobs.report import (
    build_report,
    depth_summary,
    plain,
    read_report,
    report_text,
    summary_line,
    used_poses,
)
from geodiff_plugin.pose.estimate import Scale
from geodiff_plugin.result.indicators import pixels_of_matches
from geodiff_plugin.result.misfit import MATCH_NOISE_PX
from geodiff_plugin.types import Indicators, PoseReport, Verdict
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
    told = report["depth"]
    assert told["min_m"] == pytest.approx(kept[0]) and told["max_m"] == pytest.approx(kept[-1])
    assert told["median_m"] == pytest.approx(middle) and told["mean_m"] == pytest.approx(
        kept.sum() / len(kept)
    )
    assert (told["width"], told["height"]) == made_runs.SIZES[0]
    assert told["invalid_pixels"] == depth_m.size - len(kept) == 2 * 50 + 11
    assert told["visible_fraction"] == pytest.approx(one_map(run.output.visible).mean())


def test_a_map_without_depth_or_without_a_second_view_is_summed_up_too():
    nothing = depth_summary(np.array([[0.0, math.nan, math.inf], [-1.0, 0.0, 0.0]]), None)
    assert math.isnan(nothing["median_m"]) and nothing["invalid_pixels"] == 6
    assert nothing["visible_fraction"] == 0.0 and (nothing["width"], nothing["height"]) == (3, 2)
    some = depth_summary(np.array([[0.0, 4.0, math.inf]]), np.array([[True, True, False]]))
    assert (some["min_m"], some["max_m"], some["invalid_pixels"]) == (4.0, 4.0, 2)
    assert some["visible_fraction"] == pytest.approx(2 / 3)


def test_errors_are_those_of_pixels_that_a_right_view_sees(run, report):
    output = run.output
    seen = one_map(output.visible)
    assert report["photometric_error_mean"] == pytest.approx(one_map(output.photometric_error)[seen].mean())
    assert report["uncertainty_median_m"] == pytest.approx(np.median(one_map(output.uncertainty)))
    nothing = replace(run, output=made_runs.output(visible=np.zeros((1, 36, 50, 1), bool)))
    assert build_report(nothing)["photometric_error_mean"] is None
    alone = made_runs.output(visible=None, photometric_error=None, uncertainty=None, poses=[])
    told = build_report(replace(run, output=alone))
    assert told["photometric_error_mean"] is told["uncertainty_median_m"] is told["pose"] is None
    assert told["depth"]["visible_fraction"] == 0.0


def test_the_expected_error_is_that_of_a_match_of_the_view_that_measures_best(run, report):
    """Moving a pixel's depth by its error moves it by one standard deviation in the best right view."""
    output, found = run.output, run.output.verdict.indicators
    depth_m = one_map(output.prediction)
    width, height = made_runs.SIZES[0]
    K, (v, u) = made_runs.K_LEFT, np.mgrid[:height, :width]
    across = found.epipolar_px * pixels_of_matches((height, width))
    # The root mean square of a shear that grows over the picture.
    noise_px = math.sqrt(MATCH_NOISE_PX**2 + across**2 + (found.shear * width) ** 2 / 3)
    errors = []
    for E in made_runs.REFINED:
        t = E[:3, 3]
        shift_x = K[0, 0] * t[0] - (u - K[0, 2]) * t[2]
        shift_y = K[1, 1] * t[1] - (v - K[1, 2]) * t[2]
        errors.append((depth_m - t[2]) ** 2 * noise_px / np.hypot(shift_x, shift_y))
    expected = np.hypot(np.minimum(*errors), found.scale_spread * depth_m)
    assert report["expected_error_median_m"] == pytest.approx(np.median(expected), rel=1e-6)


def test_what_the_call_gave_stands_under_its_own_name(run, report):
    output = run.output
    for name in ("scale", "shift", "global_scale", "prior_scale", "prior_error", "K"):
        np.testing.assert_allclose(report[name], np.asarray(getattr(output, name)), err_msg=name)
    assert report["unit"] == "m" and report["assumed"] == [made_runs.ASSUMED]
    assert report["prior"] == run.prior and report["undistorted"] is False
    assert report["arguments"] == run.options.as_json() and report["arguments"]["seed"] == 41
    assert report["guidance"]["planes"] == 77 and report["guidance"]["inner_steps"] == 0
    assert report["guidance"]["step_latents"] == 0.03, "automatic choices are resolved"
    assert report["versions"]["torch"] == torch.__version__
    for told, step in zip(report["history"], output.history, strict=True):
        assert told["step"] == step.step and told["timestep"] == step.timestep
        for name in ("s_hat", "t_hat", "g_s", "loss", "visible_fraction"):
            assert told[name] == pytest.approx(getattr(step, name).tolist()), name
        assert told["terms"] == {name: pytest.approx(value.tolist()) for name, value in step.terms.items()}


def test_the_verdict_and_all_messages_are_in_it_once(run, report):
    verdict = report["verdict"]
    assert verdict["status"] == "not trusted" and verdict["reasons"] == [made_runs.REASON]
    assert verdict["remarks"] == [made_runs.REMARK]
    for name, value in asdict(run.output.verdict.indicators).items():
        told = verdict["indicators"][name]
        assert told is None if isinstance(value, float) and math.isnan(value) else told == plain(value), name
        assert verdict["signs"]["order" if name == "rank_correlation" else name] == told
    assert report["warnings"] == [made_runs.WARNED]
    codes = [(message["code"], message["text"]) for message in report["messages"]]
    said = (made_runs.REASON, made_runs.REMARK, made_runs.OF_CALL, made_runs.ASSUMED, made_runs.WARNED)
    assert codes == [(message.code, str(message)) for message in (*said, made_runs.NOTED)]


def test_the_pose_report_and_the_cameras_are_in_it(run, report):
    pose = report["pose"]
    assert pose["status"] == "refined" and pose["matches"] == [311.0, 287.0] and pose["bars"] == 0.02
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


def test_poses_are_told_in_the_unit_of_the_output():
    """A prior that knows metres makes all lengths 3.5 times as long; rotations stay."""
    run = made_runs.run(made_runs.output(rescaled=3.5, poses=[]))
    told, longer = build_report(run)["inputs"], [np.array(E) for E in made_runs.POSES]
    for E in longer:
        E[:3, 3] *= 3.5
    np.testing.assert_allclose(told["E"], longer[0])
    np.testing.assert_allclose(told["further_views"][0]["E"], longer[1])
    assert told["baseline_m"] == pytest.approx(np.linalg.norm(longer[0][:3, 3]))
    np.testing.assert_allclose(used_poses(run.output, run.inputs.guidance), longer)
    fits = made_runs.output(rescaled=3.5, poses=[PoseReport("fits", made_runs.POSES, made_runs.POSES)])
    np.testing.assert_allclose(used_poses(fits, run.inputs.guidance), longer)
    refined = used_poses(made_runs.output(rescaled=3.5), run.inputs.guidance)
    np.testing.assert_allclose(refined, made_runs.REFINED)


def test_an_estimated_pose_is_told_with_the_source_of_its_scale():
    run = made_runs.run(made_runs.output(scale_from="known length", scale_spread=0.023))
    assert build_report(run)["estimated_pose"] is None
    measures = {
        "inliers": [83, 71],
        "parallax_deg": [4.5, 6.5],
        "residual_px": [0.6, 0.7],
        "depth_spread": 0.04,
    }
    Ks, unit = (made_runs.K_LEFT, *made_runs.K_RIGHTS), Scale("known length", 1.5)
    run.inputs.guidance.estimated = EstimatedRig(
        made_runs.SIZES[0], Ks, made_runs.POSES, *measures.values(), unit, (made_runs.NOTED,), ()
    )
    told = build_report(run)["estimated_pose"]
    expected = {"scale_from": "known length", "scale_spread": 0.023, "assumed": [made_runs.NOTED]}
    assert told == measures | expected


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
    trusted = report | {"depth": depth, "expected_error_median_m": 0.0123}
    found = report["verdict"]["indicators"] | {"confidence": 0.61, "matched": 0.436, "points": 123}
    trusted["verdict"] = {"status": "trusted", "reasons": [], "indicators": found}
    line = line_of(trusted)
    assert line.startswith("0.031 m to 12.35 m, median 3.46 m; ") and line.endswith("; 3.8 s -> out/")
    for part in ("confidence 0.61", "expected error 0.012 m", "44 % matched", "123 known depths"):
        assert part in line
    assert "prior's own metres x 2.50" in line
    bare = found | {"confidence": None, "matched": None, "points": 0}
    changes = {"expected_error_median_m": None, "prior_scale": None, "assumed": []}
    line = line_of(trusted, verdict=trusted["verdict"] | {"indicators": bare}, **changes)
    for part in ("confidence", "expected", "matched", "known", "own metres"):
        assert part not in line
    assert line != line_of(
        trusted, verdict=trusted["verdict"] | {"indicators": bare}, **changes | {"assumed": ["a"]}
    )


def test_the_line_leads_with_the_verdict_where_it_is_not_trusted(report):
    line = line_of(report)
    assert line.startswith(f"NOT TRUSTED: {made_runs.REASON} (Unconfirmed: 1.25 m to ")
    unjudged = {"status": "not judged", "reasons": [], "indicators": report["verdict"]["indicators"]}
    assert line_of(report, verdict=unjudged).startswith("NOT JUDGED: neither matches of two views")
    none = {"min_m": None, "max_m": None, "median_m": None}
    assert line_of(report, depth=none) == "no valid depth; 3.8 s -> out/"


@pytest.mark.parametrize(
    ("estimated", "words"), [(None, "the calibration's lengths"), ({"a": 1}, "baselines")]
)
def test_lengths_without_a_unit_are_said_to_have_none(report, estimated, words):
    line = line_of(report, unit=None, estimated_pose=estimated)
    assert f"in {words} (no unit)" in line and " m," not in line and "1.25 to " in line


def test_the_verdict_of_a_report_is_that_of_the_worst_image():
    trusted = Verdict("trusted", (), (), Indicators(points=1))
    unjudged = Verdict("not judged", (), (), Indicators(points=2))
    both = made_runs.output(verdicts=[trusted, unjudged])
    assert build_report(made_runs.run(both))["verdict"]["indicators"]["points"] == 2
