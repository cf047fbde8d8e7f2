"""Jobs that are resumed, divided into shards, killed and that fail."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geodiff_plugin import InputError
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Shard, fingerprint
from geodiff_plugin.jobs.runner import Runner, SideBySide
from geodiff_plugin.jobs.separate import SeparateProcess
from tests.unit.jobs.work_elsewhere import by_process

CHILD = """
import sys, time
from pathlib import Path
from geodiff_plugin.jobs.journal import Item, Journal
from geodiff_plugin.jobs.runner import Runner

out, pause, stages = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])

def work(item):
    with open(out / "begun", "a") as file:
        file.write(f"{item.key}\\n")
    time.sleep(pause)
    return {"square": item.payload**2}

items = [Item(f"item{n}", n) for n in range(8)]
runner = Runner(items, Journal(out / "job.jsonl"), progress=False)
print(len(runner.run(work, *[lambda record: record] * (stages - 1))))
"""
ALL = Counter(f"item{n}" for n in range(8))


def go(folder, work, count=4, stages=1, release=None, **keywords):
    """The records of a run of ``work`` in one stage, or behind others that hand an item on."""
    items = [Item(f"item{n}", n) for n in range(count)]
    with Journal(folder / "job.jsonl") as journal:
        runner = Runner(items, journal, progress=False, **keywords)
        return runner.run(*[lambda item: item] * (stages - 1), work, release=release)


@pytest.mark.parametrize("stages", [1, 3])
def test_a_second_run_does_what_is_missing(tmp_path, stages):
    calls = []

    def work(item):
        calls.append(item.payload)
        return {"square": item.payload**2}

    for count in (3, 5):
        assert [r["square"] for r in go(tmp_path, work, count, stages)] == [0, 1, 4, 9, 16][:count]
    assert calls == [0, 1, 2, 3, 4] and [path.name for path in tmp_path.iterdir()] == ["job.jsonl"]


@settings(deadline=None)  # the disk is written to
@given(
    cut=st.integers(0, 200), extra=st.sampled_from([b"", b'{"key": "item', b"\xff\xfe", b"[1]\n", b"\n\n"])
)
def test_a_torn_end_costs_its_line_only(tmp_path_factory, cut, extra):
    folder, calls = tmp_path_factory.mktemp("torn"), []

    def work(item):
        calls.append(item.key)
        return {"text": f"line {item.payload}\n"}

    first = go(folder, work)
    path = folder / "job.jsonl"
    content = path.read_bytes()[: max(0, path.stat().st_size - cut)]
    path.write_bytes(content + extra)
    calls.clear()
    assert go(folder, work) == first
    assert len(calls) <= 4 - content.count(b"\n") and go(folder, work) == first


def test_changed_inputs_and_lost_files_are_made_again(tmp_path):
    picture, calls = tmp_path / "left.png", []

    def run(whole=None):
        item = Item("pair", inputs=fingerprint({"picture": picture}, "0.1.0"))
        with Journal(tmp_path / "job.jsonl") as journal:
            runner = Runner([item], journal, progress=False, whole=whole)
            return runner.run(lambda i: calls.append(i) or {})[0]["inputs"]

    found = []
    for content, made in (("old", 1), ("old", 1), ("another", 2), ("old", 2)):
        picture.write_text(content)
        found.append(run())
        assert len(calls) == made and (found[-1] == found[0]) == (content == "old")
    run(whole=lambda item, record: False)
    assert len(calls) == 3


def test_a_failure_ends_the_run_unless_it_is_survived(tmp_path, capsys):
    fixed = False

    def work(item):
        if item.payload in (1, 2) and not fixed:
            raise FileNotFoundError(f"{item.key} is missing")
        return {"status": "ok"}

    with pytest.raises(FileNotFoundError, match="item1 is missing"):
        go(tmp_path, work)
    records = go(tmp_path, work, survives=(OSError,))
    assert [r["status"] for r in records] == ["ok", BROKEN, BROKEN, "ok"]
    assert records[1]["error"] == "item1 is missing"
    together = "geodiff: 2 of 4 items failed for one reason: item1, item2."
    assert capsys.readouterr().err.splitlines() == ["geodiff: item1: item1 is missing", together]
    fixed = True
    assert [r["status"] for r in go(tmp_path, work)] == ["ok"] * 4


def test_what_fails_every_item_is_said_once_and_a_defect_keeps_its_traceback(tmp_path, capsys):
    def work(item):
        raise ValueError(f"{item.key} has no camera")

    with pytest.raises(ValueError, match=r"item0 has no camera The same holds for all 4 items"):
        go(tmp_path, work, survives=(ValueError,), stages=2)
    assert capsys.readouterr().err == ""
    records = go(tmp_path, lambda item: {"n": 1 // (item.payload % 2)}, survives=(Exception,))
    assert records[0]["error"].startswith("ZeroDivisionError: ") and records[1]["n"] == 1
    assert capsys.readouterr().err.count("Traceback") == 1


def test_stages_work_side_by_side_and_let_go_of_every_item(tmp_path):
    released, threads = [], set()

    def work(item):
        threads.add(threading.get_ident())
        if item.payload == 2:
            raise KeyError("defect")
        return {}

    with pytest.raises(KeyError):
        go(tmp_path, work, 6, stages=2, release=lambda item: released.append(item.payload))
    assert threads.isdisjoint({threading.get_ident()}) and len(threads) == 1
    assert {0, 1, 2} <= set(released) and len(released) == len(set(released))
    assert len((tmp_path / "job.jsonl").read_bytes().splitlines()) == 2


def test_several_threads_of_a_stage_work_at_once_and_records_keep_the_order_of_items(tmp_path):
    third, ended = threading.Event(), []

    def work(item):
        if item.payload == 0:
            assert third.wait(60)  # so others are worked on meanwhile
        if item.payload == 2:
            third.set()
        ended.append(item.payload)
        return {"square": item.payload**2}

    records = go(tmp_path, SideBySide(work, 3), 7, stages=2)
    assert [record["square"] for record in records] == [n**2 for n in range(7)]
    written = [json.loads(line)["key"] for line in (tmp_path / "job.jsonl").read_text().splitlines()]
    assert written == [f"item{n}" for n in range(7)]
    assert ended.index(2) < ended.index(0) and sorted(ended) == list(range(7))


@pytest.mark.parametrize("error", [KeyError("defect"), KeyboardInterrupt()])
def test_what_ends_the_run_in_one_of_several_threads_lets_the_others_end_their_items(tmp_path, error):
    begun, ended, released, others = [], [], [], threading.Barrier(3, timeout=60)

    def work(item):
        begun.append(item.payload)
        if item.payload in (1, 2, 3):
            others.wait()
        if item.payload == 1:
            raise error
        ended.append(item.payload)
        return {}

    with pytest.raises(type(error)):
        go(tmp_path, SideBySide(work, 3), 9, stages=2, release=lambda item: released.append(item.payload))
    assert {0, 2, 3} <= set(ended) and set(begun) - {1} == set(ended)
    assert set(begun) <= set(released) and len(released) == len(set(released))
    assert len((tmp_path / "job.jsonl").read_bytes().splitlines()) == 1


def test_a_quick_stage_waits_until_the_next_one_takes_what_it_has_done(tmp_path):
    quick, ahead = [], []

    def first(item):
        quick.append(item.payload)
        return item

    def second(item):
        time.sleep(0.02)  # the first could do all items meanwhile
        ahead.append(len(quick) - item.payload)
        return item

    items = [Item(f"item{n}", n) for n in range(12)]
    with Journal(tmp_path / "job.jsonl") as journal:
        last = SideBySide(lambda item: {"n": item.payload}, 9)
        records = Runner(items, journal, progress=False).run(first, second, last)
    assert [record["n"] for record in records] == list(range(12))
    assert max(ahead) <= 3  # in the second, waiting for it, and in the first


def start(folder, pause=0.05, stages=1):
    words = [sys.executable, "-c", CHILD, str(folder), str(pause), str(stages)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def begun(folder):
    return Counter((folder / "begun").read_text().split()) if (folder / "begun").exists() else Counter()


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_a_second_run_in_the_same_folder_is_refused_and_goes_on_when_the_first_was_killed(tmp_path):
    first = start(tmp_path, pause=60)
    while not begun(tmp_path):
        time.sleep(0.05)
    with pytest.raises(InputError, match=f"Another run works in {tmp_path}: wait for it"):
        Journal(tmp_path / "job.jsonl")
    first.send_signal(signal.SIGKILL)
    first.communicate()
    assert start(tmp_path).communicate(timeout=60)[0] == "8\n"
    assert begun(tmp_path) == ALL + Counter(["item0"])


def test_shards_do_every_so_many_th_item_at_once_and_the_whole_finds_them_done(tmp_path):
    calls, items = [], [Item(f"item{n}", n) for n in range(8)]
    with ExitStack() as stack:
        shards = [Shard(index, 3) for index in range(3)]
        journals = [stack.enter_context(Journal(tmp_path / "job.jsonl", shard)) for shard in shards]
        for shard, journal in zip(shards, journals, strict=True):
            runner = Runner(shard.part(items), journal, progress=False)
            records = runner.run(lambda item: calls.append(item.payload) or {"square": item.payload**2})
            assert [r["key"] for r in records] == [f"item{n}" for n in range(shard.index, 8, 3)]
    assert calls == [0, 3, 6, 1, 4, 7, 2, 5]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"job.{n}-of-3.jsonl" for n in range(3)]
    assert [r["square"] for r in go(tmp_path, lambda item: pytest.fail("done before"), 8)] == [
        n**2 for n in range(8)
    ]


def test_a_failure_of_a_shard_is_tried_again_and_does_not_hide_what_was_made_since(tmp_path):
    def failing(item):
        raise OSError("no camera")

    def run(work, *shard):
        with Journal(tmp_path / "job.jsonl", *shard) as journal:
            Runner([Item("item0", 0)], journal, survives=(OSError,), progress=False).run(work)
            return journal.read()

    assert run(failing, Shard(0, 2))["item0", ""]["status"] == BROKEN
    assert run(lambda item: {"status": "ok"})["item0", ""]["status"] == "ok"


@pytest.mark.parametrize(
    ("typed", "environment", "expected"),
    [
        ("2/8", {}, Shard(2, 8)),
        (None, {}, Shard(0, 1)),
        (None, {"RANK": "1", "WORLD_SIZE": "4"}, Shard(1, 4)),
        ("0/2", {"RANK": "1", "WORLD_SIZE": "4"}, Shard(0, 2)),
    ],
)
def test_a_shard_is_typed_or_told_by_the_launcher(monkeypatch, typed, environment, expected):
    for name in ("RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert Shard.of(typed) == expected


@pytest.mark.parametrize(
    ("shard", "environment", "gpus", "processes"),
    [
        (Shard(3, 64), {"LOCAL_WORLD_SIZE": "8"}, 1, 8),
        (Shard(3, 8), {}, 8, 8),  # typed, a process for each GPU of one machine
        (Shard(3, 64), {}, 1, 1),  # a task of SLURM sees its own GPU only
        (Shard(0, 1), {}, 8, 1),
        (Shard(0, 2), {}, 0, 1),
    ],
)
def test_processes_of_one_machine_are_told_by_torchrun_or_by_its_gpus(
    monkeypatch, shard, environment, gpus, processes
):
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert shard.processes_here(gpus) == processes


@pytest.mark.parametrize("typed", ["8/8", "1", "-1/3", "1/0", "a/b", ""])
def test_what_is_no_shard_is_refused(typed):
    with pytest.raises(InputError, match="--shard must be I/N"):
        Shard.of(typed)


def go_beside(folder, payloads, count=2, stage=by_process):
    processes = [SeparateProcess(by_process.__module__) for _ in range(count)]
    try:
        with Journal(folder / "job.jsonl") as journal:
            items = [Item(f"item{n}", payload) for n, payload in enumerate(payloads)]
            runner = Runner(items, journal, progress=False, survives=(ValueError,))
            return runner.run_with(processes, by_process, stage)
    finally:
        for process in processes:
            process.close()


def test_other_processes_make_items_too_and_one_journal_has_them_all(tmp_path):
    def here(item):
        time.sleep(0.05)
        return {"by": os.getpid()}

    records = go_beside(tmp_path, [None] * 400, stage=here)
    assert [record["key"] for record in records] == [f"item{n}" for n in range(400)]
    assert {record["by"] for record in records} > {os.getpid()}
    assert len((tmp_path / "job.jsonl").read_text().splitlines()) == 400
    assert go_beside(tmp_path, [None] * 400, stage=None) == records


@pytest.mark.parametrize(("payload", "said"), [("kills", "(exit code 7)"), ("cannot", "It cannot begin.")])
def test_what_a_lost_process_was_at_is_made_here(payload, said, tmp_path, capsys):
    records = go_beside(tmp_path, [payload] * 5, stage=lambda item: {"by": os.getpid()})
    assert [record["by"] for record in records] == [os.getpid()] * 5
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2 and all("is made anew: " in line and said in line for line in told)


def test_a_reason_counts_once_over_all_processes(tmp_path, capsys):
    with pytest.raises(ValueError, match=r"has no camera The same holds for all 6 items"):
        go_beside(tmp_path, ["fails"] * 6)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("where", ["here", "beside"])
def test_a_defect_ends_the_run_and_the_processes(where, tmp_path):
    def here(item):
        return by_process(item) if where == "here" else (time.sleep(0.5), {})[1]

    with pytest.raises(KeyError):
        go_beside(tmp_path, ["defect"] * 1000, stage=here)
    lines = (tmp_path / "job.jsonl").read_text().splitlines()
    assert len(lines) < 1000


def test_ctrl_c_ends_processes_that_are_at_work(tmp_path):
    def here(item):
        raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        go_beside(tmp_path, ["sleeps"] * 3, stage=here)
    assert time.monotonic() - began < 300
