"""``geodiff live`` as a function: what it checks, reads, counts and writes."""

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geodiff_plugin import InputError
from geodiff_plugin.formats import locked_folder, read_depth_png
from geodiff_plugin.jobs import LiveMeter, LiveOptions, live
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.trust import FactSheet, MatchedFraction
from tests.cli.conftest import write_pair
from tests.unit.streaming.test_sources import write_video


@pytest.fixture
def files(tmp_path, textured_plane, monkeypatch) -> SimpleNamespace:
    """A side-by-side video and its calibration."""
    monkeypatch.chdir(tmp_path)
    files = write_pair(tmp_path, textured_plane)
    files.video = write_video(
        tmp_path / "rig.avi", [np.hstack([textured_plane.left, textured_plane.right])] * 3
    )
    return files


@pytest.fixture
def options(files, prior) -> LiveOptions:
    given = {"source": (str(files.video),), "side_by_side": "full", "calib": (files.calib,)}
    return LiveOptions(**given, prior=str(prior), steps=1, every_frame=True, device="cpu")


def results_of(options, **arguments):
    return list(live.live_results(options, **arguments))


def test_every_frame_of_a_video_and_its_folder(options, textured_plane, pipe):
    results = results_of(replace(options, out=Path("out")), pipe=pipe)
    assert [each.frame.number for each in results] == [0, 1, 2]
    assert [each.frame.checked for each in results] == [True, False, False]
    with open("out/frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == ["0", "1", "2"] and list(rows[0]) == list(live.COLUMNS)
    np.testing.assert_allclose(np.loadtxt("out/K.txt"), textured_plane.K)
    for number, result in enumerate(results):
        left = cv2.cvtColor(cv2.imread(f"out/left/{number:06d}.png"), cv2.COLOR_BGR2RGB)
        np.testing.assert_array_equal(left, textured_plane.left)
        depth_m, _ = read_depth_png(f"out/depth/{number:06d}.png")
        np.testing.assert_allclose(depth_m, np.where(result.depth_m < 65.5, result.depth_m, 0), atol=6e-4)
        sigma, near = result.frame.output.sigma[0, ..., 0], result.depth_m > 0
        sigma_mm = cv2.imread(f"out/sigma/{number:06d}.png", cv2.IMREAD_UNCHANGED)
        assert sigma_mm.dtype == np.uint16 and not sigma_mm[~near].any()
        above = sigma_mm[near] - 1000.0 * sigma[near]
        assert above.min() > -0.01 and above.max() < 1.01
        assert float(rows[number]["median_m"]) == pytest.approx(np.median(depth_m[depth_m > 0]), abs=2e-3)


def test_views_above_each_other_are_found(options, textured_plane, pipe):
    video = write_video(Path("over.avi"), [np.vstack([textured_plane.left, textured_plane.right])] * 2)
    for layout in ("auto", "over-under"):
        changed = replace(options, source=(str(video),), side_by_side=layout, frames=1)
        (result,) = results_of(changed, pipe=pipe)
        np.testing.assert_array_equal(result.frame.left, textured_plane.left)


def test_squeezed_views_have_a_squeezed_camera(options, textured_plane, pipe):
    size = (textured_plane.left.shape[1] // 2, textured_plane.left.shape[0])
    views = [
        cv2.resize(view, size, interpolation=cv2.INTER_AREA)
        for view in (textured_plane.left, textured_plane.right)
    ]
    video = write_video(Path("half.avi"), [np.hstack(views)])
    (result,) = results_of(replace(options, source=(str(video),), side_by_side="half"), pipe=pipe)
    K = np.asarray(result.frame.output.K)[0]
    assert K[0, 0] == pytest.approx(textured_plane.K[0, 0] / 2) and K[1, 1] == pytest.approx(
        textured_plane.K[1, 1]
    )


def test_a_folder_is_replaced_only_with_overwrite(options, pipe):
    options = replace(options, out=Path("out"), frames=2)
    assert len(results_of(options, pipe=pipe)) == 2
    with pytest.raises(InputError, match="out, which contains files"):
        results_of(options, pipe=pipe)
    results_of(replace(options, overwrite=True, frames=1), pipe=pipe)
    assert [path.name for path in sorted(Path("out/depth").iterdir())] == ["000000.png"]


@pytest.mark.parametrize(
    "changes", [{"source": ("none.mp4",)}, {"calib": (Path("none.txt"),)}, {"prior": "none"}]
)
def test_a_run_that_fails_before_its_first_result_leaves_the_folder_as_it_was(options, pipe, changes):
    out = Path("results/out")
    pipe_of = None if "prior" in changes else pipe
    options = replace(options, out=out, frames=1)
    with pytest.raises(InputError, match="none"):
        results_of(replace(options, **changes), pipe=pipe_of)
    assert not out.parent.exists()
    results_of(options, pipe=pipe)
    earlier = contents(out)
    assert len(earlier) == 5
    with pytest.raises(InputError, match="none"):
        results_of(replace(options, overwrite=True, **changes), pipe=pipe_of)
    assert contents(out) == earlier


def test_a_replaced_recording_has_the_intrinsics_of_its_own_run(options, textured_plane, pipe):
    options = replace(options, out=Path("out"), frames=1)
    results_of(options, pipe=pipe)
    fx, baseline = 1.1 * float(textured_plane.K[0, 0]), float(textured_plane.E[0, 3])
    (other,) = results_of(replace(options, overwrite=True, calib=(), fx=fx, baseline=baseline), pipe=pipe)
    K = np.loadtxt("out/K.txt")
    assert K[0, 0] == pytest.approx(fx)
    np.testing.assert_allclose(K, np.asarray(other.frame.output.K)[0])


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_folder_in_use_or_that_cannot_be_created_is_found_before_the_prior_is_loaded(options, monkeypatch):
    monkeypatch.setattr(live, "prior_of_options", lambda *_: pytest.fail("loaded"))
    with locked_folder(Path()), pytest.raises(InputError, match="another run is using"):
        results_of(replace(options, out=Path(), overwrite=True))
    Path("file").touch()
    with pytest.raises(InputError, match="--out"):
        results_of(replace(options, out=Path("file/out")))


def test_depths_that_are_not_reliable_are_holes_in_files_and_rows(options, pipe):
    (plain,) = results_of(replace(options, frames=1), pipe=pipe)
    confidence, sigma = (getattr(plain.frame.output, name)[0, ..., 0] for name in ("confidence", "sigma"))
    limit, most = float(np.quantile(confidence, 0.3)), float(np.nanquantile(sigma, 0.7))
    thresholds = {"min_confidence": limit, "max_sigma": most}
    (sure,) = results_of(replace(options, frames=1, out=Path("out"), **thresholds), pipe=pipe)
    kept = (confidence >= limit) & (sigma <= most) & (plain.depth_m > 0)
    assert 0.2 < kept.mean() < 0.9
    np.testing.assert_array_equal(sure.depth_m, np.where(kept, plain.depth_m, 0))
    assert sure.row["median_m"] == pytest.approx(np.median(plain.depth_m[kept]), abs=1e-3)
    for name in ("depth", "sigma"):
        image = cv2.imread(f"out/{name}/000000.png", cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image > 0, kept)


def test_a_preset_without_confidence_has_no_sigma_and_no_thresholds(options, pipe):
    options = replace(options, parameter=("refine_edges=false",), frames=1, out=Path("out"))
    results_of(options, pipe=pipe)
    assert Path("out/depth/000000.png").is_file() and not list(Path("out/sigma").iterdir())
    with pytest.raises(InputError, match="--max-sigma needs a confidence"):
        results_of(replace(options, overwrite=True, max_sigma=0.1), pipe=pipe)


def test_assumptions_about_the_cameras_are_reported_once(options, textured_plane, pipe):
    lines, K = [], textured_plane.K
    numbers = {"calib": (), "fx": float(K[0, 0]), "baseline": float(textured_plane.E[0, 3])}
    results_of(replace(options, **numbers), pipe=pipe, notify=lines.append)
    assert len([line for line in lines if "at the image centre" in line]) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": ()}, "--source must be passed once, or twice.*; got none"),
        ({"source": ("0", "1", "2")}, "got 3 sources"),
        (
            {"side_by_side": None},
            "is one view. Pass the right camera with a second --source, or --side-by-side",
        ),
        ({"source": ("0", "1")}, "--side-by-side is for one source"),
        ({"size": "640"}, "--size must be WIDTHxHEIGHT in pixels, such as 1344x376; got '640'"),
        ({"calib": ()}, "The cameras are missing"),
        ({"calib": (Path("none.txt"),)}, "none.txt"),
        ({"overwrite": True}, "--overwrite needs --out"),
        ({"max_sigma": 0.0}, "--max-sigma must be a finite number of metres above 0"),
        ({"near": 3.0, "far": 2.0}, "--near"),
        ({"parameter": ("nothing=1",)}, "nothing"),
        ({"source": ("none.mp4",)}, "none.mp4"),
    ],
)
def test_options_are_checked_before_the_prior_is_loaded(options, monkeypatch, changes, message):
    monkeypatch.setattr(live, "prior_of_options", lambda *_: pytest.fail("loaded"))
    with pytest.raises(InputError, match=message):
        results_of(replace(options, **changes))


def test_frames_of_another_size_than_the_calibration(options, textured_plane, pipe):
    small = np.hstack([textured_plane.left[:-8], textured_plane.right[:-8]])
    video = write_video(Path("small.avi"), [small])
    with pytest.raises(InputError, match="the left image small.avi must be [0-9]+x[0-9]+ pixels"):
        results_of(replace(options, source=(str(video),)), pipe=pipe)


def result(number: int, latency_s: float, status: str = "trusted") -> live.LiveResult:
    output = SimpleNamespace(verdict=SimpleNamespace(trusted=status == "trusted"))
    return live.LiveResult(
        SimpleNamespace(number=number, latency_s=latency_s, output=output), np.zeros(0), {}
    )


def test_rate_and_latency(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(live.time, "perf_counter", lambda: now[0])
    meter = LiveMeter()
    assert np.isnan(meter.rate_hz) and np.isnan(meter.totals()["rate_hz"]) and meter.totals()["results"] == 0
    for number in range(30):  # 2 per second, then 10 per second; every other frame is skipped
        now[0] += 0.5 if number < 15 else 0.1
        meter.add(result(2 * number, 0.3 + 0.001 * number, "not trusted" if number == 3 else "trusted"))
    assert meter.rate_hz == pytest.approx(10.0)
    totals = meter.totals()
    assert (totals["results"], totals["skipped"], totals["not_trusted"]) == (30, 29, 1)
    assert totals["rate_hz"] == pytest.approx(29 / (14 * 0.5 + 15 * 0.1))
    assert totals["latency_ms_median"] == pytest.approx(314.5)
    assert totals["latency_ms_95"] == pytest.approx(327.55)


def test_a_frame_without_any_depth(textured_plane):
    shape = (1, *textured_plane.left.shape[:2], 1)
    verdict = SimpleNamespace(facts=FactSheet(), status="not judged", reasons=())
    output = MetricDepthOutput(np.zeros(shape), verdicts=[verdict])
    assert output.verdict.facts[MatchedFraction] is None
    row = live._result(SimpleNamespace(output=output, number=4, latency_s=0.5, checked=False), 0.0).row
    assert [row[name] for name in ("frame", "latency_ms", "near_m", "confidence")] == [4, 500, None, None]
