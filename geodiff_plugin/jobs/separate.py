"""A process that does some of the work of this one, whose threads share one lock of Python.

A thread that draws and writes in the process that feeds a GPU gives up Python's lock dozens of times a
result, and waits each time until the threads that launch kernels let it have it back. On a CPU frames of a
capture are made by several processes, one a core.
"""

from __future__ import annotations

import ast
import os
import pickle
import runpy
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from queue import LifoQueue
from threading import Event, Thread
from typing import Any, TypeVar

from geodiff_plugin._checks import InputError, noted, warn
from geodiff_plugin.jobs.stopping import Terminated, ending_on_sigterm
from geodiff_plugin.jobs.telling import collected_warnings, silent
from geodiff_plugin.messages import Message

Answer = TypeVar("Answer")


class ProcessEnded(InputError):
    """The other process does no more: it was killed, is out of memory, or could not begin."""


@dataclass(frozen=True)
class _Outcome:
    """What became of a call: its answer or its error, and what it warned of."""

    answer: Any = None
    error: Exception | None = None
    warned: tuple[Message, ...] = ()


class SeparateProcess:
    """Calls functions in a Python process of its own, one after the other.

    Arguments and answers are pickled, tensors on the CPU among them. Unlike a process of ``multiprocessing``
    it does not run a script again that has no guard, ``if __name__ == "__main__":``. Ctrl-C does not reach
    it: it ends when it is told to, and when this process is gone, and clears away what it is at.

    Args:
        module: imported at once, so that the first call need not wait for it.
        extended: whether it needs what the program may have added to the package, such as priors and formats.
            Then it runs a program with a guard again, which does its work behind that only.
    """

    def __init__(self, module: str, *, extended: bool = False) -> None:
        if _reading_again:
            raise RuntimeError('What the program does belongs behind its `if __name__ == "__main__":`.')
        lines = [
            f"import sys; sys.path[:], sys.argv[:] = {sys.path!r}, {sys.argv!r}",
            "from geodiff_plugin._lazy import uncollected",
            "with uncollected():",
            f"    import {__name__}, {module}",
            f"    {__name__}.read_again({_guarded_program() if extended else None})",
            f"{__name__}.serve()",
        ]
        self._process = subprocess.Popen(
            [sys.executable, "-c", "\n".join(lines)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )

    def call(self, function: Callable[..., Answer], *args: Any) -> Answer:
        """``function(*args)``, a function of a module; waits for it, without Python's lock.

        Raises:
            ProcessEnded: there is no answer, and will be none to further calls. A function that raises it
                ends the process.
            Exception: what the function raised, with its traceback as a note.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            pickle.dump((function, args), self._process.stdin, protocol=5)  # arrays are written uncopied
            self._process.stdin.flush()
            outcome: _Outcome = pickle.load(self._process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            ended = f"A helper process has ended (exit code {self._process.wait()})."
            raise ProcessEnded(f"{ended} Is there enough memory?") from error
        for message in outcome.warned:
            warn(message)
        if isinstance(outcome.error, ProcessEnded):  # idle, it would still count as alive
            self.end()
        if outcome.error is not None:
            raise outcome.error
        return outcome.answer

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def end(self) -> None:
        """Let it clear away what it is at, and end; another thread whose call it is gets ``ProcessEnded``."""
        self._process.terminate()

    def leave(self) -> None:
        """Let it end; no thread waits for a call."""
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # it ended before
                assert stream is not None
                stream.close()

    def close(self) -> None:
        """Let it end, and wait until it has."""
        self.leave()
        self._process.wait()


def close_all(processes: Sequence[SeparateProcess]) -> None:
    """Let all end, and wait until they have."""
    for process in processes:
        process.leave()
    for process in processes:
        process.close()


class SeparateProcesses:
    """As many calls at a time as there are processes, each made in a thread of the caller's.

    Arguments as of ``SeparateProcess``.
    """

    def __init__(self, module: str, count: int) -> None:
        self._all = [SeparateProcess(module) for _ in range(count)]
        self._free = LifoQueue[SeparateProcess]()  # the last one has what it needs in its caches
        for process in self._all:
            self._free.put(process)

    def call(self, function: Callable[..., Answer], *args: Any) -> Answer:
        """``SeparateProcess.call`` of one that does nothing else, once there is one."""
        process = self._free.get()
        try:
            return process.call(function, *args)
        finally:
            self._free.put(process)

    def close(self) -> None:
        """Let all end, and wait until they have."""
        close_all(self._all)


def _guarded_program() -> tuple[str, str] | None:
    """How ``runpy`` reads the program again; ``None`` where its file asks for no ``__name__``, or is none."""
    main = sys.modules["__main__"]
    spec, path = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    try:
        statements = ast.parse(Path(path or "").read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return None
    asked = [node for each in statements if isinstance(each, ast.If) for node in ast.walk(each.test)]
    if not any(isinstance(node, ast.Name) and node.id == "__name__" for node in asked):
        return None
    return ("run_module", spec.name) if spec else ("run_path", str(path))


#: Whether this process reads a program's file again.
_reading_again = False


def read_again(program: tuple[str, str] | None) -> None:
    """Run the program as a module, as ``multiprocessing`` would; what it adds to tables is then in them."""
    global _reading_again
    if program is not None:
        _reading_again = True
        getattr(runpy, program[0])(program[1], run_name="__mp_main__")
        _reading_again = False


def serve() -> None:
    """Do what standard input asks for until it ends, and answer on standard output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, answers = open(0, "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    try:
        with ending_on_sigterm(), collected_warnings(silent):  # the process that asks tells them
            while requests.peek(1):
                function, args = pickle.load(requests)
                answered = Event()
                watcher = Thread(target=_end_with_asker, args=(requests, answered), daemon=True)
                watcher.start()
                pickle.dump(_answer(function, args), answers, protocol=5)
                answers.flush()
                answered.set()
                watcher.join()
    except Terminated:
        sys.exit(128 + signal.SIGTERM)


def _end_with_asker(requests: BufferedReader, answered: Event) -> None:
    """Wait for the next request; if the process that asks is gone before it has an answer, end this one."""
    if not requests.peek(1) and not answered.is_set():
        os.kill(os.getpid(), signal.SIGTERM)


def _answer(function: Callable[..., Any], args: tuple[Any, ...]) -> _Outcome:
    answer, error = None, None
    with noted() as warned:
        try:
            answer = function(*args)
        except Exception as raised:
            error = _sendable(raised)
    return _Outcome(answer, error, tuple(warned))


def _sendable(error: Exception) -> Exception:
    """The error with its traceback, or one with its words where it cannot be pickled."""
    lines = "".join(traceback.format_exception(error))
    try:
        sent: Exception = pickle.loads(pickle.dumps(error))
    except Exception:  # of any library, with a signature of its own
        sent = RuntimeError(f"{type(error).__name__}: {error}")
    sent.add_note(lines)
    return sent
