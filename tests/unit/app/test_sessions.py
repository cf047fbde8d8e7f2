"""Results, tabs and turns on the server: who has what, for how long, and in which order."""

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.app import sessions
from geodiff_plugin.app.sessions import (
    Result,
    ResultStore,
    Run,
    RunQueue,
    Sessions,
    Stopped,
    delete_uploads,
    forget,
)


class Timer:
    """A timer that a test lets run out."""

    made: list = []

    def __init__(self, seconds, function, arguments):
        self.seconds, self.call, self.is_cancelled, self.daemon = (
            seconds,
            lambda: function(*arguments),
            False,
            False,
        )
        Timer.made.append(self)

    def start(self):
        assert self.daemon, "a timer does not keep the process alive"

    def cancel(self):
        self.is_cancelled = True


@pytest.fixture
def timers(monkeypatch):
    Timer.made = []
    monkeypatch.setattr(sessions.threading, "Timer", Timer)
    return Timer.made


@pytest.fixture(autouse=True)
def _temporary(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


@dataclass(frozen=True, eq=False)
class Shown:
    """A result with nothing but its folder."""

    folder: Path | None = None


def shown(folder=None):
    if folder is not None:
        folder.mkdir()
    return Shown(folder)


def all_sessions(store=None) -> Sessions:
    return Sessions(store or ResultStore(), lambda: Result(shown(), [(1, 2)]))


def test_a_result_is_kept_for_ten_minutes_by_its_own_secret(timers, tmp_path):
    store, results = ResultStore(), [Result(shown(tmp_path / name)) for name in "ab"]
    secrets = [store.add(each) for each in results]
    assert len(set(secrets)) == 2 and all(len(secret) == 32 for secret in secrets)
    assert [store.get(secret) for secret in secrets] == results and store.get("") is None
    assert [timer.seconds for timer in timers] == [600, 600]
    store.end_in(secrets[0], 10)
    assert timers[0].is_cancelled and not timers[1].is_cancelled and timers[2].seconds == 10
    timers[2].call()
    assert store.get(secrets[0]) is None and store.get(secrets[1]) is results[1]
    assert not (tmp_path / "a").exists() and (tmp_path / "b").exists()
    store.end_in(secrets[0], 10)
    assert len(timers) == 3, "what is forgotten has no end any more"
    store.drop(secrets[1])
    assert timers[1].is_cancelled and not (tmp_path / "b").exists() and store.get(secrets[1]) is None
    store.drop(secrets[1])
    forget(shown())


def test_files_are_added_to_a_result_or_deleted_if_it_has_expired(timers, tmp_path):
    store, result = ResultStore(), Result(shown(), [(3, 4)])
    secret, folders = store.add(result), [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    assert store.add_files(secret, folders[0]) and store.get(secret) is result
    assert result.shown.folder == folders[0] and result.pixels == [(3, 4)]
    store.drop(secret)
    assert not folders[0].exists()
    assert not store.add_files(secret, folders[1]) and not folders[1].exists()


def test_a_tab_has_points_of_its_own_in_the_first_result_and_then_its_own_result(timers):
    tabs = all_sessions()
    one, two = tabs.of("one"), tabs.of("two")
    tabs.result(one).pixels.append((5, 6))
    assert tabs.result(one).pixels == [(1, 2), (5, 6)] and tabs.result(two).pixels == [(1, 2)]
    run = one.begin()
    made = shown()
    tabs.show(one, run, made, [(7, 8)])
    assert tabs.result(one).shown is made and tabs.result(one).pixels == [(7, 8)] and one.secret
    assert tabs.result(two).pixels == [(1, 2)] and two.secret == ""
    tabs.store.drop(one.secret)
    assert tabs.result(one) is None, "an expired result is not replaced by the first one"


def test_the_latest_run_of_a_tab_wins_and_the_others_are_stopped(timers, tmp_path):
    tabs = all_sessions()
    tab = tabs.of("tab")
    first, second = tab.begin(), tab.begin()
    assert first.stop.is_set() and not second.stop.is_set()
    with pytest.raises(Stopped):
        tabs.show(tab, first, shown(), [])
    assert not tab.end(first) and tab.run is second
    kept = shown(tmp_path / "kept")
    tabs.show(tab, second, kept, [])
    before = tab.secret
    assert tab.end(second) and tab.run is None
    third = tab.begin()
    tab.stop()
    with pytest.raises(Stopped):
        tabs.show(tab, third, shown(), [])
    assert tabs.result(tab).shown is kept and tab.secret == before, "a stopped run changes nothing"
    assert tab.end(third)
    tab.stop()
    fourth = tab.begin()
    assert not fourth.stop.is_set(), "without a run there is nothing to stop"
    tabs.show(tab, fourth, shown(), [])
    assert tabs.store.get(before) is None and not (tmp_path / "kept").exists(), "a tab has one result"
    assert tab.end(fourth)


def test_a_result_that_a_duplicated_tab_shows_survives_a_run_of_the_other_tab(timers, tmp_path):
    tabs = all_sessions()
    one, two = tabs.of("one"), tabs.of("two")
    kept = shown(tmp_path / "kept")
    tabs.show(one, one.begin(), kept, [(7, 8)])
    two.secret = one.secret  # the browser copies a tab with its storage
    tabs.show(one, one.begin(), shown(), [])
    assert tabs.result(two).shown is kept and (tmp_path / "kept").exists()
    assert tabs.result(one).shown is not kept
    tabs.show(two, two.begin(), shown(), [])
    assert not (tmp_path / "kept").exists(), "no tab shows it"


def test_a_tab_that_leaves_ends_its_run_and_its_result_soon_unless_another_one_has_it(timers, tmp_path):
    sessions = all_sessions()
    secrets = [sessions.store.add(Result(shown())) for _ in range(2)]
    for name, secret in (("a", secrets[0]), ("b", secrets[0]), ("c", secrets[1])):
        sessions.of(name).secret = secret
    first = sessions.of("a")
    assert (
        first is sessions.of("a")
        and first is not sessions.of(None)
        and sessions.of(None) is sessions.of(None)
    )
    runs = [sessions.of(name).begin() for name in "ab"]
    sessions.leave("a")
    assert [run.stop.is_set() for run in runs] == [True, False]
    assert len(timers) == 2, "the reloaded tab has the result"
    sessions.leave("b")
    assert timers[2].seconds == 10 and timers[0].is_cancelled and not timers[1].is_cancelled
    timers[2].call()
    assert sessions.store.get(secrets[0]) is None and sessions.store.get(secrets[1]) is not None
    assert sessions.of("a") is not first and sessions.of("a").secret == ""
    sessions.leave("stranger")


def test_uploads_of_a_tab_go_with_it_but_not_those_of_others(tmp_path):
    sessions, folders = all_sessions(), [tmp_path / name for name in "abc"]
    for folder in folders:
        folder.mkdir()
        (folder / "file").touch()
    sessions.of("one").uploads |= {folders[0], folders[1]}
    sessions.of("two").uploads |= {folders[1], folders[2]}
    sessions.leave("one")
    assert [folder.exists() for folder in folders] == [False, True, True]


def test_empty_folders_of_uploads_go_after_a_minute(tmp_path):
    for name, age, content in (("old", 70, None), ("new", 50, None), ("full", 70, "x")):
        (tmp_path / name).mkdir()
        if content:
            (tmp_path / name / content).touch()
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    (tmp_path / "file").touch()
    os.utime(tmp_path / "file", (0, 0))
    delete_uploads([tmp_path / "none"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "full", "new"]


def test_runs_come_in_turn_and_each_knows_how_many_are_before_it(monkeypatch):
    monkeypatch.setattr(sessions.time, "sleep", lambda _: None)
    queue, runs, order, reported = RunQueue(), [Run() for _ in range(3)], [], {1: [], 2: []}
    began = [threading.Event() for _ in range(3)]
    threads = []

    def run(number):
        def notify(before):
            reported[number].append(before)
            began[number].set()

        with queue.acquire(runs[number], notify):
            order.append(number)

    with queue.acquire(runs[0], lambda _: pytest.fail("nobody is before the first")):
        for number in (1, 2):
            threads.append(threading.Thread(target=run, args=(number,)))
            threads[-1].start()
            assert began[number].wait(20)
        assert order == [] and queue._waiting == runs[1:]
    for thread in threads:
        thread.join(20)
    assert order == [1, 2] and set(reported[1]) == {1} and reported[2][0] == 1 and queue._waiting == []


def test_a_visitor_who_stops_while_waiting_gives_up_the_place(monkeypatch):
    monkeypatch.setattr(sessions.time, "sleep", lambda _: None)
    queue, first, second, third = RunQueue(), Run(), Run(), Run()
    with queue.acquire(first, print):
        with pytest.raises(Stopped), queue.acquire(second, lambda _: second.stop.set()):
            pass
        assert queue._waiting == []
        counts = []

        def notify(before):
            counts.append(before)
            third.stop.set()

        with pytest.raises(Stopped), queue.acquire(third, notify):
            pass
        assert counts == [1]
    with pytest.raises(RuntimeError), queue.acquire(first, print):
        raise RuntimeError("of the run")
    with queue.acquire(Run(), print):
        assert queue._waiting == []


def test_eight_runs_may_wait(monkeypatch):
    queue = RunQueue()
    queue._waiting = [Run() for _ in range(8)]
    with pytest.raises(InputError, match="The queue is full"), queue.acquire(Run(), print):
        pass
    queue._waiting.pop()
    stopped = Run()
    stopped.stop.set()
    with pytest.raises(Stopped), queue.acquire(stopped, print):
        pass
    assert len(queue._waiting) == 7


def test_runs_are_compared_by_identity():
    """A comparison by value runs Python code, during which another thread can change the queue."""
    assert Run() != Run() and len({Run(), Run()}) == 2
