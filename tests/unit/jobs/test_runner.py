"""How items go through stages and among processes, without processes."""

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

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs import runner as module
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Shard, fingerprint
from geodiff_plugin.jobs.processes import ProcessEnded, WorkerProcess
from geodiff_plugin.jobs.runner import ParallelStage, Runner, _ItemQueue, _StagePipeline, on_ray
from tests.unit.error_sentences import check_error
from tests.unit.jobs.work_elsewhere import by_process


def items(count: int) -> list[Item]:
    return [Item(f"i{n}", n) for n in range(count)]


@pytest.fixture
def journal(tmp_path):
    with Journal(tmp_path / "job.jsonl") as opened:
        yield opened


def test_items_are_taken_in_turn_until_none_are_left_or_all_are_to_stop():
    one, two = items(2)
    left = _ItemQueue([one, two])
    assert left.take() is one and left.put_back(one)
    assert left.take() is one and left.take() is two and left.take() is None
    assert left.put_back(two) and left.take() is two
    left = _ItemQueue([one, two])
    left.stop()
    assert left.take() is None and not left.put_back(one) and left.take() is None


def test_no_two_items_have_one_key_with_the_same_inputs(journal):
    Runner([Item("a", inputs="1"), Item("a", inputs="2")], journal, progress=False)
    both = [Item("a"), Item("a")]
    check_error(
        lambda: Runner(both, journal, noun="pair", progress=False),
        *("items", "unique by key", "2 pairs, some with the same key"),
    )


def test_a_record_of_what_is_not_there_any_more_is_forgotten(journal):
    found = items(3)
    for item in found[:2]:
        journal.put(item, {"n": item.payload})
    asked = []

    def whole(item, record):
        asked.append((item.key, record["n"]))
        return item.key == "i1"

    runner = Runner(found, journal, progress=False, whole=whole)
    assert asked == [("i0", 0), ("i1", 1)]
    assert [item.key for item in runner.left] == ["i0", "i2"]
    assert [item.key for item in Runner(found, journal, progress=False).left] == ["i0", "i2"]


def test_stages_pass_on_what_they_return_in_the_thread_that_waits_if_there_is_one(journal):
    threads, here = [], threading.get_ident()

    def first(item):
        threads.append(threading.get_ident())
        return item.payload + 10

    def last(value):
        threads.append(threading.get_ident())
        return {"value": value}

    released = []
    records = Runner(items(3), journal, progress=False).run(first, last, release=released.append)
    assert [record["value"] for record in records] == [10, 11, 12] and here not in threads
    assert [item.payload for item in released] == [0, 1, 2]
    threads.clear()
    Runner([Item("x", 5)], journal, progress=False).run(lambda item: last(first(item)))
    assert set(threads) == {here}


@pytest.mark.parametrize(("most", "at_once"), [(None, 3), (1, 1), (2, 2)])
def test_as_many_items_are_in_flight_as_there_are_threads_or_as_requested(journal, most, at_once):
    lock, on_the_way, largest = threading.Lock(), [], []

    def work(item):
        with lock:
            on_the_way.append(item.key)
            largest.append(len(on_the_way))
        return item

    def release(item):
        with lock:
            on_the_way.remove(item.key)

    line = [work, ParallelStage(lambda item: {"n": item.payload}, 2)]
    Runner(items(9), journal, progress=False).run(*line, release=release, max_items=most)
    assert max(largest) <= at_once and on_the_way == []


def test_a_stage_by_several_threads_is_called_as_itself():
    assert ParallelStage(lambda value: value + 1, 4)(2) == 3
    assert _StagePipeline([len, ParallelStage(len, 4), len]).threads == 6


def test_the_bar_begins_where_the_last_run_ended(journal, monkeypatch):
    bars = []

    class Bar:
        def __init__(self, **given):
            bars.append(given)
            self.count = 0

        def __enter__(self):
            return self

        def __exit__(self, *_):
            bars.append(self.count)

        def update(self):
            self.count += 1

    monkeypatch.setattr(module, "tqdm", Bar)
    journal.put(items(1)[0], {})
    Runner(items(4), journal, noun="pair").run(lambda item: {})
    assert (bars[0]["total"], bars[0]["initial"], bars[0]["disable"], bars[0]["unit"]) == (
        4,
        1,
        False,
        " pair",
    )
    assert bars[1] == 3
    Runner(items(4), journal, progress=False).run(lambda item: {})
    assert bars[2]["disable"] is True and bars[2]["initial"] == 4


class Process:
    """A process that makes some items, and then fails as requested."""

    def __init__(self, made: int, error: BaseException | None = None):
        self.left, self.error, self.ended = made, error, 0

    def call(self, function, item):
        if self.left == 0 and self.error is not None:
            raise self.error
        self.left -= 1
        return function(item) | {"there": True}

    def end(self):
        self.ended += 1


def go_with(journal, processes, count=6, stage=None, is_recoverable=()):
    runner = Runner(items(count), journal, progress=False, is_recoverable=is_recoverable)
    return runner.run_with(
        processes, lambda item: {"n": item.payload}, stage or (lambda item: {"n": item.payload})
    )


def test_whoever_is_free_takes_the_next_item_and_what_a_process_left_is_made_here(journal, capsys):
    waiting = threading.Event()

    def here(item):
        waiting.wait(5)  # until the process has ended
        return {"n": item.payload}

    class Ends(Process):
        def call(self, function, item):
            try:
                return super().call(function, item)
            except ProcessEnded:
                waiting.set()
                raise

    process = Ends(2, ProcessEnded("It was killed."))
    records = go_with(journal, [process], stage=here)
    assert [record["n"] for record in records] == list(range(6))
    assert sum(record.get("there", False) for record in records) == 2 and process.ended == 0
    assert "is being reprocessed: It was killed." in capsys.readouterr().err


def test_a_failure_that_is_survived_fails_its_item_and_any_other_ends_the_run(journal):
    def here(item):
        raise ValueError(f"i{item.payload} is torn")

    records = go_with(journal, [Process(9)], count=3, stage=here, is_recoverable=(ValueError,))
    for record in records:
        assert record.get("status") == BROKEN or record["there"]
    journal._records.clear()
    process = Process(0, KeyError("a defect"))
    with pytest.raises(KeyError):
        go_with(journal, [process], stage=lambda item: {})
    assert process.ended == 1
    journal._records.clear()
    process = Process(100)

    def stops(item):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go_with(journal, [process, Process(100)], count=500, stage=stops)
    assert process.ended == 1


def test_without_ray_its_extra_is_named_and_other_errors_stay(monkeypatch):
    def missing(name):
        def imported(where):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

        return imported

    for name in ("ray", "pyarrow"):
        monkeypatch.setattr(module, "imported", missing(name))
        with pytest.raises(InputError, match=r"geodiff-plugin\[ray\]"):
            on_ray("pairs_to_folders")
    monkeypatch.setattr(module, "imported", missing("numpy"))
    with pytest.raises(ModuleNotFoundError):
        on_ray("pairs_to_folders")
    monkeypatch.setattr(module, "imported", lambda where: where)
    assert on_ray("pairs_to_folders") == "jobs.cluster.pairs_to_folders"


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
    image, calls = tmp_path / "left.png", []

    def run(whole=None):
        item = Item("pair", inputs=fingerprint({"picture": image}, "0.1.0"))
        with Journal(tmp_path / "job.jsonl") as journal:
            runner = Runner([item], journal, progress=False, whole=whole)
            return runner.run(lambda i: calls.append(i) or {})[0]["inputs"]

    found = []
    for content, made in (("old", 1), ("old", 1), ("another", 2), ("old", 2)):
        image.write_text(content)
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
    records = go(tmp_path, work, is_recoverable=(OSError,))
    assert [r["status"] for r in records] == ["ok", BROKEN, BROKEN, "ok"]
    assert records[1]["error"] == "item1 is missing"
    together = "geodiff: 2 of 4 items failed for the same reason: item1, item2."
    assert capsys.readouterr().err.splitlines() == ["geodiff: item1: item1 is missing", together]
    fixed = True
    assert [r["status"] for r in go(tmp_path, work)] == ["ok"] * 4


def test_an_error_of_every_item_is_reported_once_and_a_bug_keeps_its_traceback(tmp_path, capsys):
    def work(item):
        raise ValueError(f"{item.key} has no camera")

    with pytest.raises(ValueError, match=r"item0 has no camera All 4 items failed"):
        go(tmp_path, work, is_recoverable=(ValueError,), stages=2)
    assert capsys.readouterr().err == ""
    records = go(tmp_path, lambda item: {"n": 1 // (item.payload % 2)}, is_recoverable=(Exception,))
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

    records = go(tmp_path, ParallelStage(work, 3), 7, stages=2)
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
        go(tmp_path, ParallelStage(work, 3), 9, stages=2, release=lambda item: released.append(item.payload))
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
        last = ParallelStage(lambda item: {"n": item.payload}, 9)
        records = Runner(items, journal, progress=False).run(first, second, last)
    assert [record["n"] for record in records] == list(range(12))
    assert max(ahead) <= 3  # in the second, waiting for it, and in the first


def start(folder, pause=0.05, stages=1):
    words = [sys.executable, "-c", CHILD, str(folder), str(pause), str(stages)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def begun(folder):
    return Counter((folder / "begun").read_text().split()) if (folder / "begun").exists() else Counter()


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_a_second_run_in_the_same_folder_is_rejected_and_goes_on_when_the_first_was_killed(tmp_path):
    first = start(tmp_path, pause=60)
    while not begun(tmp_path):
        time.sleep(0.05)
    with pytest.raises(InputError, match=f"Another run is using {tmp_path}. Wait for it"):
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
            Runner([Item("item0", 0)], journal, is_recoverable=(OSError,), progress=False).run(work)
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
def test_a_shard_is_given_or_set_by_the_launcher(monkeypatch, typed, environment, expected):
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
def test_processes_of_one_machine_are_set_by_torchrun_or_by_its_gpus(
    monkeypatch, shard, environment, gpus, processes
):
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert shard.processes_here(gpus) == processes


@pytest.mark.parametrize("typed", ["8/8", "1", "-1/3", "1/0", "a/b", ""])
def test_a_non_shard_is_rejected(typed):
    with pytest.raises(InputError, match="--shard must be I/N"):
        Shard.of(typed)


def go_beside(folder, payloads, count=2, stage=by_process):
    processes = [WorkerProcess(by_process.__module__) for _ in range(count)]
    try:
        with Journal(folder / "job.jsonl") as journal:
            items = [Item(f"item{n}", payload) for n, payload in enumerate(payloads)]
            runner = Runner(items, journal, progress=False, is_recoverable=(ValueError,))
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
    reported = capsys.readouterr().err.splitlines()
    assert len(reported) == 2 and all("is being reprocessed: " in line and said in line for line in reported)


def test_a_reason_counts_once_over_all_processes(tmp_path, capsys):
    with pytest.raises(ValueError, match=r"has no camera All 6 items failed"):
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
