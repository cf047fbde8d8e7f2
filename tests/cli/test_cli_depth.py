"""The command end to end on a tiny random prior: files, report, silence, Ctrl-C, the demo."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

FILES = {"depth.npy", "depth_mm.png", "depth.png", "overview.png", "visible.png", "photometric_error.npy"}
FILES |= {"cloud.ply", "report.json"}
CONFIDENCE = {"confidence.npy", "confidence.png"}
#: One update of one step: for tests of everything but the depth.
QUICK = ["--steps", 1, "--preset", "paper"]


@pytest.fixture
def command(pair_files, prior):
    return [*pair_files.command, "--prior", prior, "--device", "cpu"]


def report_of(folder: str = "geodiff-out") -> dict:
    return json.loads(Path(folder, "report.json").read_text())


def test_known_points_move_the_depth(geodiff, command):
    known = np.zeros((48, 64), np.float32)
    known[::4, ::4] = 2.5
    np.save("lidar.npy", known)
    answer = geodiff(*command, "--steps", 1, "--points", "lidar.npy", "-q")
    assert answer.code == 0, answer.err
    depth_m = np.load("geodiff-out/depth.npy")
    assert np.median(np.abs(depth_m[known > 0] / 2.5 - 1)) < 0.1


def test_a_further_view_takes_part_with_a_lens_of_its_own(geodiff, command, pair_files, textured_plane):
    """The pair's right image once more, straight and as if its lens had bent it; knobs reach the guidance."""
    Image.fromarray(textured_plane.right).save("third.png")
    np.savetxt("pose.txt", textured_plane.E)
    knobs = ["--knob", "inner_steps=0", "--knob", "weights.photometric=0.5"]
    view = [*command, *QUICK[:2], *knobs, "--view", "third.png", "--view-E", "pose.txt", "-q"]
    for name, lens in (("straight", "0,0,0,0"), ("bent", "0.3,0,0,0")):
        answer = geodiff(*view, "--view-distortion", lens, "--out", name)
        assert answer.code == 0, answer.err
    straight, bent = report_of("straight"), report_of("bent")
    assert [straight["undistorted"], bent["undistorted"]] == [False, True]
    assert straight["depth"]["median_m"] != bent["depth"]["median_m"]
    (further,) = straight["inputs"]["further_views"]
    assert further["E"] == straight["inputs"]["E"] and straight["arguments"]["view"] == ["third.png"]
    guidance = straight["guidance"]
    assert guidance["inner_steps"] == 0 and guidance["weights"]["photometric"] == 0.5


def test_writes_everything(geodiff, command):
    answer = geodiff(*command)
    assert answer.code == 0, answer.err
    out = Path("geodiff-out")
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

    report = report_of()
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


def test_json_and_quiet(geodiff, command):
    answer = geodiff(*command, "--json", "--quiet", "--ensemble", 2, "--steps", 1, "--resolution", 32, *GIVEN)
    assert (answer.code, answer.err) == (0, "")
    report = json.loads(answer.out)
    assert report == report_of()
    assert report["uncertainty_median_m"] >= 0 and len(report["scale"][0]) == 2
    assert np.load("geodiff-out/uncertainty.npy").shape == (48, 64)
    again = geodiff(*command, "--quiet", "--overwrite", *QUICK, *GIVEN)
    assert (again.code, again.out, again.err) == (0, "", "")
    assert {path.name for path in Path("geodiff-out").iterdir()} == FILES


def test_seeds_presets_and_range(geodiff, command):
    for out, seed in (("a", 1), ("b", 1), ("c", 2)):
        words = [*command, "--quiet", *QUICK, "--seed", seed, "--out", out, "--near", 1, "--far", 5]
        assert geodiff(*words).code == 0
    a, b, c = (np.load(f"{out}/depth.npy") for out in "abc")
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    paper = report_of("a")["guidance"]
    assert paper["gradient"] == "full" and paper["g_s_range"] == [1.0, 5.0]
    answer = geodiff(*command, "--quiet", "--json", "--steps", 1, "--near", 1, "--far", 5)
    guidance = json.loads(answer.out)["guidance"]
    assert guidance["gradient"] == "denoised" and guidance["depth_range"] == [1.0, 5.0]


def test_images_of_different_kind_and_size(geodiff, command, pair_files, textured_plane):
    """A grey 16-bit left image and a right one of twice the size with a K of its own."""
    grey = textured_plane.left.mean(-1) / 255 * 65535
    Image.fromarray(grey.astype(np.uint16)).save(pair_files.left)
    Image.open(pair_files.right).resize((128, 96)).save(pair_files.right)
    K_right = textured_plane.K.copy()
    K_right[:2, :2] *= 2
    K_right[:2, 2] = K_right[:2, 2] * 2 + 0.5
    for name, matrix in (("K", textured_plane.K), ("Kr", K_right), ("E", textured_plane.E)):
        np.savetxt(f"{name}.txt", matrix)
    cameras = ["--K", "K.txt", "--K-right", "Kr.txt", "--E", "E.txt"]
    answer = geodiff(*pair_files.images, *cameras, *command[5:], *QUICK, "--quiet", "--json")
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["inputs"]["right_size"] == [128, 96]


def test_the_right_cameras_centre(geodiff, command, pair_files):
    """Assumed where it is not given, and said; with it depth is of another disparity."""
    camera = [
        *pair_files.images,
        *"--fx 60 --fy 60 --cx 31.5 --cy 23.5 --baseline 0.12".split(),
        *command[5:],
    ]
    answer = geodiff(*camera, *QUICK, "--out", "same")
    assert answer.code == 0 and "assumed: The right camera's cx" in answer.err and "--cx-right" in answer.err
    answer = geodiff(*camera, *QUICK, "--cx-right", 33.5, "--out", "other")
    assert answer.code == 0 and "assumed" not in answer.err
    assert report_of("other")["inputs"]["K_right"][0][2] == 33.5
    assert report_of("same")["assumed"] and not report_of("other")["assumed"]


@pytest.mark.parametrize("prior_name", ["no/such-prior", "no such folder/at all", "./empty"])
def test_prior_that_is_not_there(geodiff, pair_files, prior_name, monkeypatch):
    Path("empty").mkdir()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    answer = geodiff(*pair_files.command, "--prior", prior_name)
    assert answer.code == 2
    assert len(answer.err.splitlines()) == 1 and "bundled" in answer.err
    assert not Path("geodiff-out").exists()


@pytest.mark.parametrize("error", [RuntimeError, OSError])
def test_failing_call_writes_nothing(geodiff, command, pair_files, monkeypatch, error):
    def broken(*_):
        raise error("in the middle")

    monkeypatch.setattr("geodiff_plugin.cli.depth.write_maps", broken)
    before = sorted(path.name for path in pair_files.folder.iterdir())
    if error is OSError:  # a full disk, say
        assert "geodiff-out could not be written (in the middle)" in geodiff(*command, "-q", *QUICK).err
    else:
        with pytest.raises(error, match="in the middle"):
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
    said = b"geodiff: interrupted; the same command resumes"
    assert b"Traceback" not in rest and rest.rstrip().endswith(said)
    assert sorted(path.name for path in pair_files.folder.iterdir()) == before


def test_info(geodiff, prior, tmp_path):
    answer = geodiff("info", "--prior", prior)
    assert answer.code == 0
    for word in ("torch", "cpu", "marigold", "cached", "MarigoldDepthPipeline", "DDIMScheduler"):
        assert word in answer.out
    missing = geodiff("info", "--prior", tmp_path / "nothing")
    assert missing.code == 2 and len(missing.err.splitlines()) == 1
    assert "--space must be one of" in geodiff("info", "--prior", prior, "--space", "banana").err
    assert "--space must be given with --prior" in geodiff("info", "--space", "depth").err
    knobs = geodiff("info", "--knobs")
    assert knobs.code == 0 and "  smoothness = 40" in knobs.out and "  weights = photometric 1" in knobs.out


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
    assert f"Open {Path('geodiff-demo', 'comparison.png')} first" in answer.out
    assert {path.name for path in out.iterdir()} == FILES | CONFIDENCE | {"comparison.png", "notes.txt"}
    assert np.load(out / "depth.npy").shape == (336, 448)


def test_points_without_a_right_image_and_a_cloud_of_what_is_believed(geodiff, pair_files, command):
    known = np.zeros((48, 64), np.float32)
    known[::4, ::4] = np.linspace(1.5, 3.0, 16)[None]
    np.save("lidar.npy", known)
    camera = ["--fx", 60, "--fy", 60, "--cx", 31.5, "--cy", 23.5, "--points", "lidar.npy", *command[5:]]
    answer = geodiff("depth", pair_files.left, *camera, "--steps", 1, "--json", "-q", "--min-confidence", 0.6)
    assert answer.code == 0, answer.err
    report = json.loads(answer.out)
    names = {path.name for path in Path("geodiff-out").iterdir()}
    assert names == FILES - {"visible.png", "photometric_error.npy"} | CONFIDENCE
    assert report["verdict"]["signs"]["points"] == 192 and report["depth"]["visible_fraction"] == 0
    doubtful, counts = np.load("geodiff-out/confidence.npy") < 0.6, report["files"]
    assert counts["doubtful_points"] == doubtful.sum()
    assert counts["cloud_points"] <= doubtful.size - doubtful.sum()
    one = np.zeros((48, 64), np.float32)
    one[20, 30] = 2.0
    np.save("lidar.npy", one)
    answer = geodiff("depth", pair_files.left, *camera, "--steps", 1, "--strict", "--out", "strict")
    assert answer.code == 2 and "Too few known depths to fix both scale and shift, 1;" in answer.err
    assert not Path("strict").exists()
