"""What a run answers in a terminal: its tables, totals and exit codes, against the rows and reports."""

import json
from pathlib import Path

import pytest

from geodiff_plugin.cli import run as module
from geodiff_plugin.cli.results import run_convert, run_merge, run_submit, run_video
from geodiff_plugin.cli.run import answer_rows, summary
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions
from geodiff_plugin.jobs.pairs import COLUMNS


def row(name: str, result: str = "done", verdict: str | None = "trusted", **more) -> dict:
    numbers = {"near_m": 1.234, "median_m": 2.345, "far_m": 3.456, "confidence": 0.987, "seconds": 4.567}
    return dict.fromkeys(COLUMNS) | numbers | {"pair": name, "result": result, "verdict": verdict} | more


def failed(name: str) -> dict:
    return dict.fromkeys(COLUMNS) | {"pair": name, "result": "failed", "message": f"{name} is torn."}


def answer(rows, capsys, **more) -> tuple[int, list[list[str]]]:
    """The exit code, and the words of every line."""
    code = 0
    try:
        answer_rows(rows, Path("out"), **{"as_json": False} | more)
    except SystemExit as leaving:
        code = leaving.code
    return code, [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]


def test_every_pair_has_a_line_with_its_numbers(capsys):
    rows = [row("a"), row("b", "kept"), row("c", verdict="not trusted", confidence=None), failed("d")]
    rows.append(row("e", verdict="not judged"))
    code, lines = answer(rows, capsys)
    assert code == 4
    assert ["pair", "result", "near", "m", "median", "m", "far", "m", "confidence", "s"] in lines
    numbers = ["1.23", "2.35", "3.46"]
    assert ["a", "done", *numbers, "0.99", "4.57"] in lines
    assert ["b", "kept", *numbers, "0.99", "4.57"] in lines
    assert ["c", "not", "trusted", *numbers, "-", "4.57"] in lines
    assert ["d", "failed", "-", "-", "-", "-", "-"] in lines
    text = [" ".join(line) for line in lines]
    totals = "3 done, 1 already done, 1 failed, 1 not trusted, 1 not judged"
    assert f"5 pairs: {totals} -> out/: NAME/overview.png, NAME/depth.npy, NAME/cloud.ply" in text
    assert "d: d is torn." in text


def test_one_pair_is_one_and_a_run_without_failures_ends_well(capsys):
    code, lines = answer([row("a")], capsys)
    assert code == 0 and " ".join(lines[-1]).startswith(
        "1 pair: 1 done, 0 already done, 0 failed, 0 not trusted ->"
    )


@pytest.mark.parametrize("count", [20, 21])
def test_of_many_pairs_only_those_that_failed_or_are_doubted_have_a_line(capsys, count):
    rows = [row(f"p{n}") for n in range(count - 2)] + [failed("bad"), row("odd", verdict="not trusted")]
    _, lines = answer(rows, capsys)
    named = {line[0] for line in lines}
    assert {"bad", "odd"} <= named and ("p3" in named) == (count == 20)


def test_rows_are_json_or_nothing_where_that_is_asked_for(capsys):
    rows = [row("a"), failed("b")]
    with pytest.raises(SystemExit) as leaving:
        answer_rows(rows, Path("out"), as_json=True)
    assert leaving.value.code == 4 and json.loads(capsys.readouterr().out) == rows
    assert answer([row("a")], capsys, quiet=True) == (0, [])
    assert answer(rows, capsys, quiet=True) == (4, [])


def frame(name: str, median: float, status: str = "trusted", reasons=()) -> dict:
    return {
        "frame": name,
        "depth": {"median": median},
        "verdict": {"status": status, "reasons": list(reasons)},
    }


FRAMES = [
    frame("f0", 5.0),
    {"frame": "f1", "key": "f1", "error": "torn"},
    frame("f2", 2.5, "not trusted", ["E is wrong.", "So is K."]),
    frame("f3", 3.75, "not judged"),
]


def test_a_capture_is_summed_up_by_the_median_of_its_frames_and_what_is_doubted():
    report = {"frames": FRAMES, "unit": "m", "not_trusted": ["f2", "f3"]}
    line = summary(report, Path("out"))
    assert line == "3 of 4 frames, median depth 3.75 m; NOT TRUSTED: f2, f3 (f2: E is wrong.) -> out/"
    line = summary(report | {"not_trusted": ["f3"]}, Path("out"))
    assert "(f3: there are no matches from a second view" in line
    line = summary(report | {"unit": None, "not_trusted": []}, Path("out"))
    assert "median depth 3.75 pose units (for metres pass --known-length" in line
    assert "NOT TRUSTED" not in line
    assert (
        summary({"frames": FRAMES[1:2], "unit": "m", "not_trusted": []}, Path("o")) == "0 of 1 frames -> o/"
    )
    for count in (5, 6):
        many = [frame(f"g{n}", 1.0, "not trusted", ["No."]) for n in range(count)]
        names = [each["frame"] for each in many]
        line = summary({"frames": many, "unit": "m", "not_trusted": names}, Path("out"))
        assert (" and 1 more " in line) == (count > 5) and "g4" in line and "g5" not in line


def capture_of(monkeypatch, capsys, report, **options) -> tuple[int, str, dict]:
    given = {}

    def depth_capture(made, *, notify, progress):
        given.update(options=made, notify=notify, progress=progress)
        return report

    monkeypatch.setattr(module, "depth_capture", depth_capture)
    code = 0
    try:
        module.run_capture(CaptureOptions(path=Path("scan"), out=Path("out"), **options))
    except SystemExit as leaving:
        code = leaving.code
    return code, capsys.readouterr().out, given


def test_a_capture_ends_with_code_4_where_a_frame_failed_or_is_not_trusted_in_strictness(monkeypatch, capsys):
    report = {"frames": FRAMES[:1], "unit": "m", "not_trusted": [], "failed": []}
    code, out, given = capture_of(monkeypatch, capsys, report)
    assert (
        code == 0
        and out == "1 of 1 frames, median depth 5.00 m -> out/: sheet.jpg, cloud.ply, NAME/depth.npy\n"
    )
    assert given["progress"] is True and given["notify"] is module.say
    code, _, given = capture_of(monkeypatch, capsys, report, quiet=True)
    assert code == 0 and given["progress"] is False and given["notify"] is module.silent
    doubted = report | {"frames": FRAMES[2:3], "not_trusted": ["f2"]}
    assert capture_of(monkeypatch, capsys, doubted)[0] == 0
    assert capture_of(monkeypatch, capsys, doubted, strict=True)[0] == 4
    assert capture_of(monkeypatch, capsys, report, strict=True)[0] == 0
    assert capture_of(monkeypatch, capsys, report | {"failed": ["f1"]})[0] == 4
    _, out, _ = capture_of(monkeypatch, capsys, report, shard="0/2")
    assert out.endswith("-> out/\n")
    _, out, _ = capture_of(monkeypatch, capsys, report, json=True)
    assert json.loads(out) == report
    poses = report | {"poses": {"status": "solved"}}
    assert capture_of(monkeypatch, capsys, poses, poses_only=True)[1] == "poses solved -> out/\n"
    measured = {"frame": "f0", "pixels": [[1, 2], [3, 4]], "length": 1.5, "spread": 0.25, "unit": "m"}
    _, out, _ = capture_of(monkeypatch, capsys, report | {"measured": [measured | {"trusted": True}]})
    assert out.splitlines()[1] == "f0 (1, 2) to (3, 4): 1.50 ± 0.25 m"


class Result:
    """What ``depth_pair`` returns."""

    report = {
        "depth": {"min_m": 1.0, "median_m": 2.0, "max_m": 3.0},
        "verdict": {"status": "not trusted", "reasons": ["No."], "facts": {}},
        "seconds": {"start": 1.5, "call": 2.0},
        "unit": "m",
        "prior_scale": None,
    }


def test_one_pair_answers_with_its_line_or_its_report(monkeypatch, capsys):
    class Folder:
        path = Path("out")

    given = {}

    def depth_pair(options, *, folder, log, notify, progress):
        given.update(options=options, folder=folder, log=log, notify=notify, progress=progress)
        return Result

    monkeypatch.setattr(module, "depth_pair", depth_pair)
    monkeypatch.setattr(module.time, "perf_counter", lambda: 12.5)
    options, folder = DepthOptions(left=Path("a")), Folder()
    module.run_depth(options, folder, 10.0)
    assert given["options"] is options and given["folder"] is folder and given["progress"] is True
    assert given["log"].seconds == {"start": 2.5} and given["notify"] is module.say
    assert capsys.readouterr().out.endswith("; 3.5 s -> out/: overview.png, depth.npy, cloud.ply)\n")
    module.run_depth(DepthOptions(left=Path("a"), quiet=True), folder, 10.0)
    assert capsys.readouterr().out == "" and given["progress"] is False and given["notify"] is module.silent
    module.run_depth(DepthOptions(left=Path("a"), quiet=True, json=True), folder, 10.0)
    assert json.loads(capsys.readouterr().out) == Result.report


def test_many_pairs_and_a_bag_answer_with_their_rows(monkeypatch, capsys):
    given = {}

    def depth_pairs(options, refs, *, notify, progress):
        given.update(options=options, refs=refs, notify=notify, progress=progress)
        return [row("a")]

    class Bag:
        path, frames, images, rows = Path("b.mcap"), Path("b-frames"), 7, [row("a"), row("b")]

    def depth_bag(options, *, notify, progress):
        given.update(options=options, notify=notify, progress=progress)
        return Bag

    monkeypatch.setattr(module, "depth_pairs", depth_pairs)
    monkeypatch.setattr(module, "depth_bag", depth_bag)
    options = DepthOptions(left=Path("a"), out=Path("out"))
    module.run_many(options, ["ref"])
    assert "-> out/" in capsys.readouterr().out and given["refs"] == ["ref"] and given["progress"] is True
    quiet = DepthOptions(left=Path("a"), out=Path("out"), quiet=True)
    module.run_many(quiet, ["ref"])
    assert capsys.readouterr().out == "" and given["progress"] is False and given["notify"] is module.silent
    module.run_many(DepthOptions(left=Path("a"), out=Path("out"), json=True), [])
    assert json.loads(capsys.readouterr().out) == [row("a")]
    module.run_bag(options)
    said = capsys.readouterr()
    assert "b.mcap: 7 depth images (16UC1) from 2 pairs" in said.err and "2 pairs: 2 done" in said.out
    assert "-> b-frames/" in said.out and given["progress"] is True
    module.run_bag(quiet)
    said = capsys.readouterr()
    assert said.err == said.out == "" and given["progress"] is False


def test_parquet_files_answer_with_what_became_of_the_pairs(monkeypatch, capsys):
    from dataclasses import dataclass, field

    @dataclass
    class Found:
        uri: str = "s3://out"
        kept: int = 3
        done: int = 5
        not_trusted: int = 2
        failed: dict = field(default_factory=dict)

    found, given = Found(), {}

    def on_ray(name):
        def function(options, refs, *, progress):
            given.update(name=name, refs=refs, progress=progress)
            return found

        return function

    monkeypatch.setattr(module, "on_ray", on_ray)
    options = DepthOptions(left=Path("a"), out=Path("out"))
    module.run_parquet(options, ["r"] * 9)
    said = "9 pairs: 5 done, 3 already done, 0 failed, 2 not trusted -> s3://out\n"
    assert (
        capsys.readouterr().out == said and given["progress"] is True and given["name"] == "pairs_to_parquet"
    )
    found.failed["a"] = "torn"
    with pytest.raises(SystemExit) as leaving:
        module.run_parquet(DepthOptions(left=Path("a"), json=True), [])
    assert leaving.value.code == 4 and json.loads(capsys.readouterr().out)["failed"] == {"a": "torn"}
    with pytest.raises(SystemExit):
        module.run_parquet(DepthOptions(left=Path("a"), quiet=True), [])
    assert capsys.readouterr().out == "" and given["progress"] is False


def test_results_are_answered_in_a_line(monkeypatch, capsys, tmp_path):
    from geodiff_plugin.cli import results

    given = {}

    def note(name, answer):
        def function(*arguments, **named):
            given[name] = arguments
            return answer

        monkeypatch.setattr(results, name, function)

    note("write_video", 0.625)
    note("write_submission", 4)
    note("convert_prior", "a checkpoint")
    note("merge_shards", [row("a")])
    run_video(["a", "b"], Path("v.gif"), 4.0, 1.0, 9.0, True)
    run_video(["a"], Path("v.gif"), 4.0, None, None, False)
    assert capsys.readouterr().out == "2 frames, 0.6 s -> v.gif\n1 frame, 0.6 s -> v.gif\n"
    assert given["write_video"] == (["a"], Path("v.gif"), 4.0, None, None, False)
    run_submit(["a"], "eth3d", Path("z"), "Mine")
    assert given["write_submission"] == (["a"], "eth3d", Path("z"), "Mine")
    assert capsys.readouterr().err == "z: 4 pairs for eth3d (low_res_two_view/SCENE.pfm, SCENE.txt)\n"
    run_convert([Path("base"), Path("src"), Path("dst")], "part", "log")
    assert given["convert_prior"] == ([Path("base"), Path("src"), Path("dst")], "part", "log")
    assert capsys.readouterr().out == "src (a checkpoint) -> dst; use it with --prior dst\n"
    run_merge(Path("out"), False)
    assert given["merge_shards"] == (Path("out"),) and "1 pair: 1 done" in capsys.readouterr().out
    run_merge(Path("out"), True)
    assert json.loads(capsys.readouterr().out) == [row("a")]
