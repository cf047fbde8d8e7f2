"""A capture as a whole: its stages, its report, and what fails."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs import capture as module
from geodiff_plugin.jobs import capture_frame
from geodiff_plugin.jobs.capture import depth_capture
from geodiff_plugin.jobs.journal import BROKEN
from geodiff_plugin.jobs.lengths import KnownScale
from tests.unit.jobs import made_runs
from tests.unit.jobs.made_captures import MOVED, NAMES, options, solved


def test_the_report_of_the_poses_states_how_far_each_camera_moved(capture):
    capture.solved = solved()
    reported = module._pose_report(capture)
    assert reported["status"] == "solved"
    assert reported["residual_px_given"] == 3.1416 and reported["residual_px"] == 0.2718
    assert reported["scale_by_positions"] == pytest.approx(1.12345, abs=6e-5)
    assert reported["scale_by_depth"] == pytest.approx(0.98765, abs=6e-5)
    assert reported["scale_rel_std"] == 0.0432
    for n, name in enumerate(NAMES):
        frame = reported["frames"][name]
        assert frame["connected"] is (n != 1)
        assert frame["translation"] == pytest.approx(0.05 * n, abs=1e-5)
        assert frame["rotation_deg"] == pytest.approx(n, abs=1e-3)
    unknown = MOVED.copy()
    unknown[1] = np.nan
    capture.solved = solved(E=np.where(np.isnan(unknown), np.eye(4), unknown), scale_rel_std=math.nan)
    assert module._pose_report(capture)["scale_rel_std"] is None


def test_failed_and_doubted_frames_are_named():
    frames = [
        {"key": "f0", "frame": "f0", "verdict": {"status": "trusted"}},
        {"key": "f1", "frame": "f1", "status": BROKEN, "error": "torn"},
        {"key": "f2", "frame": "f2", "verdict": {"status": "not trusted"}},
        {"key": "f3", "frame": "f3", "verdict": {"status": "not judged"}},
    ]
    outcome = module._outcome(frames)
    assert outcome == {"failed": ["f1"], "not_trusted": ["f2", "f3"], "frames": frames}


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_every_frame_has_a_folder_with_its_maps_and_report(run):
    reported = []
    given = options(run.folder, processes=1, neighbours=4, export=("mesh",))
    report = depth_capture(given, notify=reported.append)
    assert [name for name, _ in run.depths] == NAMES and {points for _, points in run.depths} == {"tracks"}
    depth_m = made_runs.depth_map()
    low, middle, high = np.percentile(depth_m[depth_m > 0], (2, 50, 98))
    for n, name in enumerate(NAMES):
        folder = run.folder / "out" / name
        np.testing.assert_array_equal(np.load(folder / "depth_alone.npy"), depth_m)
        confidence = np.load(folder / "confidence_alone.npy")
        np.testing.assert_array_equal(confidence, made_runs.output().confidence[0, ..., 0])
        frame = json.loads((folder / "report.json").read_text())
        assert frame["frame"] == name and frame["neighbours"] == [f"{name}'s 4"] and frame["unit"] is None
        np.testing.assert_allclose(frame["K"], made_runs.K_LEFT)
        np.testing.assert_allclose(frame["T_world_from_camera"], MOVED[n])
        assert frame["connected"] is (n != 1) and frame["scale_rel_std"] == 0.0432
        assert frame["depth"] == pytest.approx({"p02": low, "median": middle, "p98": high})
        assert frame["poses"] == ["refined"]
        assert frame["verdict"]["status"] == "not trusted" and frame["made_from"] == report["made_from"]
        assert {each["text"] for each in frame["findings"]} >= {made_runs.REASON, made_runs.OF_CALL}
        assert frame["files"]["n"] == 1 and frame["seconds"] >= 0
        names = {path.name for path in folder.iterdir()}
        assert set(frame["files"]["names"]) == names
        shown = report["frames"][n]
        assert {key: shown[key] for key in frame} == frame and shown["key"] == name
    assert json.loads((run.folder / "out/capture.json").read_text()) == report
    assert run.agreed == [NAMES] and run.results == (NAMES, ("mesh",), NAMES, None)
    assert report["agreement"] == {"share": 1} and report["files"] == {"cloud.ply": 3}
    assert report["not_trusted"] == NAMES and report["failed"] == [] and report["measured"] == []
    assert (report["kind"], report["unit"], report["path"]) == ("test", None, str(run.folder))
    assert list(report["seconds"]) == ["poses", "frames", "agreement and cloud"]
    assert all(0 <= seconds < 60 for seconds in report["seconds"].values())
    assert reported[:1] == ["One part."]
    assert [message["code"] for message in report["findings"]] == [
        "capture.part",
        "capture.scale",
        "capture.kept",
    ]
    assert (
        "median distance of matches from epipolar lines 0.27 px" in reported[1]
        and reported[2] == "The poses are kept."
    )

    assert len(run.pipes) == 1 and depth_capture(given)["frames"] == report["frames"]
    assert len(run.depths) == 3 and len(run.pipes) == 1, "all frames were there"
    (run.folder / "out/f1/depth_alone.npy").unlink()
    depth_capture(given)
    assert [name for name, _ in run.depths[3:]] == ["f1"]
    depth_capture(replace(given, overwrite=True))
    assert [name for name, _ in run.depths[4:]] == NAMES


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_holes_are_in_the_report_and_files_of_a_frame_but_not_in_the_maps_to_be_compared(run):
    given = options(run.folder, processes=1, frames="f1", min_confidence=0.6, max_sigma=0.9)
    output = made_runs.output(unit=None)
    assert depth_capture(given)["frames"][0]["depth"]["median"] == pytest.approx(
        np.median(made_runs.depth_map()[made_runs.depth_map() > 0])
    )
    assert run.holes == [None] and run.thresholds == (0.6, 0.9) and run.maps[3:] == (0.6, 0.9)
    np.testing.assert_array_equal(run.maps[1].prediction, output.prediction)
    with pytest.raises(InputError, match="made with --holes False instead of True"):
        depth_capture(replace(given, holes=True))
    report = depth_capture(replace(given, holes=True, overwrite=True))
    kept = output.reliable(0.6, 0.9)
    assert 0.1 < kept.mean() < 0.9 and run.holes[1:] == [(0.6, 0.9), "f1"] and run.thresholds == (0.6, 0.9)
    assert report["frames"][0]["agreed"] == "f1"
    np.testing.assert_array_equal(run.maps[1].prediction, output.prediction * kept)
    low, middle, high = np.percentile(output.prediction[kept], (2, 50, 98))
    assert report["frames"][0]["depth"] == pytest.approx({"p02": low, "median": middle, "p98": high})
    alone = np.load(run.folder / "out/f1/depth_alone.npy")
    np.testing.assert_array_equal(alone, made_runs.depth_map())
    with pytest.raises(InputError, match=r"made with --max-sigma 0\.9 instead of 0\.2"):
        depth_capture(replace(given, holes=True, max_sigma=0.2))


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_a_failed_frame_is_left_out_and_the_frames_that_are_chosen_are_made(run):
    run.fails = {"f1"}
    report = depth_capture(options(run.folder, processes=1, frames="f1,f2"))
    assert report["failed"] == ["f1"] and run.agreed == [["f2"]]
    assert report["frames"][0]["error"] == "f1 is torn" and report["frames"][0]["frame"] == "f1"
    run.fails = {"f0", "f2"}
    with pytest.raises(InputError, match=r"All frames failed: f0 is torn|f0 is torn All"):
        depth_capture(options(run.folder, processes=1, frames="f0", out=run.folder / "other"))


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_what_does_not_fit_the_memory_is_named_with_its_size(run, monkeypatch):
    def full(*_, **__):
        raise MemoryError

    monkeypatch.setattr(capture_frame, "depth_of_frame", full)
    with pytest.raises(InputError, match=r"A frame of 52x36 pixels .*, or pass a lower --processes\."):
        depth_capture(options(run.folder, processes=1, frames="f2"))
    monkeypatch.setattr(module, "solved_poses", full)
    with pytest.raises(InputError, match=r"A capture of 51x36 pixels .*, or pass a lower --processes\."):
        depth_capture(options(run.folder, processes=1, frames="f0,f1", out=run.folder / "other"))


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_poses_alone_are_for_shards_which_make_their_part(run):
    report = depth_capture(options(run.folder, poses_only=True))
    assert report["poses"]["status"] == "solved" and report["frames"] == [] and run.depths == []
    assert report["unit"] is None and not (run.folder / "out/capture.json").exists()
    shard = depth_capture(options(run.folder, shard="1/2"))
    assert [frame["frame"] for frame in shard["frames"]] == ["f1"] and set(shard) == {
        *("unit", "failed", "not_trusted", "frames")
    }
    assert run.agreed == []
    whole = depth_capture(options(run.folder, processes=1))
    assert [name for name, _ in run.depths] == ["f1", "f0", "f2"] and len(whole["frames"]) == 3


@pytest.mark.parametrize("spread", [math.nan, -1.0, 0.03])
def test_lengths_are_measured_with_the_spread_of_the_scale(capture, tmp_path, monkeypatch, spread):
    asked = []
    capture.solved = solved(scale_rel_std=spread)
    monkeypatch.setattr(module, "spans_to_measure", lambda *_: [SimpleNamespace(frame=n) for n in NAMES])
    monkeypatch.setattr(module, "measure", lambda *given: asked.append(given) or "measured")
    outcome = {"failed": ["f1"], "not_trusted": ["f2"]}
    given = options(tmp_path)
    assert module._measured(capture, given, outcome, None) == "measured"
    found, spans, out, doubted, used = asked[0]
    assert found is capture and [span.frame for span in spans] == ["f0", "f2"]
    assert (out, doubted, used) == (given.out, ["f2"], max(0.0, 0.0 if math.isnan(spread) else spread))
    module._measured(capture, given, outcome, KnownScale(2.0, 0.07))
    assert asked[1][-1] == 0.07
