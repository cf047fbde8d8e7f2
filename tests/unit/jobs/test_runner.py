"""How items go through stages and among processes, without processes."""

import threading

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.jobs import runner as module
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal
from geodiff_plugin.jobs.runner import Runner, SideBySide, _Left, _Line
from geodiff_plugin.jobs.separate import ProcessEnded


def items(count: int) -> list[Item]:
    return [Item(f"i{n}", n) for n in range(count)]


@pytest.fixture
def journal(tmp_path):
    with Journal(tmp_path / "job.jsonl") as opened:
        yield opened


def test_items_are_taken_in_turn_until_none_are_left_or_all_are_to_stop():
    one, two = items(2)
    left = _Left([one, two])
    assert left.take() is one and left.put_back(one)
    assert left.take() is one and left.take() is two and left.take() is None
    assert left.put_back(two) and left.take() is two
    left = _Left([one, two])
    left.stop()
    assert left.take() is None and not left.put_back(one) and left.take() is None


def test_no_two_items_have_one_key_with_the_same_inputs(journal):
    Runner([Item("a", inputs="1"), Item("a", inputs="2")], journal, progress=False)
    with pytest.raises(InputError, match="2 pairs, some of one key"):
        Runner([Item("a"), Item("a")], journal, noun="pair", progress=False)


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
def test_as_many_items_are_on_the_way_as_there_are_threads_or_as_is_said(journal, most, at_once):
    lock, on_the_way, largest = threading.Lock(), [], []

    def work(item):
        with lock:
            on_the_way.append(item.key)
            largest.append(len(on_the_way))
        return item

    def release(item):
        with lock:
            on_the_way.remove(item.key)

    line = [work, SideBySide(lambda item: {"n": item.payload}, 2)]
    Runner(items(9), journal, progress=False).run(*line, release=release, most=most)
    assert max(largest) <= at_once and on_the_way == []


def test_a_stage_by_several_threads_is_called_as_itself():
    assert SideBySide(lambda value: value + 1, 4)(2) == 3
    assert _Line([len, SideBySide(len, 4), len]).threads == 6


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
    """A process that makes some items, and then fails as it is told to."""

    def __init__(self, made: int, error: BaseException | None = None):
        self.left, self.error, self.ended = made, error, 0

    def call(self, function, item):
        if self.left == 0 and self.error is not None:
            raise self.error
        self.left -= 1
        return function(item) | {"there": True}

    def end(self):
        self.ended += 1


def go_with(journal, processes, count=6, stage=None, survives=()):
    runner = Runner(items(count), journal, progress=False, survives=survives)
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
    assert "is made anew: It was killed." in capsys.readouterr().err


def test_a_failure_that_is_survived_fails_its_item_and_any_other_ends_the_run(journal):
    def here(item):
        raise ValueError(f"i{item.payload} is torn")

    records = go_with(journal, [Process(9)], count=3, stage=here, survives=(ValueError,))
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
