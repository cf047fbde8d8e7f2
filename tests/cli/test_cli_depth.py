"""The command end to end on a tiny random prior: files, report, silence, Ctrl-C, the demo."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

FILES = {
    "depth.npy",
    "depth_mm.png",
    "depth.png",
    "overview.png",
    "visible.png",
    "photometric_error.npy",
    "cloud.ply",
    "report.json",
}


CONFIDENCE = {"confidence.npy", "confidence.png"}

#: One update of one step: for tests of everything but the depth.
QUICK = ["--steps", 1, "--preset", "paper"]


@pytest.fixture
def command(pair_files, prior):
    return [*pair_files.command, "--prior", prior, "--device", "cpu"]


def test_known_points_move_the_depth(geodiff, command, pair_files, tmp_path):
    known = np.zeros((48, 64), np.float32)
    known[::4, ::4] = 2.5
    np.save(tmp_path / "lidar.npy", known)
    answer = geodiff(*command, "--steps", 1, "--points", tmp_path / "lidar.npy", "-q")
    assert answer.code == 0, answer.err
    depth_m = np.load(pair_files.folder / "geodiff-out" / "depth.npy")
    assert np.median(np.abs(depth_m[known > 0] / 2.5 - 1)) < 0.1
    answer = geodiff(*command, *QUICK, "--points", tmp_path / "lidar.npy", "--overwrite")
    assert answer.code == 2 and "--points must be given with the default preset" in answer.err


def test_a_further_view_takes_part(geodiff, command, pair_files, textured_plane):
    """The pair's right image once more, as a third camera: twice the evidence, the same depth."""
    third, pose = pair_files.folder / "third.png", pair_files.folder / "pose.txt"
    Image.fromarray(textured_plane.right).save(third)
    np.savetxt(pose, textured_plane.E)
    answer = geodiff(*command, "--steps", 1, "--view", third, "--view-E", pose, "-q")
    assert answer.code == 0, answer.err
    out = pair_files.folder / "geodiff-out"
    report = json.loads((out / "report.json").read_text())
    (further,) = report["inputs"]["further_views"]
    assert further["E"] == report["inputs"]["E"] and report["arguments"]["view"] == [str(third)]
    assert np.isfinite(np.load(out / "depth.npy")).all()


def test_a_further_view_has_a_lens_of_its_own(geodiff, command, pair_files, textured_plane):
    """Distorted as its lens says, the view is the one that a pinhole camera would have taken."""
    third, pose = pair_files.folder / "third.png", pair_files.folder / "pose.txt"
    Image.fromarray(textured_plane.right).save(third)
    np.savetxt(pose, textured_plane.E)
    view = [*command, *QUICK[:2], "--knob", "inner_steps=0", "--view", third, "--view-E", pose, "-q"]
    for name, lens in (("straight", "0,0,0,0"), ("bent", "0.3,0,0,0")):
        answer = geodiff(*view, "--view-distortion", lens, "--out", pair_files.folder / name)
        assert answer.code == 0, answer.err
    reports = [json.loads((pair_files.folder / n / "report.json").read_text()) for n in ("straight", "bent")]
    assert [report["undistorted"] for report in reports] == [False, True]
    assert reports[0]["depth"]["median_m"] != reports[1]["depth"]["median_m"]


def test_knobs_reach_the_guidance(geodiff, command, pair_files):
    knobs = ["--knob", "inner_steps=0", "--knob", "weights.photometric=0.5", "--knob", "search=volume"]
    answer = geodiff(*command, "--steps", 1, *knobs, "-q")
    assert answer.code == 0, answer.err
    guidance = json.loads((pair_files.folder / "geodiff-out" / "report.json").read_text())["guidance"]
    assert guidance["inner_steps"] == 0 and guidance["search"] == "volume"
    assert guidance["weights"]["photometric"] == 0.5 and guidance["weights"]["matches"] == 1.0


def test_info_lists_the_knobs(geodiff):
    answer = geodiff("info", "--knobs")
    assert (
        answer.code == 0 and "  smoothness = 40" in answer.out and "  weights = photometric 1" in answer.out
    )


def test_writes_everything(geodiff, command, pair_files):
    answer = geodiff(*command)
    assert answer.code == 0, answer.err
    out = pair_files.folder / "geodiff-out"
    assert {path.name for path in out.iterdir()} == FILES | CONFIDENCE
    assert answer.out.count("\n") == 1 and " m to " in answer.out and "geodiff-out/" in answer.out
    assert "loss=" in answer.err

    depth_m = np.load(out / "depth.npy")
    assert depth_m.dtype == np.float32 and depth_m.shape == (48, 64) and (depth_m > 0).all()
    millimetres = np.asarray(Image.open(out / "depth_mm.png"))
    near = depth_m < 65.5
    np.testing.assert_allclose(millimetres[near] / 1000, depth_m[near], atol=5.1e-4)
    assert (millimetres[depth_m > 65.536] == 0).all()
    visible = np.asarray(Image.open(out / "visible.png"))
    assert visible.shape == (48, 64) and set(np.unique(visible)) <= {0, 255}
    assert np.load(out / "photometric_error.npy").shape == (48, 64)
    with Image.open(out / "depth.png") as figure:
        assert figure.width > 64

    report = json.loads((out / "report.json").read_text())
    assert set(report["files"]["names"]) == FILES | CONFIDENCE
    confidence = np.load(out / "confidence.npy")
    assert confidence.shape == (48, 64) and 0.0 <= confidence.min() <= confidence.max() <= 1.0
    assert report["files"]["doubtful_points"] == 0
    assert report["depth"]["median_m"] == pytest.approx(float(np.median(depth_m)))
    assert report["depth"]["visible_fraction"] == pytest.approx((visible > 0).mean())
    assert report["files"]["depth_mm_zero_pixels"] == (millimetres == 0).sum()
    assert set(report["seconds"]) == {"start", "calibration", "load", "guided call", "write"}
    assert len(report["history"]) == 2 and report["inputs"]["baseline_m"] == pytest.approx(0.12)
    assert report["arguments"]["seed"] == 0 and report["versions"]["torch"]

    cloud = (out / "cloud.ply").read_bytes()
    assert cloud.startswith(b"ply\nformat binary_little_endian")
    assert f"element vertex {report['files']['cloud_points']}\n".encode() in cloud


#: So small a pair has too few matches to check its pose by, which a run says.
GIVEN = ("--knob", "pose=given")


def test_json_and_quiet(geodiff, command, pair_files):
    answer = geodiff(*command, "--json", "--quiet", "--ensemble", 2, "--steps", 1, "--resolution", 32, *GIVEN)
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report == json.loads((pair_files.folder / "geodiff-out" / "report.json").read_text())
    assert report["uncertainty_median_m"] >= 0 and len(report["scale"][0]) == 2
    assert np.load(pair_files.folder / "geodiff-out" / "uncertainty.npy").shape == (48, 64)
    again = geodiff(*command, "--quiet", "--overwrite", *QUICK, *GIVEN)
    assert (again.code, again.out, again.err) == (0, "", "")
    assert {path.name for path in (pair_files.folder / "geodiff-out").iterdir()} == FILES


def test_same_seed_same_depth(geodiff, command, pair_files):
    for out, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert geodiff(*command, "--quiet", *QUICK, "--seed", seed, "--out", out).code == 0
    a, b, c = (np.load(pair_files.folder / out / "depth.npy") for out in "abc")
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_presets_and_range(geodiff, command, pair_files, preset):
    answer = geodiff(*command, "--quiet", "--json", "--steps", 1, "--preset", preset, "--near", 1, "--far", 5)
    guidance = json.loads(answer.out)["guidance"]
    assert guidance["gradient"] == ("full" if preset == "paper" else "denoised")
    searched = guidance["g_s_range"] if preset == "paper" else guidance["depth_range"]
    assert searched == [1.0, 5.0]


def test_images_of_different_kind_and_size(geodiff, prior, pair_files, textured_plane):
    """A grey 16-bit left image and a right one of twice the size with a K of its own."""
    grey = textured_plane.left.mean(-1) / 255 * 65535
    Image.fromarray(grey.astype(np.uint16)).save(pair_files.left)
    Image.open(pair_files.right).resize((128, 96)).save(pair_files.right)
    K_right = textured_plane.K.copy()
    K_right[:2, :2] *= 2
    K_right[:2, 2] = K_right[:2, 2] * 2 + 0.5
    for name, matrix in (("K", textured_plane.K), ("Kr", K_right), ("E", textured_plane.E)):
        np.savetxt(pair_files.folder / f"{name}.txt", matrix)
    cameras = ["--K", "K.txt", "--K-right", "Kr.txt", "--E", "E.txt"]
    answer = geodiff(*pair_files.images, *cameras, "--prior", prior, *QUICK, "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["inputs"]["right_size"] == [128, 96]


@pytest.mark.parametrize("prior_name", ["no/such-prior", "no such folder/at all", "./empty"])
def test_prior_that_is_not_there(geodiff, pair_files, prior_name, monkeypatch):
    (pair_files.folder / "empty").mkdir()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    answer = geodiff(*pair_files.command, "--prior", prior_name)
    assert answer.code == 2
    assert len(answer.err.splitlines()) == 1 and "bundled" in answer.err
    assert not (pair_files.folder / "geodiff-out").exists()


def test_failing_call_writes_nothing(geodiff, command, pair_files, monkeypatch):
    def broken(*_):
        raise RuntimeError("in the middle")

    monkeypatch.setattr("geodiff_plugin.cli.depth.write_maps", broken)
    before = sorted(path.name for path in pair_files.folder.iterdir())
    with pytest.raises(RuntimeError, match="in the middle"):
        geodiff(*command, "--quiet", *QUICK)
    assert sorted(path.name for path in pair_files.folder.iterdir()) == before


def test_interrupt_of_a_running_process(command, pair_files):
    """Ctrl-C while it denoises: exit code 130, no traceback, nothing written."""
    before = sorted(path.name for path in pair_files.folder.iterdir())
    process = subprocess.Popen(
        [sys.executable, "-m", "geodiff_plugin", *map(str, command), "--steps", "1000"],
        cwd=pair_files.folder,
        stderr=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        # A job in the background of a script ignores Ctrl-C, and hands that down.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    heard = b""
    deadline = time.monotonic() + 120
    while b"guided steps" not in heard and time.monotonic() < deadline:
        heard += os.read(process.stderr.fileno(), 4096)
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=60)[1]
    assert process.returncode == 130, heard + rest
    assert b"Traceback" not in rest and rest.rstrip().endswith(
        b"geodiff: interrupted; the same command resumes"
    )
    assert sorted(path.name for path in pair_files.folder.iterdir()) == before


def test_help_and_version_do_not_import_torch():
    code = (
        "import sys\nfrom geodiff_plugin.cli.app import main\n"
        "try:\n    main([sys.argv[1]])\nexcept SystemExit:\n    pass\n"
        "assert 'torch' not in sys.modules and 'diffusers' not in sys.modules"
    )
    for option in ("--version", "--help"):
        answer = subprocess.run([sys.executable, "-c", code, option], capture_output=True, text=True)
        assert answer.returncode == 0, answer.stderr
    assert "depth" in answer.stdout and "demo" in answer.stdout


def test_info(geodiff, prior, monkeypatch, tmp_path):
    answer = geodiff("info", "--prior", prior)
    assert answer.code == 0
    for word in ("torch", "cpu", "marigold", "cached", "MarigoldDepthPipeline", "DDIMScheduler"):
        assert word in answer.out
    missing = geodiff("info", "--prior", tmp_path / "nothing")
    assert missing.code == 2 and len(missing.err.splitlines()) == 1
    assert "--space must be one of" in geodiff("info", "--prior", prior, "--space", "banana").err
    assert "--space must be given with --prior" in geodiff("info", "--space", "depth").err


def test_demo(geodiff, prior, pair_files, monkeypatch):
    """Over the folder of an earlier run; the tiny prior stands in for the bundled one."""
    monkeypatch.setattr("geodiff_plugin.priors.loading.BUNDLED_FOLDER", prior)
    out = pair_files.folder / "geodiff-demo"
    out.mkdir()
    (out / "depth.npy").write_text("of an earlier run")
    (out / "uncertainty.npy").write_text("of an earlier run")
    (out / "notes.txt").write_text("somebody's own")
    (out / "report.json").write_text('{"files": {"names": ["depth.npy", "uncertainty.npy"]}}')
    answer = geodiff("demo", "--quiet", "--overwrite")
    assert answer.code == 0, answer.err
    assert "AbsRel" in answer.out and "delta1" in answer.out and "guided" in answer.out
    assert {path.name for path in out.iterdir()} == FILES | CONFIDENCE | {"comparison.png", "notes.txt"}
    assert np.load(out / "depth.npy").shape == (336, 448)


def test_a_cloud_of_what_is_believed(geodiff, command, pair_files):
    quick = ["--quiet", "--steps", 1, "--resolution", 32]
    assert geodiff(*command, *quick, "--min-confidence", 0.6).code == 0
    out = pair_files.folder / "geodiff-out"
    counts = json.loads((out / "report.json").read_text())["files"]
    doubtful = np.load(out / "confidence.npy") < 0.6
    assert counts["doubtful_points"] == doubtful.sum()
    assert counts["cloud_points"] <= doubtful.size - doubtful.sum()
    refused = geodiff(*command, *quick, "--min-confidence", 1.5, "--out", "other")
    assert refused.code == 2 and "--min-confidence" in refused.err


def test_points_without_a_right_image(geodiff, pair_files, prior):
    known = np.zeros((48, 64), np.float32)
    known[::4, ::4] = np.linspace(1.5, 3.0, 16)[None]
    np.save(pair_files.folder / "lidar.npy", known)
    camera = ["--fx", 60, "--fy", 60, "--cx", 31.5, "--cy", 23.5, "--points", "lidar.npy"]
    quick = ["--prior", prior, "--steps", 1, "--device", "cpu"]
    answer = geodiff("depth", pair_files.left, *camera, *quick, "--json", "-q")
    assert answer.code == 0, answer.err
    report = json.loads(answer.out)
    names = {path.name for path in (pair_files.folder / "geodiff-out").iterdir()}
    assert names == FILES - {"visible.png", "photometric_error.npy"} | CONFIDENCE
    assert report["verdict"]["signs"]["points"] == 192 and report["depth"]["visible_fraction"] == 0
    one = np.zeros((48, 64), np.float32)
    one[20, 30] = 2.0
    np.save(pair_files.folder / "lidar.npy", one)
    answer = geodiff("depth", pair_files.left, *camera, *quick, "--strict", "--out", "strict")
    assert answer.code == 2 and "Too few known depths to fix both scale and shift, 1;" in answer.err
    assert not (pair_files.folder / "strict").exists()
