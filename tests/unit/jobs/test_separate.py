"""A process that works for this one, with its pipes in hand: what is asked, answered and passed on."""

import io
import pickle
import signal
import sys
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace

import pytest

from geodiff_plugin._checks import warn
from geodiff_plugin.jobs import separate
from geodiff_plugin.jobs.separate import ProcessEnded, SeparateProcess, SeparateProcesses, close_all
from geodiff_plugin.messages import Message

WARNING = Message("camera.filled-in", "cy is assumed.")


def twice(value):
    warn(WARNING)
    return 2 * value


def fails(value):
    raise ValueError(f"{value} is no number")


class Odd(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, one, two):
        super().__init__(f"{one}{two}")


def fails_oddly():
    raise Odd("no", "body")


class Requests(io.BytesIO):
    """A pipe of requests, which can be looked into."""

    def peek(self, count):
        at = self.tell()
        found = self.read(count)
        self.seek(at)
        return found


@contextmanager
def no_signals():
    yield


@pytest.mark.filterwarnings("ignore:cy is assumed")
def test_requests_are_answered_one_after_the_other_with_what_was_warned_of(monkeypatch):
    requests = Requests()
    for request in ((twice, (21,)), (fails, ("x",)), (fails_oddly, ()), (twice, ([1],))):
        pickle.dump(request, requests)
    requests.seek(0)
    answers, asked = io.BytesIO(), []
    answers.close = lambda: None
    system = SimpleNamespace(
        dup=lambda number: asked.append(("dup", number)) or 9,
        dup2=lambda *numbers: asked.append(("dup2", *numbers)),
        fdopen=lambda number, mode: asked.append((number, mode)) or answers,
    )
    monkeypatch.setattr(separate, "os", system)
    monkeypatch.setattr(
        separate, "open", lambda number, mode: asked.append((number, mode)) or requests, raising=False
    )
    monkeypatch.setattr(separate, "ending_on_sigterm", no_signals)
    monkeypatch.setattr(separate, "_end_with_asker", lambda found, answered: asked.append(found is requests))
    monkeypatch.setattr(separate.signal, "signal", lambda *given: asked.append(given))
    separate.serve()
    assert asked[:5] == [(signal.SIGINT, signal.SIG_IGN), (0, "rb"), ("dup", 1), (9, "wb"), ("dup2", 2, 1)]
    assert asked[5:] == [True] * 4
    answers.seek(0)
    first, second, third, fourth = (pickle.load(answers) for _ in range(4))
    assert (first.answer, first.error, first.warned) == (42, None, (WARNING,))
    assert isinstance(second.error, ValueError) and str(second.error) == "x is no number"
    assert "Traceback" in second.error.__notes__[0] and second.answer is None and second.warned == ()
    assert type(third.error) is RuntimeError and str(third.error) == "Odd: nobody"
    assert "fails_oddly" in third.error.__notes__[0] and fourth.answer == [1, 1]


def test_a_process_that_nobody_asks_any_more_ends(monkeypatch):
    killed = []
    monkeypatch.setattr(separate.os, "kill", lambda *given: killed.append(given))
    for pending, answered, ends in ((b"more", False, False), (b"", True, False), (b"", False, True)):
        killed.clear()
        separate._end_with_asker(Requests(pending), SimpleNamespace(is_set=lambda set_=answered: set_))
        assert killed == ([(separate.os.getpid(), signal.SIGTERM)] if ends else [])


class Process:
    """A process whose answers are ready."""

    def __init__(self, *answers, code=7):
        self.stdin, self.stdout, self.code, self.waited = io.BytesIO(), io.BytesIO(), code, 0
        self.terminated = False
        for answer in answers:
            pickle.dump(answer, self.stdout)
        self.stdout.seek(0)

    def wait(self):
        self.waited += 1
        return self.code

    def poll(self):
        return self.code if self.terminated else None

    def terminate(self):
        self.terminated = True


def started(monkeypatch, *answers, **named) -> tuple[SeparateProcess, Process, list]:
    process, asked = Process(*answers), []
    monkeypatch.setattr(
        separate.subprocess, "Popen", lambda *given, **more: asked.append((given, more)) or process
    )
    return SeparateProcess("math", **named), process, asked


def test_a_call_sends_its_function_and_returns_the_answer(monkeypatch):
    outcome = separate._Outcome(answer=5, warned=(WARNING,))
    made, process, asked = started(monkeypatch, outcome)
    with pytest.warns(UserWarning, match="cy is assumed"):
        assert made.call(twice, 3) == 5
    process.stdin.seek(0)
    assert pickle.load(process.stdin) == (twice, (3,))
    ((words,), settings) = asked[0]
    assert words[:2] == [sys.executable, "-c"] and settings["start_new_session"]
    assert settings["stdin"] == settings["stdout"] == separate.subprocess.PIPE
    assert (
        f"{sys.path!r}, {sys.argv!r}" in words[2] and "import geodiff_plugin.jobs.separate, math" in words[2]
    )
    assert "read_again(None)" in words[2] and words[2].endswith("geodiff_plugin.jobs.separate.serve()")
    with pytest.raises(ProcessEnded, match=r"A helper process has ended \(exit code 7\)"):
        made.call(twice, 3)
    assert made.alive and process.waited == 1


def test_an_error_is_raised_and_one_that_cannot_go_on_ends_its_process(monkeypatch):
    made, process, _ = started(
        monkeypatch, *map(lambda e: separate._Outcome(error=e), (KeyError("a"), ProcessEnded("b")))
    )
    with pytest.raises(KeyError):
        made.call(twice, 1)
    assert made.alive
    with pytest.raises(ProcessEnded, match="^b$"):
        made.call(twice, 1)
    assert not made.alive and process.terminated


def test_closing_lets_all_end_before_it_waits(monkeypatch):
    done = []

    class Made:
        def __init__(self, name):
            self.name = name

        def leave(self):
            done.append(("leave", self.name))

        def close(self):
            done.append(("close", self.name))

    close_all([Made("a"), Made("b")])
    assert done == [("leave", "a"), ("leave", "b"), ("close", "a"), ("close", "b")]
    made, process, _ = started(monkeypatch)
    made.close()
    assert process.stdin.closed and process.stdout.closed and process.waited == 1
    made.close()
    assert process.waited == 2

    def broken():
        raise BrokenPipeError

    made, process, _ = started(monkeypatch)
    process.stdin.close = broken
    made.close()
    assert process.stdout.closed


def test_the_process_that_was_last_free_gets_the_next_call(monkeypatch):
    calls, closed = [], []

    class Made:
        def __init__(self, module):
            self.module, self.number = module, len(calls)
            calls.append([])

        def call(self, function, *args):
            calls[self.number].append(args)
            return function(*args)

    monkeypatch.setattr(separate, "SeparateProcess", Made)
    monkeypatch.setattr(separate, "close_all", closed.append)
    processes = SeparateProcesses("math", 3)
    for value in range(4):
        assert processes.call(max, value, 2) == max(value, 2)
    with pytest.raises(ValueError, match="x is no number"):
        processes.call(fails, "x")
    assert processes.call(min, 4, 2) == 2, "the process is free again after an error"
    assert [len(each) for each in calls] == [0, 0, 6]
    processes.close()
    assert [made.module for made in closed[0]] == ["math"] * 3


@pytest.fixture
def main(monkeypatch):
    """Another program."""
    program = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", program)
    return program


def test_a_program_with_a_guard_is_run_again_by_its_path_or_its_module(main, tmp_path):
    file = tmp_path / "program.py"
    main.__file__ = str(file)
    for text, guarded in (
        ("if __name__ == '__main__':\n    pass\n", True),
        ("x = 1\nif x and not __name__ != '__main__':\n    pass\n", True),
        ("if True:\n    print(__name__)\n", False),
        ("__name__\n", False),
        ("if other == 1:\n    pass\n", False),
        ("if (\n", False),
    ):
        file.write_text(text)
        main.__spec__ = None
        assert separate._guarded_program() == (("run_path", str(file)) if guarded else None), text
        main.__spec__ = SimpleNamespace(name="pack.program")
        assert separate._guarded_program() == (("run_module", "pack.program") if guarded else None), text
    file.unlink()
    assert separate._guarded_program() is None
    del main.__file__
    assert separate._guarded_program() is None


def test_a_program_that_is_read_again_is_not_the_main_one_and_starts_no_process(tmp_path, monkeypatch):
    file, seen = tmp_path / "program.py", {}
    monkeypatch.setattr(sys, "seen_by_test", seen, raising=False)
    lines = "import sys\nfrom geodiff_plugin.jobs import separate\nsys.seen_by_test.update(name=__name__)\n"
    file.write_text(lines + "sys.seen_by_test.update(again=separate._reading_again)\n")
    separate.read_again(("run_path", str(file)))
    assert seen == {"name": "__mp_main__", "again": True} and separate._reading_again is False
    separate.read_again(None)
    monkeypatch.setattr(separate, "_reading_again", True)
    with pytest.raises(RuntimeError, match="belongs behind its"):
        SeparateProcess("math")


def test_a_process_that_needs_the_program_is_told_how_to_read_it(monkeypatch):
    monkeypatch.setattr(separate, "_guarded_program", lambda: ("run_path", "a.py"))
    _, _, asked = started(monkeypatch, extended=True)
    assert "read_again(('run_path', 'a.py'))" in asked[0][0][0][2]
    _, _, asked = started(monkeypatch)
    assert "read_again(None)" in asked[0][0][0][2]
