"""Many pairs in one run: folders, lists and videos; overlap, resumption, failures, shards."""

import csv
import errno
import json
import os
import shutil
import signal
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.jobs import many, writing
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import find_pairs
from tests.cli.conftest import QUICK, call, never, report_of, write_pair

pytestmark = pytest.mark.end_to_end

COMMAND = ["depth", "left", "right", "--calib", "calib.txt", "--prior", "prior", "--out", "out", *QUICK]
DEPTHS = [Path("out", name, "depth.npy") for name in "abc"]


def write_folders(root: Path, pair, names) -> None:
    for side in ("left", "right"):
        (root / side).mkdir()
        for i, name in enumerate(names):
            image = np.roll(getattr(pair, side), i, axis=0)  # no two pairs alike
            Image.fromarray(image).save(root / side / f"{name}.png")


@pytest.fixture(scope="module")
def made(textured_plane, prior, tmp_path_factory):
    """A folder of three pairs, and of a run over them in ``out``; to be copied."""
    root, threads = tmp_path_factory.mktemp("many"), torch.get_num_threads()
    torch.set_num_threads(1)  # half of several cores add up to other last digits than all of them
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        write_pair(root, textured_plane)
        write_folders(root, textured_plane, "abc")
        shutil.copytree(prior, root / "prior")
        assert call([*COMMAND, "-q"]) == 0
    torch.set_num_threads(threads)
    return root


@pytest.fixture
def finished(made, tmp_path, monkeypatch):
    """A copy of it, which is also the working directory."""
    root = tmp_path / "work"
    shutil.copytree(made, root)
    monkeypatch.chdir(root)
    return root


@pytest.fixture
def fresh(finished):
    """The same without the results."""
    shutil.rmtree(finished / "out")
    return finished


def rows_of(out: str = "out"):
    with open(Path(out, "pairs.csv"), newline="") as file:
        return list(csv.DictReader(file))


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# Which pairs


def test_folders_go_by_name_else_by_order_in_which_numbers_count(tmp_path, textured_plane):
    write_folders(tmp_path, textured_plane, ["f10", "f1", "f2"])
    left, right = tmp_path / "left", tmp_path / "right"
    (left / "notes.md").write_text("no image")
    options = DepthOptions(left=left, right=right)
    reported = []
    assert [ref.name for ref in find_pairs(options, reported.append)] == ["f1", "f2", "f10"]
    assert reported == []
    for path in right.iterdir():
        path.rename(path.with_stem(f"{path.stem}_R"))
    names = [ref.right.name for ref in find_pairs(options, reported.append)]
    assert names == ["f1_R.png", "f2_R.png", "f10_R.png"]
    assert "by position: f1.png with f1_R.png to f10.png with f10_R.png." in reported[0]


def test_lists_by_comma_or_tab(tmp_path):
    listed = tmp_path / "pairs.txt"
    listed.write_text(
        "left_image,right_image,calib\n# a comment\n\none/im 0.png,one/im1.png,one/calib.txt\n"
        'two/im 0.png, two/im1.png\nthree/x.png,three/y.png\nthree/x.png,three/z.png\n"a #1, b.png",b#1.png\n'
    )
    refs = find_pairs(DepthOptions(left=listed))
    assert [ref.name for ref in refs] == ["one_im 0", "two_im 0", "three_x", "three_x-2", "a #1, b"]
    assert refs[0].calib == tmp_path / "one" / "calib.txt" and refs[1].calib is None
    assert refs[1].right == tmp_path / "two" / "im1.png" and refs[4].left.name == "a #1, b.png"
    listed.write_text("left.png\tright, too.png\n")  # a pair, also where its files are missing
    (ref,) = find_pairs(DepthOptions(left=listed))
    assert (ref.name, ref.right.name) == ("left", "right, too.png")


# Runs


def test_two_folders_give_what_single_runs_give(geodiff, finished):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    assert geodiff("depth", "left/b.png", "right/b.png", *COMMAND[3:7], *QUICK, "-q", "-o", "one").code == 0
    torch.set_num_threads(threads)
    np.testing.assert_array_equal(*(np.load(f"{name}/depth.npy") for name in ("out/b", "one")))
    assert [row["pair"] for row in rows_of()] == ["a", "b", "c"]
    assert sorted(os.listdir("out/b")) == sorted(os.listdir("one"))


@pytest.fixture
def beside_gpu(monkeypatch):
    """As on a GPU, processes write; takes what is called with every pair's place before it is written."""

    def let(before, writers=2):
        class Watched(many.WorkerProcesses):
            def call(self, function, *args):
                before(super().call, function, args[0])
                return super().call(function, *args)

        monkeypatch.setattr(many, "WorkerProcesses", Watched)
        monkeypatch.setattr(many, "available_cores", lambda: many.RESERVED_CORES + writers)

    monkeypatch.setattr(many, "leaves_cpu_free", lambda device: True)
    return let


def test_with_a_gpu_other_processes_write_the_same_files(geodiff, fresh, made, beside_gpu):
    calls = []
    beside_gpu(lambda call, function, place: calls.append(function.__name__))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    assert geodiff(*COMMAND, "-q").code == 0
    torch.set_num_threads(threads)
    assert calls == ["write_row"] * 3
    for name in "abc":
        here, there = (contents(Path(root, "out", name)) for root in (fresh, made))
        here, there = ({path.name: file for path, file in each.items()} for each in (here, there))
        reports = [json.loads(each.pop("report.json")) for each in (here, there)]
        assert here == there
        assert len({tuple(report.pop("seconds")) for report in reports}) == 1  # the same stages
        assert reports[0] == reports[1]
    assert [row["result"] for row in rows_of()] == ["done"] * 3


def test_a_process_that_writes_and_has_ended_ends_the_run_and_the_same_command_goes_on(
    geodiff, fresh, beside_gpu, monkeypatch
):
    def end(call, function, place):
        if place.path.name == "b":
            call(os._exit, 9)

    beside_gpu(end, writers=1)
    answer = geodiff(*COMMAND)
    assert answer.code == 2 and answer.err.count("geodiff: ") == 1
    assert "A worker process ended (exit code 9). Check that there is enough memory." in answer.err
    assert Path("out/a/report.json").exists() and not Path("out/b").exists()
    monkeypatch.setattr(many, "leaves_cpu_free", lambda device: False)
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "0 failed" in answer.out and "0 already done" not in answer.out


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no signal to a thread")
def test_ctrl_c_while_several_processes_write_leaves_whole_folders(geodiff, fresh, beside_gpu, monkeypatch):
    def interrupt(call, function, place):
        if place.path.name == "a":
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    beside_gpu(interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    answer = geodiff(*COMMAND)
    signal.signal(signal.SIGINT, before)
    assert answer.code == 130
    folders = [path for path in Path("out").iterdir() if path.is_dir()]
    assert Path("out/a") in folders and not list(fresh.rglob("*partial*"))
    for folder in folders:
        assert set(os.listdir(folder)) == set(report_of(folder)["files"]["names"])
    monkeypatch.setattr(many, "leaves_cpu_free", lambda device: False)
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "0 failed" in answer.out and f"{len(folders)} already done" in answer.out


@pytest.mark.parametrize(("writers", "started"), [(3, [3]), (0, [])])
def test_the_stages_start_the_given_number_of_writers(monkeypatch, writers, started):
    counts = []
    monkeypatch.setattr(many, "WorkerProcesses", lambda module, count: counts.append(count))
    many.Stages(DepthOptions(left=Path("left")), torch.device("cuda"), writers=writers)
    assert counts == started


def test_finished_pairs_are_skipped_and_overwrite_recomputes_them(geodiff, finished):
    made = [path.stat().st_mtime_ns for path in DEPTHS]
    for path in (finished / "out" / "b").iterdir():
        path.unlink()
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "1 done, 2 already done" in answer.out
    now = [path.stat().st_mtime_ns for path in DEPTHS]
    assert [a == b for a, b in zip(made, now, strict=True)] == [True, False, True]
    assert "3 done, 0 already done" in geodiff(*COMMAND, "--overwrite").out


def test_results_of_other_options_or_files_are_not_taken_for_these(geodiff, finished):
    (finished / "out" / "b" / "report.json").unlink()  # so that there is something to do
    before = contents(finished / "out")
    answer = geodiff(*COMMAND, "--seed", 1)
    assert answer.code == 2 and "a, made with --seed 0 instead of 1. Choose a different" in answer.err
    for changed in (Path("right", "a.png"), Path("calib.txt")):
        whole = changed.read_bytes()
        changed.write_bytes(whole + b"\n")
        answer = geodiff(*COMMAND)
        assert answer.code == 2 and answer.err.count("\n") == 1
        assert (
            f"options and files; got {Path('out', 'a')}, made before {changed} changed. Choose" in answer.err
        )
        changed.write_bytes(whole)
    assert before == contents(finished / "out")


def test_a_finished_pair_is_judged_with_strict(geodiff, finished):
    for name, status in (("a", "trusted"), ("b", "not trusted"), ("c", "trusted")):
        report = report_of(f"out/{name}")
        report["verdict"] |= {"status": status, "reasons": ["E is wrong."]}
        codes = ("depth.inverted-order", "verdict.not-trusted")
        report["findings"] = [{"code": code, "severity": "reason", "text": ""} for code in codes]
        Path("out", name, "report.json").write_text(json.dumps(report))
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "3 already done, 0 failed, 1 not trusted" in answer.out
    answer = geodiff(*COMMAND, "--strict")
    assert answer.code == 4 and "2 already done, 1 failed" in answer.out
    assert f"geodiff: b: The depth in {Path('out', 'b')} is not trusted: E is wrong." in answer.err
    assert [row["result"] for row in rows_of()] == ["kept", "failed", "kept"]
    assert {row["codes"] for row in rows_of()} == {"depth.inverted-order verdict.not-trusted"}


def test_a_broken_pair_and_a_defect_are_reported_and_the_rest_go_on(geodiff, fresh, monkeypatch):
    write = writing.write_pair

    def broken(folder, run):
        if folder.path.name == "a":
            raise KeyError("nobody thought of this")
        return write(folder, run)

    monkeypatch.setattr(writing, "write_pair", broken)
    image = fresh / "right" / "b.png"
    image.write_bytes(image.read_bytes()[:1000])
    answer = geodiff(*COMMAND)
    assert answer.code == 4 and "geodiff: b: RIGHT must be a whole image file" in answer.err
    assert answer.err.count("Traceback") == 1 and "nobody thought of this" in answer.err
    assert "1 done, 0 already done, 2 failed" in answer.out
    assert [row["result"] for row in rows_of()] == ["failed", "failed", "done"]
    assert not (fresh / "out" / "b").exists()


def test_an_error_of_all_pairs_is_reported_once_before_the_prior_is_loaded(geodiff, fresh, monkeypatch):
    monkeypatch.setattr(many, "prior_of_options", never)
    for path in (fresh / "right").iterdir():
        path.write_bytes(path.read_bytes()[:60])
    answer = geodiff(*COMMAND)
    assert answer.code == 2 and answer.err.count("geodiff: ") == 1, answer.err
    assert "All 3 pairs failed for this reason; nothing was computed." in answer.err
    assert not (fresh / "out").exists() and not list(fresh.glob(".out*"))


def test_a_list_with_a_calibration_each_and_maps_of_another_model(geodiff, fresh):
    Path("pairs.csv").write_text("left/a.png,right/a.png,calib.txt\nleft/b.png,right/b.png,calib.txt\n")
    Path("maps").mkdir()
    for name in "ab":
        np.save(f"maps/{name}.npy", np.add.outer(np.arange(24.0), np.ones(32)))
    words = "depth pairs.csv --out out --prior-map maps --device cpu --set guidance_steps=0".split()
    answer = geodiff(*words, "--json")
    assert answer.code == 0, answer.err
    assert [row["pair"] for row in json.loads(answer.out)] == ["a", "b"]
    assert report_of("out/a")["arguments"]["calib"] == ["calib.txt"]
    np.save("maps/b.npy", np.add.outer(np.ones(24), np.arange(32.0)))
    answer = geodiff(*words)  # a map that changed is another input
    assert answer.code == 2 and "b.npy changed" in answer.err


def test_a_full_disk_ends_the_run_and_keeps_what_is_finished(geodiff, fresh, monkeypatch):
    write = writing.write_pair

    def full(folder, run, **entries):
        if folder.path.name == "b":
            raise OSError(errno.EDQUOT, "Disk quota exceeded")
        return write(folder, run, **entries)

    monkeypatch.setattr(writing, "write_pair", full)
    answer = geodiff(*COMMAND)
    assert answer.code == 2 and answer.err.count("exceeded") == 1
    assert (
        "is full (Disk quota exceeded). Finished pairs are kept; run the same command again to resume"
        in answer.err
    )
    assert Path("out/a/report.json").exists() and not Path("out/b").exists()
    monkeypatch.setattr(writing, "write_pair", write)
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "0 failed" in answer.out and "0 already done" not in answer.out


# Shards


def test_shards_in_turn_give_what_the_whole_run_gives_and_merge_joins_their_tables(geodiff, fresh, made):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    assert geodiff(*COMMAND, "-q", "--shard", "0/2").code == 0
    answer = geodiff("merge", "out")
    assert answer.code == 2 and "Tables of shards are missing. Run --shard 1/2." in answer.err
    answer = geodiff(*COMMAND, "--shard", "1/2")
    torch.set_num_threads(threads)
    assert answer.code == 0 and "1 pair: 1 done" in answer.out
    answer = geodiff("merge", "out")
    assert answer.code == 0 and "3 pairs: 3 done" in answer.out
    assert [row["pair"] for row in rows_of()] == ["a", "b", "c"]
    for name in "abc":
        of_whole = np.load(made / "out" / name / "depth.npy")
        np.testing.assert_array_equal(np.load(f"out/{name}/depth.npy"), of_whole)
    answer = geodiff(*COMMAND)
    assert "0 done, 3 already done" in answer.out


def test_what_shards_cannot_do_is_reported(geodiff, fresh):
    assert "--shard needs many pairs" in geodiff("depth", "left/a.png", "right/a.png", "--shard", "0/2").err
    assert "--shard must be I/N" in geodiff(*COMMAND, "--shard", "2/2").err
    assert (
        "--temporal-smoothing needs all frames"
        in geodiff(*COMMAND, "--shard", "0/2", "--temporal-smoothing").err
    )
    assert "has no table of a shard" in geodiff("merge", "left").err


def test_without_ray_its_extra_is_named(geodiff, fresh, monkeypatch):
    for name in ("geodiff_plugin.jobs.cluster", "geodiff_plugin.jobs.ray"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    for name in ("ray", "pyarrow"):
        monkeypatch.setitem(sys.modules, name, None)
    for way in ("folders", "parquet"):
        answer = geodiff(*COMMAND, "--engine", "ray", "--format", way)
        assert answer.code == 2 and "pip install 'geodiff-plugin[ray]'" in answer.err, answer.err
    assert not (fresh / "out").exists()


# Videos


def write_video(path: str, frames) -> None:
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 10, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


@pytest.mark.parametrize("videos", [["l.avi", "r.avi"], ["rig.avi"]])
def test_the_video_of_a_rig(geodiff, fresh, textured_plane, videos):
    sides, words = (textured_plane.left, textured_plane.right), COMMAND[3:]
    if len(videos) == 1:  # both views side by side
        sides = (np.concatenate(sides, 1),)
        words = [*"--fx 60 --fy 60 --cx 31.5 --cy 23.5 --baseline 0.1".split(), *words[2:]]
    for name, image in zip(videos, sides, strict=True):
        write_video(name, [np.roll(image, i, axis=0) for i in range(2)])
    answer = geodiff("depth", *videos, *words)
    assert answer.code == 0, answer.err
    assert sorted(os.listdir("out")) == [many.JOURNAL, "000000", "000001", "pairs.csv"]
    report = report_of("out/000001")
    assert report["pair"]["frame"] == 1 and report["inputs"]["right_size"] == [64, 48]
    alone = [np.load(f"out/{name}/depth.npy") for name in ("000000", "000001")]
    images = [
        Path(f"out/{name}/{file}.png") for name in ("000000", "000001") for file in ("depth", "overview")
    ]
    before = [image.read_bytes() for image in images]
    for _ in range(2):  # again from what the frames gave alone
        answer = geodiff("depth", *videos, *words, "--temporal-smoothing")
        assert answer.code == 0 and "2 already done" in answer.out, answer.err
    with open("out/pairs.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for name, depth in zip(("000000", "000001"), alone, strict=True):
        assert np.array_equal(np.load(f"out/{name}/depth_alone.npy"), depth)
        smoothed, confirmed = (np.load(f"out/{name}/{file}.npy") for file in ("depth", "confirmed"))
        report = report_of(f"out/{name}")
        assert report["temporal_smoothing"]["scene"] == 0
        of_alone = report["temporal_smoothing"]["alone"]["depth"]
        for entry, of_map in ((of_alone, depth), (report["depth"], smoothed)):
            assert entry["median_m"] == pytest.approx(float(np.median(of_map)))
        row = next(row for row in rows if row["pair"] == name)
        assert [float(row[f"{each}_m"]) for each in ("near", "median", "far")] == [
            pytest.approx(report["depth"][f"{each}_m"]) for each in ("min", "median", "max")
        ]
        assert confirmed.mean() > 0.5 and 0 < np.abs(np.log(smoothed / depth)).max() < 0.1
    assert all(image.read_bytes() != each for image, each in zip(images, before, strict=True))
    answer = geodiff("depth", *videos, *words, "--overwrite")  # nothing of --temporal-smoothing is left
    assert answer.code == 0, answer.err
    for name in ("*_alone.npy", "sigma*", "confidence.png"):
        assert not list(Path("out").glob(f"*/{name}"))
    answer = geodiff("depth", *videos, *words, "--export", "colmap", "--overwrite")
    assert answer.code == 2 and "--export colmap does not support videos" in answer.err
