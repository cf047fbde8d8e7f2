"""``geodiff capture`` never mixes two runs in one folder, and ends well when it is stopped."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

pytest.importorskip("pycolmap")

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.out import FOLDER_LOCK, PARTIAL, locked_folder
from geodiff_plugin.jobs.capture_frames import JOURNAL
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.result.expected_error import MATCH_NOISE_PX, expected_error
from tests.cli.conftest import call
from tests.unit.capture_room import render, walk, write_transforms

pytestmark = pytest.mark.end_to_end

TRUE = walk(10)[3:7]
QUICK = ["--steps", 1, "--neighbours", 1, "--processes", 1, "--device", "cpu", "-q"]


@pytest.fixture(autouse=True)
def few_features(monkeypatch):
    monkeypatch.setattr("geodiff_plugin.pose.reconstruction.MAX_FEATURES", 450)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A capture, its prior maps, and a folder in which the depth of one frame is finished."""
    folder = tmp_path_factory.mktemp("finished")
    write_transforms(folder / "scan", TRUE, TRUE)
    (folder / "maps").mkdir()
    for i, E in enumerate(TRUE):
        np.save(folder / f"maps/f{i:02d}.npy", render(E)[1].astype(np.float32))
    assert call(typed(folder)) in (0, 4)
    return folder


@pytest.fixture
def scan(finished, tmp_path):
    """A copy of it that a test may change."""
    shutil.copytree(finished, tmp_path / "copy")
    return tmp_path / "copy"


def typed(folder, *more):
    maps = ["--prior-map", folder / "maps"]
    return ["capture", folder / "scan", "--out", folder / "out", *maps, "--frames", "f01", *QUICK, *more]


def depth_of(folder):
    return (folder / "out/f01/depth.npy").read_bytes()


def test_the_same_run_again_keeps_what_is_there_also_in_another_place(scan, geodiff):
    made = (scan / "out/f01/depth_alone.npy").stat().st_mtime_ns
    answer = geodiff(*typed(scan))
    assert answer.code in (0, 4), answer.err
    assert (scan / "out/f01/depth_alone.npy").stat().st_mtime_ns == made
    assert not (scan / "out" / FOLDER_LOCK).exists()


def test_other_settings_are_rejected_with_the_difference_and_overwrite_recomputes_all(scan, geodiff):
    (scan / "out/f01/notes.txt").write_text("mine")
    first, summary = depth_of(scan), (scan / "out/capture.json").read_bytes()
    answer = geodiff(*typed(scan, "--metres-per-unit", 2))
    assert answer.code == 2 and "made with the default of --metres-per-unit instead of 2.0" in answer.err
    assert depth_of(scan) == first and (scan / "out/capture.json").read_bytes() == summary
    assert geodiff(*typed(scan, "--metres-per-unit", 2, "--overwrite")).code in (0, 4)
    ratio = np.load(scan / "out/f01/depth.npy") / np.load(scan / "maps/f01.npy")
    assert np.median(ratio) == pytest.approx(2, rel=0.05)
    assert (scan / "out/f01/notes.txt").read_text() == "mine"
    answer = geodiff(*typed(scan))
    assert answer.code == 2 and "made with --metres-per-unit 2.0 instead of the default" in answer.err


def changed_camera(folder):
    path = folder / "scan/transforms.json"
    said = json.loads(path.read_text())
    path.write_text(json.dumps(said | {"fl_x": said["fl_x"] * 0.8}))


def moved_poses(folder):
    path = folder / "scan/transforms.json"
    said = json.loads(path.read_text())
    for frame in said["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 3
    path.write_text(json.dumps(said))


def other_image(folder):
    Image.fromarray(render(TRUE[0])[0][::-1].copy()).save(folder / "scan/images/f02.png")


def other_map(folder):
    np.save(folder / "maps/f01.npy", np.load(folder / "maps/f01.npy") + 1)


def lost_frame(folder):
    (folder / "scan/images/f03.png").unlink()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed_camera, "the camera of f00, f01, f02, f03 changed"),
        (moved_poses, "the camera of f00, f01, f02, f03 changed"),
        (other_image, "the image of f02 changed"),
        (other_map, "the prior map of f01 changed"),
        (lost_frame, "made of 4 frames instead of 3"),
    ],
)
def test_changed_inputs_are_rejected_and_named(change, words, scan, geodiff):
    first, poses = depth_of(scan), (scan / "out/poses.npz").read_bytes()
    change(scan)
    for more in [()] if change is other_map else [(), ("--poses-only",)]:
        answer = geodiff(*typed(scan, *more))
        assert answer.code == 2 and words in answer.err and "--overwrite" in answer.err
    assert depth_of(scan) == first and (scan / "out/poses.npz").read_bytes() == poses


def test_a_frame_of_another_run_does_not_count_as_done(scan, geodiff):
    path = scan / "out/f01/report.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"made_from": "of another"}))
    answer = geodiff(*typed(scan))
    assert answer.code == 2 and "with other settings or inputs of f01" in answer.err


def test_runs_at_the_same_time_in_one_folder_are_rejected_but_shards_share_it(scan, geodiff):
    whole, shard = typed(scan), typed(scan, "--shard", "0/2")
    with locked_folder(scan / "out"):
        for each in (whole, shard):
            answer = geodiff(*each)
            assert answer.code == 2 and "a folder that no other run uses" in answer.err
    with locked_folder(scan / "out", shared=True):
        assert geodiff(*whole).code == 2
        assert geodiff(*shard).code == 0
    assert not (scan / "out" / FOLDER_LOCK).exists()


def test_a_failed_frame_before_an_untrusted_one_is_a_sentence(scan, geodiff):
    (scan / "maps/f00.npy").unlink()
    np.save(scan / "maps/f01.npy", 10 - np.load(scan / "maps/f01.npy"))
    words = [str(word) for word in typed(scan, "--overwrite")]
    words[words.index("--frames") + 1] = "f00,f01"
    words.remove("-q")
    answer = geodiff(*words)
    assert answer.code == 4, answer.err
    assert "1 of 2 frames" in answer.out and "NOT TRUSTED: f01 (f01: " in answer.out
    frames = json.loads((scan / "out/capture.json").read_text())["frames"]
    assert [frame["frame"] for frame in frames] == ["f00", "f01"] and "f00" in frames[0]["error"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM to be caught")
def test_asked_to_end_it_clears_away_what_it_began(finished, tmp_path):
    out, quick = tmp_path / "out", "--poses given --steps 1 --processes 2 --device cpu -q".split()
    words = ["capture", finished / "scan", "--out", out, "--prior-map", finished / "maps", *quick]
    shell = [sys.executable, "-m", "geodiff_plugin", *map(str, words)]
    with subprocess.Popen(shell, stderr=subprocess.PIPE, text=True, env=os.environ) as process:
        deadline = time.monotonic() + 300
        while not list(out.glob("f*/" + PARTIAL)) + list(out.glob(f".f*{PARTIAL}")):  # the first is written
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.002)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 143
    assert (
        "geodiff: terminated. Run the same command again to resume or restart." in said
        and "Traceback" not in said
    )
    left = [path.name for path in out.rglob("*") if PARTIAL in path.name or path.name == FOLDER_LOCK]
    assert not left


WITHOUT_GUARD = """
import sys
from geodiff_plugin.cli.app import main
from geodiff_plugin.jobs.processes import WorkerProcess

def call(process, *args):
    if KILLS:
        process._process.kill()
    record = called(process, *args)
    print("another process made", record["frame"])
    return record

called, WorkerProcess.call = WorkerProcess.call, call
print("the script runs")
main(sys.argv[1:])
"""


@pytest.mark.parametrize("kills", [False, True], ids=["alive", "killed"])
def test_a_script_without_guard_has_frames_by_several_processes(kills, finished, tmp_path):
    (tmp_path / "script.py").write_text(WITHOUT_GUARD.replace("KILLS", str(kills)))
    words = [*typed(finished), "--out", tmp_path / "out", "--frames", "f01,f02", "--processes", 2]
    ran = subprocess.run(
        [sys.executable, tmp_path / "script.py", *map(str, words)], capture_output=True, text=True
    )
    assert ran.returncode in (0, 4) and "Traceback" not in ran.stderr, ran.stderr
    lines = ran.stdout.splitlines()
    assert lines.count("the script runs") == 1 and any(line.startswith("2 of 2 frames") for line in lines)
    assert any(line.startswith("another process made f0") for line in lines) == (not kills)
    assert ("is being reprocessed: A worker process ended" in ran.stderr) == kills
    assert [path.name for path in (tmp_path / "out").glob("frames*")] == [JOURNAL]
    same = (folder / "f01/depth_alone.npy" for folder in (finished / "out", tmp_path / "out"))
    assert len({path.read_bytes() for path in same}) == 1


TOO_MUCH = [lambda: np.empty(1 << 50), lambda: torch.empty(1 << 50)]


@pytest.mark.parametrize("ask", TOO_MUCH, ids=["numpy", "torch"])
def test_what_does_not_fit_the_memory_is_one_sentence_with_its_size(ask, command, geodiff, monkeypatch):
    monkeypatch.setattr("geodiff_plugin.jobs.writing.build_report", lambda _: ask())
    answer = geodiff(*command, "--steps", 1, "--preset", "paper", "--out", "o", "-q")
    assert answer.code == 2 and "Traceback" not in answer.err
    assert "of 64x48 pixels (0.0 megapixels) does not fit in memory. Downscale the images" in answer.err


def test_other_errors_are_left_as_they_are():
    with pytest.raises(RuntimeError, match="shapes"), fitting_memory("A pair", (4, 3)):
        raise RuntimeError("shapes differ")
    with pytest.raises(InputError, match="bad name"), fitting_memory("A pair", (4, 3)):
        raise InputError("bad name: out of memory.png")


def test_the_expected_error_of_a_large_image_needs_little_additional_memory():
    depth_m = np.full((3000, 4000), 2.0, np.float32)
    E = np.eye(4)
    E[:3, 3] = 0.1, 0.02, 0.05
    tracemalloc.start()
    error_m = expected_error(depth_m, np.array([[900.0, 0, 2000], [0, 900, 1500], [0, 0, 1]]), [E], 0.01)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * error_m.nbytes
    row, column = 2900, 17
    ray = np.array([(column - 2000) / 900, (row - 1500) / 900])
    moved = 900 * np.linalg.norm(E[:2, 3] - ray * E[2, 3])
    expected = np.hypot((2 - E[2, 3]) ** 2 * MATCH_NOISE_PX / moved, 0.02)
    assert error_m[row, column] == pytest.approx(expected)


def test_a_finished_capture_is_exported_for_splats_and_read_back(scan, geodiff):
    answer = geodiff(*typed(scan, "--export", "nerfstudio", "--points", "tracks"))
    assert answer.code in (0, 4), answer.err
    exported = scan / "out/nerfstudio"
    (frame,) = json.loads((exported / "transforms.json").read_text())["frames"]
    units = np.asarray(Image.open(exported / frame["depth_file_path"]))
    depth = np.load(scan / "out/f01/depth.npy")
    known = units > 0
    assert known.mean() > 0.5
    np.testing.assert_allclose(units[known] * 1e-3, depth[known], atol=6e-4)
    np.testing.assert_array_equal(np.asarray(Image.open(exported / frame["depth_mask_path"])) > 0, known)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_killed_capture_resumes_to_the_same_bytes(tmp_path):
    write_transforms(tmp_path / "scan", TRUE, TRUE)

    def command_into(out):
        words = ["capture", tmp_path / "scan", "--out", out, *QUICK]
        return [sys.executable, "-m", "geodiff_plugin", *map(str, words)]

    def run(out):
        done = subprocess.run(command_into(out), capture_output=True, text=True)
        assert done.returncode in (0, 4), done.stderr

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run(whole)
    with subprocess.Popen(command_into(killed)) as process:
        deadline = time.monotonic() + 600
        # A frame that is written and not yet in the journal would be made again.
        while not ((killed / JOURNAL).is_file() and "f00" in (killed / JOURNAL).read_text()):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.002)
        process.kill()
    made = (killed / "f00/depth_alone.npy").stat().st_mtime_ns
    run(killed)
    assert (killed / "f00/depth_alone.npy").stat().st_mtime_ns == made
    files = [f"f{i:02d}/{name}.npy" for i in range(4) for name in ("depth", "depth_alone", "confirmed")]
    for file in [*files, "cloud.ply"]:
        assert (whole / file).read_bytes() == (killed / file).read_bytes()
    assert not list(killed.rglob(f"*{PARTIAL}"))


def test_masked_pixels_get_no_depth_and_no_points_and_another_mask_is_another_run(scan, geodiff, tmp_path):
    valid = np.arange(240)[None].repeat(180, 0) < 150
    (scan / "scan/masks").mkdir()
    for number in range(len(TRUE)):
        Image.fromarray(np.uint8(255) * valid).save(scan / f"scan/masks/f{number:02d}.png.png")
    answer = geodiff(*typed(scan))
    assert answer.code == 2 and "the mask of f00, f01, f02, f03 changed" in answer.err
    answer = geodiff(*typed(scan, "--overwrite", "--frames", "f01,f02", "--export", "nerfstudio"))
    assert answer.code in (0, 4), answer.err
    findings = json.loads((scan / "out/capture.json").read_text())["findings"]
    assert "4 of 4 frames have a mask in the capture" in str(findings)
    for name in ("f01", "f02"):
        depth, confidence = (np.load(scan / f"out/{name}/{file}.npy") for file in ("depth", "confidence"))
        assert (depth[~valid] == 0).all() and (confidence[~valid] == 0).all() and (depth[valid] > 0).all()
        assert not np.asarray(Image.open(scan / f"out/{name}/depth_mm.png"))[~valid].any()
    cloud = trimesh.load(scan / "out/cloud.ply").vertices
    camera = json.loads((scan / "out/f01/report.json").read_text())
    E, (fx, _, cx) = np.array(camera["T_world_from_camera"]), camera["K"][0]
    seen = (cloud - E[:3, 3]) @ E[:3, :3]
    column = fx * seen[:, 0] / seen[:, 2] + cx
    assert len(cloud) > 100 and np.mean(column < 155) > 0.95  # the other frame sees a little further
    splats = json.loads((scan / "out/nerfstudio/transforms.json").read_text())
    assert [frame["mask_path"] for frame in splats["frames"]] == ["masks/f01.png", "masks/f02.png"]
    white = tmp_path / "white.png"
    Image.new("L", (240, 180), 255).save(white)
    answer = geodiff(*typed(scan, "--mask", white))
    assert answer.code == 2 and "the mask of f00, f01, f02, f03 changed" in answer.err
    answer = geodiff(*typed(scan, "--mask", tmp_path))
    assert answer.code == 2 and "without masks for f00, f01, f02, f03" in answer.err
    answer = geodiff(*typed(scan, "--mask", white, "--overwrite"))
    assert answer.code in (0, 4) and (np.load(scan / "out/f01/depth.npy") > 0).all()


def test_holes_are_in_every_file_of_a_capture_and_another_threshold_is_another_run(scan, geodiff):
    both = ["--frames", "f01,f02", "--overwrite"]
    assert geodiff(*typed(scan, *both)).code in (0, 4)
    names = ("f01", "f02")
    files = ("depth", "confidence", "sigma")
    whole = {name: [np.load(scan / f"out/{name}/{file}.npy") for file in files] for name in names}
    most = np.median(np.stack([sigma for _, _, sigma in whole.values()]))
    thresholds = ["--min-confidence", 0.3, "--max-sigma", most]
    answer = geodiff(*typed(scan, *both, *thresholds, "--holes", "--export", "nerfstudio"))
    assert answer.code in (0, 4), answer.err
    for name in names:
        folder, (depth, confidence, sigma) = scan / "out" / name, whole[name]
        mask = (confidence >= 0.3) & (sigma <= most)
        assert 0.1 < mask.mean() < 0.9
        np.testing.assert_array_equal(np.load(folder / "depth.npy"), np.where(mask, depth, 0))
        for image in ("depth_mm.png", "sigma_mm.png"):
            assert not np.asarray(Image.open(folder / image))[~mask].any()
        units = np.asarray(Image.open(scan / f"out/nerfstudio/depths/{name}.png"))
        assert (units > 0).sum() > 100 and not units[~mask].any()
        report = json.loads((folder / "report.json").read_text())
        assert report["depth"]["median"] == pytest.approx(np.median(depth[mask]))
        points = len(trimesh.load(folder / "cloud.ply").vertices)
        assert 0.9 * mask.sum() < points == report["files"]["cloud_points"] <= mask.sum()
        assert (folder / "overview.png").stat().st_mtime_ns > (folder / "depth_alone.npy").stat().st_mtime_ns
    assert len(trimesh.load(scan / "out/cloud.ply").vertices) > 100
    shown = json.loads((scan / "out/capture.json").read_text())["frames"][1]
    assert shown["depth"] == report["depth"] and shown["files"] == report["files"]
    answer = geodiff(*typed(scan, "--min-confidence", 0.4, "--max-sigma", most, "--holes"))
    assert answer.code == 2 and "made with --min-confidence 0.3 instead of 0.4" in answer.err
    answer = geodiff(*typed(scan, "--holes"))
    assert answer.code == 2 and "--holes needs --min-confidence or --max-sigma" in answer.err
