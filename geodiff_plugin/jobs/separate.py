"""A process that does some of the work of this one, whose threads share one lock of Python.

A thread that draws and writes in the process that feeds a GPU gives up Python's lock dozens of times a
result, and waits each time until the threads that launch kernels let it have it back.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from queue import LifoQueue
from typing import Any, TypeVar

from geodiff_plugin._checks import InputError, noted, warn
from geodiff_plugin.jobs.telling import collected_warnings, silent
from geodiff_plugin.messages import Message

Answer = TypeVar("Answer")


class ProcessEnded(InputError):
    """The other process is gone: killed, or out of memory."""


@dataclass(frozen=True)
class _Outcome:
    """What became of a call: its answer or its error, and what it warned of."""

    answer: Any = None
    error: Exception | None = None
    warned: tuple[Message, ...] = ()


class SeparateProcess:
    """Calls functions in a Python process of its own, one after the other.

    Arguments and answers are pickled, tensors on the CPU among them. Unlike a process of ``multiprocessing``
    it does not run the main module of the program again, so a script needs no guard. Ctrl-C does not reach
    it: it ends what it is at, and itself when it is closed, or when this process is gone.

    Args:
        module: imported at once, so that the first call need not wait for it.
    """

    def __init__(self, module: str) -> None:
        lines = [
            f"import sys; sys.path[:] = {sys.path!r}",
            "from geodiff_plugin._lazy import uncollected",
            f"with uncollected(): import {__name__}, {module}",
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
            ProcessEnded: there is no answer, and will be none to further calls.
            Exception: what the function raised, with its traceback as a note.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            pickle.dump((function, args), self._process.stdin, protocol=5)  # arrays are written uncopied
            self._process.stdin.flush()
            outcome: _Outcome = pickle.load(self._process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            ended = f"A process that writes results has ended (exit code {self._process.wait()})."
            cure = "Is there enough memory? Finished results stay; the same command goes on with the rest."
            raise ProcessEnded(f"{ended} {cure}") from error
        for message in outcome.warned:
            warn(message)
        if outcome.error is not None:
            raise outcome.error
        return outcome.answer

    def leave(self) -> None:
        """Let it end once it has done what it is at."""
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # it ended before
                assert stream is not None
                stream.close()

    def close(self) -> None:
        """Let it end, and wait until it has."""
        self.leave()
        self._process.wait()


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
        for process in self._all:
            process.leave()
        for process in self._all:
            process.close()


def serve() -> None:
    """Do what standard input asks for until it ends, and answer on standard output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests, answers = open(0, "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    with collected_warnings(silent):  # the process that asks tells them
        while requests.peek(1):
            pickle.dump(_answer(requests), answers, protocol=5)
            answers.flush()


def _answer(requests: BufferedReader) -> _Outcome:
    """Read one call and do it."""
    answer, error = None, None
    with noted() as warned:
        try:
            function, args = pickle.load(requests)
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
