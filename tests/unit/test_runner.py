"""Jobs that are resumed, shared, killed and that fail."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geodiff_plugin.jobs.runner import BROKEN, Item, Journal, Runner, fingerprint

CHILD = """
import sys, time
from pathlib import Path
from geodiff_plugin.jobs.runner import Item, Journal, Runner

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
    runner = Runner(items, Journal(folder / "job.jsonl"), progress=False, **keywords)
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
        runner = Runner([item], Journal(tmp_path / "job.jsonl"), progress=False, whole=whole)
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


def start(folder, pause=0.05, stages=1, **environment):
    words = [sys.executable, "-c", CHILD, str(folder), str(pause), str(stages)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, env=os.environ | environment, text=True)


def begun(folder):
    return Counter((folder / "begun").read_text().split()) if (folder / "begun").exists() else Counter()


@pytest.mark.parametrize(("stages", "launched"), [(1, True), (2, False)])
def test_processes_share_a_job(tmp_path, stages, launched):
    launcher = [{"RANK": str(i), "WORLD_SIZE": "2"} if launched else {} for i in range(2)]
    processes = [start(tmp_path, stages=stages, **environment) for environment in launcher]
    counts = [int(process.communicate(timeout=60)[0]) for process in processes]
    assert counts[0] == 8 and (launched or counts[1] == 8)
    assert begun(tmp_path) == ALL


def test_what_a_killed_process_had_begun_is_taken_over(tmp_path):
    victim = start(tmp_path, pause=60, RANK="1", WORLD_SIZE="2")
    while not begun(tmp_path):
        time.sleep(0.05)
    first = start(tmp_path, RANK="0", WORLD_SIZE="2")
    while sum(begun(tmp_path).values()) < 8:
        time.sleep(0.05)
    time.sleep(0.5)
    assert first.poll() is None  # it waits for the item that the other one has
    victim.send_signal(signal.SIGKILL)
    victim.communicate()
    assert first.communicate(timeout=60)[0] == "8\n"
    assert begun(tmp_path) == ALL + Counter(["item4"])
    records = [json.loads(line) for line in (tmp_path / "job.jsonl").read_text().splitlines()]
    assert sorted(record["square"] for record in records) == [n**2 for n in range(8)]
