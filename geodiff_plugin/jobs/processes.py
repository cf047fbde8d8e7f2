"""Worker processes for part of a job's work.

The threads of a process share the GIL. A thread that draws and writes results next to one that launches GPU
kernels releases the GIL dozens of times per result, and waits each time to get it back. On a CPU, several
processes compute the frames of a capture, one per core.

A worker is a ``multiprocessing`` process, started by "spawn", with a pipe. Executors are unsuitable. If a
worker of ``ProcessPoolExecutor`` or loky is killed, the calls of all others fail as well, an exception that
cannot be unpickled breaks the pool, and workers outlive a killed parent. ``multiprocessing.Pool`` waits
forever for a killed worker. This module adds what ``multiprocessing`` lacks:

- A program without ``if __name__ == "__main__":`` is not run again by its workers.
- An exception that cannot be unpickled arrives as a ``RuntimeError`` with its text.
- Warnings are raised in the calling process.
- A worker whose parent was killed removes its temporary files and exits.
- Ctrl-C reaches only the parent, which terminates the workers; they remove their temporary files.
- Tensors are pickled without the reducers that torch adds to ``multiprocessing``. These use shared memory, of
  which a container has 64 MB by default; exceeding it is a bus error. Arrays are sent without a copy, because
  copying would hold the GIL for hundreds of milliseconds.
"""

from __future__ import annotations

import ast
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from queue import LifoQueue
from threading import Lock, Thread
from types import ModuleType
from typing import Any, TypeVar

from geodiff_plugin._internal.checks import InputError, captured_warnings, warn
from geodiff_plugin._internal.lazy import gc_frozen
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs.notices import collected_warnings, silent
from geodiff_plugin.jobs.stopping import Terminated, ending_on_sigterm

Answer = TypeVar("Answer")
#: Number of bytes per send; the receiver allocates as much memory per read as it expects.
CHUNK = 1 << 23


class ProcessEnded(InputError):
    """Raised if a worker was killed, is out of memory, or could not start."""


@dataclass(frozen=True)
class _Outcome:
    """Return value or exception of a call, and its warnings."""

    answer: Any = None
    error: Exception | None = None
    warned: tuple[Finding, ...] = ()


class WorkerProcess:
    """Calls functions in a separate Python process, one at a time.

    Arguments and results are pickled, including CPU tensors. The worker is a daemon of ``multiprocessing``:
    it exits with this process.

    Args:
        module: module to import at the start, so that the first call does not wait for it.
        extended: whether it needs priors, formats etc. that the program may have added to the package. If so,
            a program with ``if __name__ == "__main__":`` is run again up to that guard.

    Raises:
        RuntimeError: this process is a worker that runs its program again, outside the guard.
    """

    def __init__(self, module: str, *, extended: bool = False) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._connection, theirs = spawn.Pipe()
        self._process = spawn.Process(target=serve, args=(theirs, module), daemon=True)
        with nullcontext() if extended and _program_has_guard() else _program_hidden(), _sigint_blocked():
            self._process.start()
        theirs.close()  # otherwise the pipe would stay open after the worker has exited

    def call(self, function: Callable[..., Answer], *args: Any) -> Answer:
        """Call ``function(*args)``, a function of a module; wait for the result without the GIL.

        Raises:
            ProcessEnded: there is no result, and further calls will have none. A function that raises it ends
                the process.
            Exception: the function's exception, with its traceback as a note.
        """
        try:
            _send(self._connection, (function, args))
            outcome: _Outcome = _receive(self._connection)
        except (OSError, EOFError) as error:
            self._process.join()
            ended = f"A worker process ended (exit code {self._process.exitcode})."
            raise ProcessEnded(f"{ended} Check that there is enough memory.") from error
        for message in outcome.warned:
            warn(message)
        if isinstance(outcome.error, ProcessEnded):  # an idle worker would still count as alive
            self.end()
        if outcome.error is not None:
            raise outcome.error
        return outcome.answer

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._process.is_alive()

    def end(self) -> None:
        """Terminate the process after its cleanup; a pending call raises ``ProcessEnded``."""
        self._process.terminate()

    def leave(self) -> None:
        """Let the process exit; no call may be pending."""
        self._connection.close()

    def close(self) -> None:
        """Let the process exit, and wait for it."""
        self.leave()
        self._process.join()


def close_all(processes: Sequence[WorkerProcess]) -> None:
    """Let all processes exit, and wait for them."""
    for process in processes:
        process.leave()
    for process in processes:
        process.close()


class WorkerProcesses:
    """Pool of workers; each call uses a free worker, from a thread of the caller's.

    Arguments are the same as in ``WorkerProcess``.
    """

    def __init__(self, module: str, count: int) -> None:
        self._all = [WorkerProcess(module) for _ in range(count)]
        self._free = LifoQueue[WorkerProcess]()  # last in, first out: the most recent worker has a warm cache
        for process in self._all:
            self._free.put(process)

    def call(self, function: Callable[..., Answer], *args: Any) -> Answer:
        """Call ``WorkerProcess.call`` of a free worker, waiting for one if necessary."""
        process = self._free.get()
        try:
            return process.call(function, *args)
        finally:
            self._free.put(process)

    def close(self) -> None:
        """Let all workers exit, and wait for them."""
        close_all(self._all)


def can_have_workers() -> bool:
    """Whether this process may have workers: not if it is a daemon of ``multiprocessing``."""
    return not multiprocessing.current_process().daemon


def _program_has_guard() -> bool:
    """Whether the program's file contains ``__name__``; false if there is no file."""
    try:
        path = getattr(sys.modules["__main__"], "__file__", None) or ""
        statements = ast.parse(Path(path).read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return False
    tested = [node for each in statements if isinstance(each, ast.If) for node in ast.walk(each.test)]
    return any(isinstance(node, ast.Name) and node.id == "__name__" for node in tested)


_hiding = Lock()


@contextmanager
def _program_hidden() -> Iterator[None]:
    """Prevent a process started inside the block from running the program's file."""
    with _hiding:
        program = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = program


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block Ctrl-C in a process started inside the block until it ignores the signal."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _send(connection: Connection, value: Any) -> None:
    """Send a pickle, followed by its arrays."""
    arrays = list[pickle.PickleBuffer]()
    pickled = pickle.dumps(value, protocol=5, buffer_callback=arrays.append)
    buffers = [array.raw() for array in arrays]
    connection.send((pickled, [buffer.nbytes for buffer in buffers]))
    for buffer in buffers:
        for start in range(0, buffer.nbytes, CHUNK):
            connection.send_bytes(buffer[start : start + CHUNK])


def _receive(connection: Connection) -> Any:
    """Receive a value of ``_send``; raise ``EOFError`` if the other end is closed."""
    pickled, sizes = connection.recv()
    buffers = [bytearray(size) for size in sizes]
    for buffer in buffers:
        for start in range(0, len(buffer), CHUNK):
            connection.recv_bytes_into(buffer, start)
    return pickle.loads(pickled, buffers=buffers)


def serve(connection: Connection, module: str) -> None:
    """Run a worker: answer calls from a connection until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        os.setsid()  # Ctrl-C and signals to the parent's process group do not reach the worker
    os.dup2(2, 1)  # keep output of libraries out of stdout
    with gc_frozen():
        import_module(module)
    Thread(target=_end_with_parent, daemon=True).start()
    try:
        # The calling process reports the warnings.
        with ending_on_sigterm(), collected_warnings(silent), suppress(EOFError):
            while True:
                function, args = _receive(connection)
                _send(connection, _outcome(function, args))
    except Terminated:
        sys.exit(128 + signal.SIGTERM)


def _end_with_parent() -> None:
    """Terminate this worker when its parent exits."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _outcome(function: Callable[..., Any], args: tuple[Any, ...]) -> _Outcome:
    answer, error = None, None
    with captured_warnings() as warned:
        try:
            answer = function(*args)
        except Exception as raised:
            error = _sendable(raised)
    return _Outcome(answer, error, tuple(warned))


def _sendable(error: Exception) -> Exception:
    """Return the error with its traceback, or a ``RuntimeError`` with its text if it cannot be pickled."""
    lines = "".join(traceback.format_exception(error))
    try:
        sent: Exception = pickle.loads(pickle.dumps(error))
    except Exception:  # classes of other libraries may not be picklable
        sent = RuntimeError(f"{type(error).__name__}: {error}")
    sent.add_note(lines)
    return sent
