"""Results, tabs and turns on the server: who has what, for how long, and in which order."""

import os
import threading
import time
from types import SimpleNamespace

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.app import keeping
from geodiff_plugin.app.keeping import Keeper, Session, Sessions, Stopped, Turns, delete_uploads, forget


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
    monkeypatch.setattr(keeping.threading, "Timer", Timer)
    return Timer.made


@pytest.fixture(autouse=True)
def _temporary(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def shown(folder=None):
    if folder is not None:
        folder.mkdir()
    return SimpleNamespace(folder=folder)


def test_a_result_is_kept_for_ten_minutes_by_its_own_secret(timers, tmp_path):
    keeper, results = Keeper(), [shown(tmp_path / "a"), shown(tmp_path / "b")]
    secrets = [keeper.add(each) for each in results]
    assert len(set(secrets)) == 2 and all(len(secret) == 32 for secret in secrets)
    assert [keeper.get(secret) for secret in secrets] == results and keeper.get("") is None
    assert [timer.seconds for timer in timers] == [600, 600]
    keeper.end_in(secrets[0], 10)
    assert timers[0].is_cancelled and not timers[1].is_cancelled and timers[2].seconds == 10
    timers[2].call()
    assert keeper.get(secrets[0]) is None and keeper.get(secrets[1]) is results[1]
    assert not (tmp_path / "a").exists() and (tmp_path / "b").exists()
    keeper.end_in(secrets[0], 10)
    assert len(timers) == 3, "what is forgotten has no end any more"
    keeper.drop(secrets[1])
    assert timers[1].is_cancelled and not (tmp_path / "b").exists() and keeper.get(secrets[1]) is None
    keeper.drop(secrets[1])
    forget(shown())


def test_a_tab_that_leaves_ends_its_run_and_its_result_soon_unless_another_one_has_it(timers, tmp_path):
    sessions = Sessions(Keeper())
    secrets = [sessions.keeper.add(shown()) for _ in range(2)]
    for name, secret in (("a", secrets[0]), ("b", secrets[0]), ("c", secrets[1])):
        sessions.of(name).secret = secret
    first = sessions.of("a")
    assert (
        first is sessions.of("a")
        and first is not sessions.of(None)
        and sessions.of(None) is sessions.of(None)
    )
    sessions.leave("a")
    assert first.stop.is_set() and not sessions.of("b").stop.is_set()
    assert len(timers) == 2, "the reloaded tab has the result"
    sessions.leave("b")
    assert timers[2].seconds == 10 and timers[0].is_cancelled and not timers[1].is_cancelled
    timers[2].call()
    assert sessions.keeper.get(secrets[0]) is None and sessions.keeper.get(secrets[1]) is not None
    assert sessions.of("a") is not first and sessions.of("a").secret == ""
    sessions.leave("stranger")


def test_uploads_of_a_tab_go_with_it_but_not_those_of_others(tmp_path):
    sessions, folders = Sessions(Keeper()), [tmp_path / name for name in "abc"]
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
    monkeypatch.setattr(keeping.time, "sleep", lambda _: None)
    turns, sessions, order, told = Turns(), [Session() for _ in range(3)], [], {1: [], 2: []}
    began = [threading.Event() for _ in range(3)]
    threads = []

    def run(number):
        def tell(before):
            told[number].append(before)
            began[number].set()

        with turns.turn(sessions[number], tell):
            order.append(number)
            assert sessions[number].runs

    with turns.turn(sessions[0], lambda _: pytest.fail("nobody is before the first")):
        for number in (1, 2):
            threads.append(threading.Thread(target=run, args=(number,)))
            threads[-1].start()
            assert began[number].wait(20)
        assert order == [] and [session.runs for session in sessions] == [True] * 3
    for thread in threads:
        thread.join(20)
    assert order == [1, 2] and set(told[1]) == {1} and told[2][0] == 1 and not any(s.runs for s in sessions)


def test_a_visitor_who_stops_while_waiting_gives_up_the_place(monkeypatch):
    monkeypatch.setattr(keeping.time, "sleep", lambda _: None)
    turns, first, second, third = Turns(), Session(), Session(), Session()
    with turns.turn(first, print):
        with pytest.raises(Stopped), turns.turn(second, lambda _: second.stop.set()):
            pass
        assert not second.runs and first.runs
        counts = []

        def tell(before):
            counts.append(before)
            third.stop.set()

        with pytest.raises(Stopped), turns.turn(third, tell):
            pass
        assert counts == [1]
        with pytest.raises(InputError, match="Your last run still works"), turns.turn(first, print):
            pass
        assert first.runs, "a second click does not end the first run"
    assert not first.runs
    with pytest.raises(RuntimeError), turns.turn(first, print):
        raise RuntimeError("of the run")
    with turns.turn(third, print):
        assert third.runs


def test_eight_runs_may_wait(monkeypatch):
    turns = Turns()
    turns._waiting = [Session() for _ in range(8)]
    with pytest.raises(InputError, match="Many visitors are waiting already"), turns.turn(Session(), print):
        pass
    turns._waiting.pop()
    stopped = Session()
    stopped.stop.set()
    with pytest.raises(Stopped), turns.turn(stopped, print):
        pass
    assert len(turns._waiting) == 7
