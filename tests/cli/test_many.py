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
from geodiff_plugin.cli.many import JOURNAL, _as_typed
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.cli.pairs import assumption, find_pairs
from geodiff_plugin.formats.video import VideoReader, both_halves, count_frames

#: One update of one step: for tests of everything but the depth.
QUICK = ["--steps", 1, "--preset", "paper", "--device", "cpu"]


def write_folders(root: Path, pair, names) -> None:
    for side in ("left", "right"):
        (root / side).mkdir()
        for i, name in enumerate(names):
            image = np.roll(getattr(pair, side), i, axis=0)  # no two pairs alike
            Image.fromarray(image).save(root / side / f"{name}.png")


@pytest.fixture
def folders(pair_files, textured_plane, prior):
    """Three pairs in two folders, and the command for them."""
    write_folders(pair_files.folder, textured_plane, ["a", "b", "c"])
    command = ["depth", "left", "right", "--calib", pair_files.calib, "--prior", prior, "--out", "out"]
    return pair_files.folder, [*command, *QUICK]


@pytest.fixture
def one_thread():
    """torch with one thread, and its number put back."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


# Which pairs


def names_of(left, right=None):
    return [ref.name for ref in find_pairs(DepthOptions(left=Path(left), right=right))]


def test_folders_go_by_name_else_by_order(tmp_path, textured_plane):
    write_folders(tmp_path, textured_plane, ["b", "a"])
    left, right = tmp_path / "left", tmp_path / "right"
    (left / "notes.md").write_text("no picture")
    assert names_of(left, right) == ["a", "b"]
    for path in right.iterdir():
        path.rename(path.with_stem(f"{path.stem}_R"))
    refs = find_pairs(DepthOptions(left=left, right=right))
    assert [(ref.left.name, ref.right.name) for ref in refs] == [("a.png", "a_R.png"), ("b.png", "b_R.png")]


def test_numbers_in_names_are_sorted_as_numbers(tmp_path, textured_plane):
    write_folders(tmp_path, textured_plane, ["f10", "f1", "f2"])
    left, right = tmp_path / "left", tmp_path / "right"
    assert names_of(left, right) == ["f1", "f2", "f10"]
    for path in right.iterdir():
        path.rename(path.with_stem(f"R{path.stem}"))
    refs = find_pairs(DepthOptions(left=left, right=right))
    assert [ref.left.stem for ref in refs] == ["f1", "f2", "f10"]
    assert [ref.right.stem for ref in refs] == ["Rf1", "Rf2", "Rf10"]


def test_folders_that_share_no_name_are_said_to_go_by_order(tmp_path, textured_plane):
    write_folders(tmp_path, textured_plane, ["10", "20", "30"])
    arguments = DepthOptions(left=tmp_path / "left", right=tmp_path / "right")
    assert assumption(find_pairs(arguments), arguments) is None
    for path in arguments.right.iterdir():
        path.rename(path.with_stem(f"{int(path.stem) + 3}"))
    said = assumption(find_pairs(arguments), arguments)
    assert "10.png with 13.png, and so on to 30.png with 33.png" in said


@pytest.mark.parametrize("missing", ["left", "right"])
def test_a_view_without_partner_is_named(tmp_path, textured_plane, missing):
    write_folders(tmp_path, textured_plane, ["a", "b", "c"])
    (tmp_path / missing / "b.png").unlink()
    with pytest.raises(InputError, match="b has no partner"):
        names_of(tmp_path / "left", tmp_path / "right")


def test_lists_by_comma_tab_or_blank(tmp_path):
    listed = tmp_path / "pairs.txt"
    listed.write_text(
        "left,right,calib\n# a comment\n\none/im 0.png,one/im1.png,one/calib.txt\n"
        "two/im 0.png\ttwo/im1.png\nthree/x.png three/y.png\n"
    )
    refs = find_pairs(DepthOptions(left=listed))
    assert [ref.name for ref in refs] == ["one_im 0", "two_im 0", "three_x"]
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
        ("a.png,b.png # second", ["a.png", "b.png"]),
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


def test_one_left_view_with_two_right_ones_has_two_names(tmp_path):
    listed = tmp_path / "pairs.csv"
    listed.write_text("a.png,b.png\na.png,c.png\n")
    assert names_of(listed) == ["a", "a-2"]


@pytest.mark.parametrize(
    ("text", "told"),
    [("", "with a pair a line"), ("a.png\n", "line 1 of"), ("a.png,b.png\na.png,b.png,c,d\n", "line 2 of")],
)
def test_lists_that_are_none(tmp_path, text, told):
    (tmp_path / "pairs.csv").write_text(text or "\n")
    with pytest.raises(InputError, match=told):
        names_of(tmp_path / "pairs.csv")


# Runs


def rows_of(out: Path):
    with open(out / "pairs.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.usefixtures("one_thread")  # half of several cores add up to other last digits than all of them
def test_two_folders_give_what_single_runs_give(geodiff, folders):
    root, command = folders
    answer = geodiff(*command)
    assert answer.code == 0, answer.err
    assert "3 pairs: 3 done, 0 there already, 0 failed" in answer.out and "3/3" in answer.err
    single = [*command[:1], "left/b.png", "right/b.png", *command[3:]]
    single[single.index("out")] = "single"
    assert geodiff(*single, "-q").code == 0
    many, one = (np.load(root / name / "depth.npy") for name in ("out/b", "single"))
    np.testing.assert_array_equal(many, one)
    assert [row["pair"] for row in rows_of(root / "out")] == ["a", "b", "c"]
    assert {path.name for path in (root / "out" / "b").iterdir()} == {
        path.name for path in (root / "single").iterdir()
    }


def test_warnings_about_the_cameras_are_those_of_every_pair(geodiff, folders):
    root, command = folders
    calib = root / "calib.txt"
    text = calib.read_text().splitlines()
    text[1] = text[1].replace(" 0 ", " 0 1", 1)  # cam1 contradicts doffs
    calib.write_text("\n".join(text))
    answer = geodiff(*command)
    assert answer.code == 0 and answer.err.count("for the right image") == 1, answer.err
    for name in "abc":
        (warning,) = json.loads((root / "out" / name / "report.json").read_text())["warnings"][:1]
        assert "for the right image" in warning


def test_finished_pairs_are_skipped_and_overwrite_does_them_anew(geodiff, folders):
    root, command = folders
    assert geodiff(*command, "-q").code == 0
    made = {name: (root / "out" / name / "depth.npy").stat().st_mtime_ns for name in "abc"}
    for path in (root / "out" / "b").iterdir():
        path.unlink()
    answer = geodiff(*command)
    assert answer.code == 0 and "1 done, 2 there already" in answer.out
    now = {name: (root / "out" / name / "depth.npy").stat().st_mtime_ns for name in "abc"}
    assert {name for name in "abc" if now[name] != made[name]} == {"b"}
    answer = geodiff(*command, "--overwrite")
    assert answer.code == 0 and "3 done, 0 there already" in answer.out


def test_results_of_other_options_are_not_taken_for_these(geodiff, folders):
    root, command = folders
    assert geodiff(*command, "-q").code == 0
    before = {path: path.read_bytes() for path in (root / "out").rglob("*") if path.is_file()}
    (root / "out" / "b" / "report.json").unlink()  # so that there is something to do
    del before[root / "out" / "b" / "report.json"]
    answer = geodiff(*command, "--seed", 1)
    assert answer.code == 2 and answer.err.count("--out must be") == 1
    assert "made with --seed 0 and now asked for with --seed 1" in answer.err and "--overwrite" in answer.err
    assert before == {path: path.read_bytes() for path in (root / "out").rglob("*") if path.is_file()}


def test_results_of_files_that_changed_are_not_taken_for_these(geodiff, folders, textured_plane, pair_files):
    root, command = folders
    assert geodiff(*command, "-q").code == 0
    before = {path: path.read_bytes() for path in (root / "out").rglob("*") if path.is_file()}
    Image.fromarray(textured_plane.right).save(root / "right" / "b.png")
    answer = geodiff(*command)
    assert answer.code == 2 and answer.err.count("\n") == 1, answer.err
    changed = Path("right", "b.png")
    assert f"same files; got {Path('out', 'b')}, made before {changed} changed. Name another" in answer.err
    assert before == {path: path.read_bytes() for path in (root / "out").rglob("*") if path.is_file()}
    for path in (root / "out" / "b").iterdir():
        path.unlink()
    answer = geodiff(*command)
    assert answer.code == 0 and "1 done, 2 there already" in answer.out
    pair_files.write_calibration(textured_plane.K, 0.25, (64, 48))
    answer = geodiff(*command)
    assert answer.code == 2 and f"{Path('out', 'a')}, made before {pair_files.calib} changed" in answer.err
    answer = geodiff(*command, "--overwrite")
    assert answer.code == 0 and "3 done, 0 there already" in answer.out


def test_a_finished_pair_is_judged_with_strict(geodiff, folders):
    root, command = folders
    assert geodiff(*command, "-q").code == 0
    for name, status in (("a", "trusted"), ("b", "not trusted"), ("c", "trusted")):
        path = root / "out" / name / "report.json"
        report = json.loads(path.read_text())
        report["verdict"] |= {"status": status, "reasons": ["E is wrong."]}
        path.write_text(json.dumps(report))
    answer = geodiff(*command)
    assert answer.code == 0 and "3 there already, 0 failed, 1 not trusted" in answer.out
    answer = geodiff(*command, "--strict")
    assert answer.code == 4 and "2 there already, 1 failed" in answer.out
    said = f"b: The depth in {Path('out', 'b')} is not trusted: E is wrong."
    assert f"geodiff: {said}" in answer.err
    assert [row["result"] for row in rows_of(root / "out")] == ["there", "failed", "there"]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("right", "b.png", "with RIGHT b.png"),
        ("k_right", None, "without --K-right"),
        ("steps", None, "without --steps"),
        ("warm_start", True, "with --warm-start"),
        ("seed", 0, "with --seed 0"),
    ],
)
def test_options_are_told_as_they_are_typed(name, value, said):
    assert _as_typed(name, value) == said


def test_a_broken_pair_is_reported_and_the_rest_go_on(geodiff, folders):
    root, command = folders
    data = (root / "right" / "b.png").read_bytes()
    (root / "right" / "b.png").write_bytes(data[: len(data) // 2])
    answer = geodiff(*command)
    assert answer.code == 4
    assert "geodiff: b: RIGHT must be a whole image file" in answer.err and "Traceback" not in answer.err
    assert "2 done, 0 there already, 1 failed" in answer.out
    assert [row["result"] for row in rows_of(root / "out")] == ["done", "failed", "done"]
    assert not (root / "out" / "b").exists()


@pytest.mark.parametrize("fault", ["calibration", "size", "cut off"])
def test_what_fails_all_pairs_is_said_once_before_the_prior_is_loaded(geodiff, folders, monkeypatch, fault):
    root, command = folders
    monkeypatch.setattr("geodiff_plugin.cli.many.load_guided_prior", never)
    calib = root / "calib.txt"
    if fault == "calibration":
        calib.write_text("no calibration")
    elif fault == "size":
        calib.write_text(calib.read_text().replace("width=", "width=9"))
    else:
        for path in (root / "right").iterdir():
            path.write_bytes(path.read_bytes()[:200])
    answer = geodiff(*command)
    assert answer.code == 2 and answer.err.count("geodiff: ") == 1, answer.err
    assert "The same holds for all 3 pairs; nothing was computed." in answer.err
    assert not (root / "out").exists() and not list(root.glob(".out*"))


def test_pairs_that_fail_for_several_reasons_are_reported_each(geodiff, folders):
    root, command = folders
    (root / "left" / "a.png").write_bytes(b"no image")
    for name in "bc":
        (root / "right" / f"{name}.png").write_bytes(b"no image")
    answer = geodiff(*command)
    assert answer.code == 4 and answer.err.count("geodiff: ") == 3, answer.err
    assert [row["result"] for row in rows_of(root / "out")] == ["failed"] * 3


def test_a_defect_in_one_pair_keeps_its_traceback(geodiff, folders, monkeypatch):
    from geodiff_plugin.cli import many

    write = many.write_result

    def broken(options, *rest):
        if options.out.name == "a":
            raise KeyError("nobody thought of this")
        return write(options, *rest)

    monkeypatch.setattr(many, "write_result", broken)
    answer = geodiff(*folders[1])
    assert answer.code == 4 and "Traceback" in answer.err and "nobody thought of this" in answer.err
    assert "2 done" in answer.out


def test_a_list_with_a_calibration_each(geodiff, folders):
    root, command = folders
    (root / "pairs.csv").write_text("left/a.png,right/a.png,calib.txt\nleft/b.png,right/b.png,calib.txt\n")
    without = [word for word in command[3:] if word not in ("--calib", root / "calib.txt")]
    answer = geodiff("depth", "pairs.csv", *without, "--json")
    assert answer.code == 0, answer.err
    assert [row["pair"] for row in json.loads(answer.out)] == ["a", "b"]
    report = json.loads((root / "out" / "a" / "report.json").read_text())
    assert report["arguments"]["calib"] == ["calib.txt"]


@pytest.mark.parametrize(
    ("option", "told"),
    [
        (["--show", "auto"], "--show must be left out with many pairs"),
        (["--view", "x.png"], "--view must be left out"),
        (["--steps", 0], "--steps"),
        (["--warm-start"], "--warm-start must be given with the default preset"),
        (["--calib", "gone.txt"], "gone.txt"),
        (["--out", "one"], "holds the result of one pair"),
    ],
)
def test_options_of_one_pair_are_refused_at_once(geodiff, folders, option, told):
    (folders[0] / "one").mkdir()
    (folders[0] / "one" / "report.json").write_text("{}")
    answer = geodiff(*folders[1], *option)
    assert answer.code == 2 and told in answer.err


def never(*_, **__):
    raise AssertionError("weights were loaded before the folder was checked")


@pytest.mark.parametrize("kind", ["list", "linked list", "other table", "folder"])
def test_what_the_table_may_not_replace_stays(geodiff, folders, monkeypatch, kind):
    root, command = folders
    monkeypatch.setattr("geodiff_plugin.cli.many.load_guided_prior", never)
    (root / "mine").mkdir()
    table, text = root / "mine" / "pairs.csv", "left,right\n../left/a.png,../right/a.png\n"
    words, told = ["mine/pairs.csv"], "which is not the table of an earlier run"
    if kind == "linked list":
        words = ["list.csv"]
        (root / "list.csv").symlink_to(table)
    if kind in ("other table", "folder"):
        words = ["left", "right"]
    if kind == "folder":
        table.mkdir()
        told = "which is a folder"
    else:
        table.write_text(text)
    answer = geodiff("depth", *words, *command[3:], "--out", "mine", "--overwrite")
    assert answer.code == 2 and f"replaced; got {Path('mine', 'pairs.csv')}, {told}" in answer.err
    assert table.is_dir() or table.read_text() == text
    assert list((root / "mine").iterdir()) == [table]


def test_a_folder_that_takes_no_table_is_refused_before_the_work(geodiff, folders, monkeypatch):
    def no_file(dir):
        assert dir.samefile(root)  # the nearest that is there
        raise PermissionError(errno.EACCES, "Permission denied")

    root, command = folders
    monkeypatch.setattr("geodiff_plugin.cli.many.load_guided_prior", never)
    monkeypatch.setattr("geodiff_plugin.cli.pairs.TemporaryFile", no_file)
    answer = geodiff(*command, "--out", "deep/out")
    assert answer.code == 2 and "can be written to; got deep" in answer.err
    assert "(Permission denied)" in answer.err and not (root / "deep").exists()


def test_a_table_that_cannot_be_written_in_the_end_is_shown(geodiff, folders, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("geodiff_plugin.cli.many.atomic_path", full)
    root, command = folders
    answer = geodiff(*command)
    assert answer.code == 0 and "3 pairs: 3 done" in answer.out
    told = f"geodiff: {Path('out', 'pairs.csv')} could not be written (No space left on device)."
    assert answer.err.splitlines()[-1] == told
    (root / "left" / "a.png").write_bytes(b"broken")
    assert geodiff(*command, "--overwrite").code == 4


def test_warm_start_of_one_pair_and_no_cameras_of_many_are_refused(geodiff, folders):
    root, command = folders
    answer = geodiff("depth", "left/a.png", "right/a.png", *command[3:], "--warm-start")
    assert answer.code == 2 and "--warm-start must be given with many pairs" in answer.err
    answer = geodiff("depth", "left", "right", "--out", "out")
    assert answer.code == 2 and "calibration must be given" in answer.err and not (root / "out").exists()


def test_warm_start_goes_from_frame_to_frame(geodiff, folders):
    root, command = folders
    words = [word for word in command if word not in ("--preset", "paper")]
    words[words.index("--steps") + 1] = 4
    assert geodiff(*words, "--warm-start", "--knob", "corrections=4", "-q").code == 0
    reports = [json.loads((root / "out" / name / "report.json").read_text()) for name in "abc"]
    assert [report["pair"]["began_from"] for report in reports] == [None, "a", "b"]
    assert [len(report["history"]) for report in reports] == [4, 3, 3]


def test_warm_start_begins_anew_behind_a_pair_that_has_no_result_of_this_run(geodiff, folders):
    root, command = folders
    words = [word for word in command if word not in ("--preset", "paper")]
    whole = (root / "right" / "b.png").read_bytes()
    (root / "right" / "b.png").write_bytes(whole[: len(whole) // 2])  # fails before the guided call
    assert geodiff(*words, "--warm-start", "-q").code == 4
    last = root / "out" / "c" / "report.json"
    assert json.loads(last.read_text())["pair"]["began_from"] is None
    (root / "right" / "b.png").write_bytes(whole)
    assert geodiff(*words, "--warm-start", "-q").code == 0
    for name in "ac":
        shutil.rmtree(root / "out" / name)
    assert geodiff(*words, "--warm-start", "-q").code == 0  # b was there already
    assert json.loads(last.read_text())["pair"]["began_from"] is None


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
    return [[np.roll(getattr(textured_plane, s), i, axis=0) for i in range(3)] for s in ("left", "right")]


def test_frames_are_read_in_any_order(tmp_path, views):
    write_video(tmp_path / "left.avi", views[0])
    assert count_frames(tmp_path / "left.avi") == 3
    with VideoReader(tmp_path / "left.avi") as video:
        for frame in (0, 2, 1):
            read = video.read(frame)
            assert read.shape == views[0][frame].shape and read.dtype == np.float32
            assert np.abs(read - views[0][frame] / 255).mean() < 0.05
        with pytest.raises(OSError, match="frame 3"):
            video.read(3)


def test_halves_of_a_frame():
    left, right = both_halves(np.arange(24, dtype=np.float32).reshape(2, 4, 3))
    assert left.shape == right.shape == (2, 2, 3) and right[0, 0, 0] == 6
    with pytest.raises(InputError, match="even width"):
        both_halves(np.zeros((2, 3, 3), np.float32))


@pytest.mark.parametrize("cameras", ["--calib", "--fx"])
@pytest.mark.parametrize("beside", [False, True])
def test_the_video_of_a_rig(geodiff, folders, textured_plane, views, beside, cameras):
    root, command = folders
    if cameras == "--fx":
        K, at = textured_plane.K, command.index("--calib")
        numbers = {"--fx": K[0, 0], "--fy": K[1, 1], "--cx": K[0, 2], "--cy": K[1, 2]}
        typed = [word for name, value in numbers.items() for word in (name, float(value))]
        command = [*command[:at], *typed, "--baseline", 0.1, *command[at + 2 :]]
    if beside:
        write_video(root / "rig.avi", [np.concatenate(both, 1) for both in zip(*views, strict=True)])
        words = ["depth", "rig.avi", *command[3:]]
    else:
        for name, frames in zip(("l.avi", "r.avi"), views, strict=True):
            write_video(root / name, frames)
        words = ["depth", "l.avi", "r.avi", *command[3:]]
    answer = geodiff(*words)
    assert answer.code == 0, answer.err
    found = sorted(path.name for path in (root / "out").iterdir())
    assert found == [JOURNAL, "000000", "000001", "000002", "pairs.csv"]
    report = json.loads((root / "out" / "000002" / "report.json").read_text())
    assert report["pair"]["frame"] == 2 and report["inputs"]["right_size"] == [64, 48]
    answer = geodiff("video", *sorted(root.glob("out/0*")), "--photographs", "--out", "depth.gif")
    assert answer.code == 0, answer.err
    answer = geodiff(*words, "--export", "colmap", "--overwrite")
    assert answer.code == 2 and "--export colmap must be left out with a video" in answer.err


# Several processes


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["torchrun", "two terminals"])
def test_two_processes_share_the_pairs(folders, launcher):
    root, command = folders
    torchrun = [*("torch.distributed.run", "--nproc-per-node", "2", "--rdzv-backend", "c10d")]
    torchrun += ["--rdzv-endpoint", "localhost:0", "-m"]
    words = [sys.executable, "-m", *(torchrun if launcher == "torchrun" else ()), "geodiff_plugin"]
    package = Path(__file__).resolve().parents[2]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(package)}
    started = [
        subprocess.Popen(
            [*words, *map(str, command)], cwd=root, env=environment, text=True, stdout=-1, stderr=-1
        )
        for _ in range(1 if launcher == "torchrun" else 2)
    ]
    for process in started:
        out, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        assert "3 pairs: " in out and ", 0 failed" in out and out.count("pairs:") == 1
    assert {row["result"] for row in rows_of(root / "out")} <= {"done", "there"}


def test_a_full_disk_ends_the_run_and_keeps_what_is_finished(geodiff, folders, monkeypatch):
    from geodiff_plugin.cli import many

    root, command = folders
    write = many.write_result

    def full(options, *rest):
        if options.out.name == "b":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(options, *rest)

    monkeypatch.setattr(many, "write_result", full)
    before = set(root.iterdir())
    answer = geodiff(*command)
    assert answer.code == 2 and "(No space left on device). Finished pairs stay" in answer.err
    assert set(root.iterdir()) - before == {root / "out"}
    assert (root / "out" / "a" / "report.json").exists() and not (root / "out" / "b").exists()
    monkeypatch.undo()
    monkeypatch.chdir(root)
    answer = geodiff(*command)
    assert answer.code == 0 and "2 done, 1 there already" in answer.out
