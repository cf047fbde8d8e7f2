"""Many pairs in one run: folders, lists and videos; overlap, resumption, failures, several processes."""

from __future__ import annotations

import csv
import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli import many
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.cli.pairs import assumption, find_pairs
from geodiff_plugin.formats.video import VideoReader, both_halves, count_frames
from tests.cli.conftest import call, write_pair

#: One update of one step: for tests of everything but the depth.
QUICK = ["--steps", "1", "--preset", "paper", "--device", "cpu"]
COMMAND = ["depth", "left", "right", "--calib", "calib.txt", "--prior", "prior", "--out", "out", *QUICK]


def write_folders(root: Path, pair, names) -> None:
    for side in ("left", "right"):
        (root / side).mkdir()
        for i, name in enumerate(names):
            image = np.roll(getattr(pair, side), i, axis=0)  # no two pairs alike
            Image.fromarray(image).save(root / side / f"{name}.png")


@pytest.fixture(scope="module")
def made(textured_plane, prior, tmp_path_factory):
    """A folder of three pairs, and of a run over them in ``out`` and ``answer.txt``; to be copied."""
    root = tmp_path_factory.mktemp("many")
    threads = torch.get_num_threads()
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


def rows_of(out: Path):
    with open(out / "pairs.csv", newline="") as file:
        return list(csv.DictReader(file))


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def report_of(name: str) -> dict:
    return json.loads(Path("out", name, "report.json").read_text())


def cut(path: Path) -> bytes:
    """Damage an image; what it held."""
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    return whole


def never(*_, **__):
    raise AssertionError("weights were loaded before the input was checked")


# Which pairs


def names_of(left, right=None):
    return [ref.name for ref in find_pairs(DepthOptions(left=Path(left), right=right))]


def test_folders_go_by_name_else_by_order_in_which_numbers_count(tmp_path, textured_plane):
    write_folders(tmp_path, textured_plane, ["f10", "f1", "f2"])
    left, right = tmp_path / "left", tmp_path / "right"
    (left / "notes.md").write_text("no picture")
    options = DepthOptions(left=left, right=right)
    assert names_of(left, right) == ["f1", "f2", "f10"] and assumption(find_pairs(options), options) is None
    for path in right.iterdir():
        path.rename(path.with_stem(f"{path.stem}_R"))
    refs = find_pairs(options)
    assert [ref.right.name for ref in refs] == ["f1_R.png", "f2_R.png", "f10_R.png"]
    said = assumption(refs, options)
    assert "f1.png with f1_R.png, and so on to f10.png with f10_R.png" in said
    (right / "f2_R.png").rename(right / "f2.png")
    (left / "f1.png").unlink()
    with pytest.raises(InputError, match="f10 has no partner"):
        names_of(left, right)


def test_lists_by_comma_tab_or_blank(tmp_path):
    listed = tmp_path / "pairs.txt"
    listed.write_text(
        "left,right,calib\n# a comment\n\none/im 0.png,one/im1.png,one/calib.txt\n"
        "two/im 0.png\ttwo/im1.png\nthree/x.png three/y.png\nthree/x.png three/z.png\n"
    )
    refs = find_pairs(DepthOptions(left=listed))
    assert [ref.name for ref in refs] == ["one_im 0", "two_im 0", "three_x", "three_x-2"]
    assert refs[0].calib == tmp_path / "one" / "calib.txt" and refs[1].calib is None
    assert refs[2].right == tmp_path / "three" / "y.png"


@pytest.mark.parametrize(
    ("heading", "names"),
    [
        ("left_image,right_image,calib", ["a"]),
        ("Left\tRight", ["a"]),
        ("left.png,right.png", ["left", "a"]),  # a pair, also where its files are missing
        ("left/0.png,right/0.png", ["0", "a"]),
        ("leftmost,right", ["leftmost", "a"]),  # a file of that name is there
        ("image,right", ["image", "a"]),
    ],
)
def test_a_heading_begins_with_left_and_names_no_file(tmp_path, heading, names):
    (tmp_path / "leftmost").touch()
    (tmp_path / "pairs.csv").write_text(f"{heading}\na.png,b.png\n")
    assert names_of(tmp_path / "pairs.csv") == names


@pytest.mark.parametrize(
    ("line", "cells"),
    [
        ("le, ft.png\tri, ght.png", ["le, ft.png", "ri, ght.png"]),  # tabs come first
        ("a.png b.png\t#second, third", ["a.png", "b.png"]),
        ("left#1.png,right#1.png", ["left#1.png", "right#1.png"]),
        ('"left #1.png","right #1.png" # quoted', ["left #1.png", "right #1.png"]),
    ],
)
def test_commas_in_names_and_comments_behind_a_line(tmp_path, line, cells):
    listed = tmp_path / "pairs.tsv"
    listed.write_text(f"{line}\n")
    (ref,) = find_pairs(DepthOptions(left=listed))
    assert [ref.left, ref.right, ref.calib] == [*(tmp_path / cell for cell in cells), None]


@pytest.mark.parametrize(
    ("text", "told"),
    [("\n", "with a pair a line"), ("a.png\n", "line 1 of"), ("a.png,b.png\na.png,b.png,c,d\n", "line 2 of")],
)
def test_lists_that_are_none(tmp_path, text, told):
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(InputError, match=told):
        names_of(tmp_path / "pairs.csv")


# Runs


def test_two_folders_give_what_single_runs_give(geodiff, finished):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    assert (
        geodiff("depth", "left/b.png", "right/b.png", *COMMAND[3:7], *QUICK, "-q", "-o", "single").code == 0
    )
    torch.set_num_threads(threads)
    both = [np.load(f"{name}/depth.npy") for name in ("out/b", "single")]
    np.testing.assert_array_equal(*both)
    assert [row["pair"] for row in rows_of(Path("out"))] == ["a", "b", "c"]
    assert sorted(os.listdir("out/b")) == sorted(os.listdir("single"))


def test_warnings_are_those_of_every_pair_and_said_once(geodiff, fresh):
    text = (fresh / "calib.txt").read_text().splitlines()
    text[1] = text[1].replace(" 0 ", " 0 1", 1)  # cam1 contradicts doffs
    (fresh / "calib.txt").write_text("\n".join(text))
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and answer.err.count("for the right image") == 1, answer.err
    assert "3 pairs: 3 done, 0 there already, 0 failed" in answer.out and "3/3" in answer.err
    assert all("for the right image" in report_of(name)["warnings"][0] for name in "abc")


def test_finished_pairs_are_skipped_and_overwrite_does_them_anew(geodiff, finished):
    made = {name: (finished / "out" / name / "depth.npy").stat().st_mtime_ns for name in "abc"}
    for path in (finished / "out" / "b").iterdir():
        path.unlink()
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "1 done, 2 there already" in answer.out
    now = {name: (finished / "out" / name / "depth.npy").stat().st_mtime_ns for name in "abc"}
    assert {name for name in "abc" if now[name] != made[name]} == {"b"}
    assert "3 done, 0 there already" in geodiff(*COMMAND, "--overwrite").out


def test_results_of_other_options_or_files_are_not_taken_for_these(geodiff, finished, textured_plane):
    (finished / "out" / "b" / "report.json").unlink()  # so that there is something to do
    before = contents(finished / "out")
    answer = geodiff(*COMMAND, "--seed", 1)
    assert answer.code == 2 and "a, made with --seed 0 instead of 1. Name another" in answer.err
    assert before == contents(finished / "out") and answer.err.count("\n") == 1
    calib = finished / "calib.txt"
    for changed in (Path("right", "a.png"), Path("calib.txt")):
        whole = changed.read_bytes()
        changed.write_bytes(whole + b"\n")
        answer = geodiff(*COMMAND)
        assert answer.code == 2 and answer.err.count("\n") == 1
        assert f"same files; got {Path('out', 'a')}, made before {changed} changed. Name" in answer.err
        assert before == contents(finished / "out")
        changed.write_bytes(whole)
    calib.write_text(calib.read_text().replace("baseline=1", "baseline=2"))
    assert "3 done, 0 there already" in geodiff(*COMMAND, "--overwrite").out


def test_a_finished_pair_is_judged_with_strict(geodiff, finished):
    for name, status in (("a", "trusted"), ("b", "not trusted"), ("c", "trusted")):
        report = report_of(name)
        report["verdict"] |= {"status": status, "reasons": ["E is wrong."]}
        Path("out", name, "report.json").write_text(json.dumps(report))
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "3 there already, 0 failed, 1 not trusted" in answer.out
    answer = geodiff(*COMMAND, "--strict")
    assert answer.code == 4 and "2 there already, 1 failed" in answer.out
    assert f"geodiff: b: The depth in {Path('out', 'b')} is not trusted: E is wrong." in answer.err
    assert [row["result"] for row in rows_of(Path("out"))] == ["there", "failed", "there"]


def test_a_broken_pair_and_a_defect_are_reported_and_the_rest_go_on(geodiff, fresh, monkeypatch):
    write = many.write_result

    def broken(options, *rest):
        if options.out.name == "a":
            raise KeyError("nobody thought of this")
        return write(options, *rest)

    monkeypatch.setattr(many, "write_result", broken)
    cut(fresh / "right" / "b.png")
    answer = geodiff(*COMMAND)
    assert answer.code == 4 and "geodiff: b: RIGHT must be a whole image file" in answer.err
    assert answer.err.count("Traceback") == 1 and "nobody thought of this" in answer.err
    assert "1 done, 0 there already, 2 failed" in answer.out
    assert [row["result"] for row in rows_of(Path("out"))] == ["failed", "failed", "done"]
    assert not (fresh / "out" / "b").exists()


@pytest.mark.parametrize("fault", ["calibration", "size", "cut off"])
def test_what_fails_all_pairs_is_said_once_before_the_prior_is_loaded(geodiff, fresh, monkeypatch, fault):
    monkeypatch.setattr(many, "load_guided_prior", never)
    calib = fresh / "calib.txt"
    if fault == "calibration":
        calib.write_text("no calibration")
    elif fault == "size":
        calib.write_text(calib.read_text().replace("width=", "width=9"))
    else:
        for path in (fresh / "right").iterdir():
            cut(path)
    answer = geodiff(*COMMAND)
    assert answer.code == 2 and answer.err.count("geodiff: ") == 1, answer.err
    assert "The same holds for all 3 pairs; nothing was computed." in answer.err
    assert not (fresh / "out").exists() and not list(fresh.glob(".out*"))


def test_pairs_that_fail_for_several_reasons_are_reported_each(geodiff, fresh):
    for path in ("left/a.png", "right/b.png", "right/c.png"):
        Path(path).write_bytes(b"no image")
    answer = geodiff(*COMMAND)
    assert answer.code == 4 and answer.err.count("geodiff: ") == 3, answer.err
    assert [row["result"] for row in rows_of(Path("out"))] == ["failed"] * 3


def test_a_list_with_a_calibration_each(geodiff, fresh):
    Path("pairs.csv").write_text("left/a.png,right/a.png,calib.txt\nleft/b.png,right/b.png,calib.txt\n")
    answer = geodiff("depth", "pairs.csv", *COMMAND[5:], "--json")
    assert answer.code == 0, answer.err
    assert [row["pair"] for row in json.loads(answer.out)] == ["a", "b"]
    assert report_of("a")["arguments"]["calib"] == ["calib.txt"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--show", "auto"], "--show must be left out with many pairs"),
        (["--view", "x.png"], "--view must be left out"),
        (["--steps", 0], "--steps"),
        (["--warm-start"], "--warm-start must be given with the default preset"),
        (["--calib", "gone.txt"], "gone.txt"),
        (["--out", "one"], "holds the result of one pair"),
        (["--out", "mine", "--overwrite"], "pairs.csv, which is not the table of an earlier run"),
        (["--out", "odd", "--overwrite"], "pairs.csv, which is a folder"),
        (["--out", "calib.txt"], "--out must be a folder"),
    ],
)
def test_what_is_refused_at_once(geodiff, fresh, monkeypatch, words, told):
    monkeypatch.setattr(many, "load_guided_prior", never)
    for path, text in (
        ("one/report.json", "{}"),
        ("mine/pairs.csv", "left,right\n"),
        ("odd/pairs.csv/x", ""),
    ):
        Path(path).parent.mkdir(parents=True)
        Path(path).write_text(text)
    before = contents(fresh)
    answer = geodiff(*COMMAND, *words)
    assert answer.code == 2 and told in answer.err and contents(fresh) == before


def test_the_list_itself_is_not_replaced_by_the_table(geodiff, fresh):
    Path("out").mkdir()
    Path("out/pairs.csv").write_text("../left/a.png,../right/a.png\n")
    Path("list.csv").symlink_to("out/pairs.csv")
    answer = geodiff("depth", "list.csv", *COMMAND[3:])
    assert answer.code == 2 and "not the table of an earlier run" in answer.err


def test_a_folder_that_takes_no_file_is_refused_before_the_work(geodiff, fresh, monkeypatch):
    def no_folder(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(many, "load_guided_prior", never)
    monkeypatch.setattr("pathlib.Path.mkdir", no_folder)
    answer = geodiff(*COMMAND, "--out", "deep/out")
    assert answer.code == 2 and "can be written to; got deep" in answer.err
    assert "(Permission denied)" in answer.err and not (fresh / "deep").exists()


def test_a_table_that_cannot_be_written_in_the_end_is_shown(geodiff, finished, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(many, "atomic_path", full)
    answer = geodiff(*COMMAND)
    assert answer.code == 0 and "3 pairs: 0 done, 3 there already" in answer.out
    told = f"geodiff: {Path('out', 'pairs.csv')} could not be written (No space left on device)."
    assert answer.err.splitlines()[-1] == told


@pytest.mark.parametrize("when", ["writing", "taking the folder"])
def test_a_full_disk_ends_the_run_and_keeps_what_is_finished(geodiff, fresh, monkeypatch, when):
    write, take = many.write_result, many.out_folder_of

    def full(function):
        def fails(options, *rest):
            if options.out.name == "b":
                raise OSError(errno.ENOSPC, "No space left on device")
            return function(options, *rest)

        return fails

    before = set(fresh.iterdir())
    if when == "writing":
        monkeypatch.setattr(many, "write_result", full(write))
    else:
        usage = shutil.disk_usage
        monkeypatch.setattr(many, "out_folder_of", take)
        monkeypatch.setattr(
            "geodiff_plugin.formats.out.shutil.disk_usage",
            lambda path: usage(path)._replace(free=10**9 if not Path("out/a").exists() else 1000),
        )
    answer = geodiff(*COMMAND)
    if when == "writing":
        assert answer.code == 2 and "is full (No space left on device). Finished pairs stay" in answer.err
        assert (fresh / "out" / "a" / "report.json").exists() and not (fresh / "out" / "b").exists()
    assert answer.err.count("No space left") <= 1, answer.err
    assert set(fresh.iterdir()) - before == {fresh / "out"}
    monkeypatch.undo()
    monkeypatch.chdir(fresh)
    assert geodiff(*COMMAND).code == 0


def test_warm_start_goes_from_frame_to_frame(geodiff, fresh):
    """And begins anew behind a pair that has no result of this run."""
    words = [*COMMAND[:9], "--steps", 4, "--device", "cpu", "--warm-start", "--knob", "corrections=4", "-q"]
    assert geodiff(*words).code == 0
    reports = [report_of(name) for name in "abc"]
    assert [report["pair"]["began_from"] for report in reports] == [None, "a", "b"]
    assert [len(report["history"]) for report in reports] == [4, 3, 3]
    for name in "ac":
        shutil.rmtree(fresh / "out" / name)
    assert geodiff(*words).code == 0 and report_of("c")["pair"]["began_from"] is None, "b was there already"
    whole = cut(fresh / "right" / "b.png")  # fails before the guided call
    assert geodiff(*words, "--overwrite").code == 4 and report_of("c")["pair"]["began_from"] is None
    (fresh / "right" / "b.png").write_bytes(whole)
    answer = geodiff("depth", "left/a.png", "right/a.png", *COMMAND[3:], "--warm-start")
    assert answer.code == 2 and "--warm-start must be given with many pairs" in answer.err
    answer = geodiff("depth", "left", "right", "--out", "new")
    assert answer.code == 2 and "calibration must be given" in answer.err and not (fresh / "new").exists()


# Videos


def write_video(path: Path, frames) -> None:
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


@pytest.fixture
def views(textured_plane):
    return [[np.roll(getattr(textured_plane, s), i, axis=0) for i in range(2)] for s in ("left", "right")]


def test_frames_are_read_in_any_order(tmp_path, views):
    write_video(tmp_path / "left.avi", views[0] * 2)
    assert count_frames(tmp_path / "left.avi") == 4
    with VideoReader(tmp_path / "left.avi") as video:
        for frame in (0, 3, 2):
            read = video.read(frame)
            assert read.shape == views[0][0].shape and read.dtype == np.float32
            assert np.abs(read - views[0][frame % 2] / 255).mean() < 0.05
        with pytest.raises(OSError, match="frame 4"):
            video.read(4)
    left, right = both_halves(np.arange(24, dtype=np.float32).reshape(2, 4, 3))
    assert left.shape == right.shape == (2, 2, 3) and right[0, 0, 0] == 6
    with pytest.raises(InputError, match="even width"):
        both_halves(np.zeros((2, 3, 3), np.float32))


@pytest.mark.parametrize("beside", [False, True])
def test_the_video_of_a_rig(geodiff, fresh, textured_plane, views, beside):
    words, K = COMMAND[3:], textured_plane.K
    if beside:
        write_video(fresh / "rig.avi", [np.concatenate(both, 1) for both in zip(*views, strict=True)])
        videos = ["rig.avi"]
        numbers = {"--fx": K[0, 0], "--fy": K[1, 1], "--cx": K[0, 2], "--cy": K[1, 2], "--baseline": 0.1}
        words = [*words[2:], *(word for name, value in numbers.items() for word in (name, float(value)))]
    else:
        videos = ["l.avi", "r.avi"]
        for name, frames in zip(videos, views, strict=True):
            write_video(fresh / name, frames)
    answer = geodiff("depth", *videos, *words)
    assert answer.code == 0, answer.err
    assert sorted(os.listdir("out")) == [many.JOURNAL, "000000", "000001", "pairs.csv"]
    report = report_of("000001")
    assert report["pair"]["frame"] == 1 and report["inputs"]["right_size"] == [64, 48]
    answer = geodiff("video", "out/000000", "out/000001", "--photographs", "--out", "depth.gif")
    assert answer.code == 0, answer.err
    answer = geodiff("depth", *videos, *words, "--export", "colmap", "--overwrite")
    assert answer.code == 2 and "--export colmap must be left out with a video" in answer.err


# Several processes


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["torchrun", "two terminals"])
def test_two_processes_share_the_pairs(fresh, launcher):
    torchrun = [*("torch.distributed.run", "--nproc-per-node", "2", "--rdzv-backend", "c10d")]
    torchrun += ["--rdzv-endpoint", "localhost:0", "-m"]
    words = [sys.executable, "-m", *(torchrun if launcher == "torchrun" else ()), "geodiff_plugin", *COMMAND]
    package = Path(__file__).resolve().parents[2]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(package)}
    started = [
        subprocess.Popen(words, cwd=fresh, env=environment, text=True, stdout=-1, stderr=-1)
        for _ in range(1 if launcher == "torchrun" else 2)
    ]
    for process in started:
        out, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        assert "3 pairs: " in out and ", 0 failed" in out and out.count("pairs:") == 1
    assert {row["result"] for row in rows_of(Path("out"))} <= {"done", "there"}
