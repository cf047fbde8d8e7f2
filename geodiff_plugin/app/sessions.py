"""Sessions of the web app: open tabs with uploads, runs and results, stored results, and the run queue."""

from __future__ import annotations

import ctypes
import gc
import secrets
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from shutil import rmtree

from geodiff_plugin.app.messages import PageError
from geodiff_plugin.app.shown import Pixels, Shown

#: A result is deleted after this time.
FORGET_AFTER_S = 600
#: A closed tab keeps its result for this time, so that a reload finds it.
RELOAD_S = 10
#: Number of queued runs; further visitors are asked to try again later.
MAX_WAITING = 8
#: An empty upload folder younger than this may be about to receive a file.
MIN_EMPTY_AGE_S = 60


class Stopped(Exception):
    """Raised in a run that the visitor stopped, or replaced by a later one."""


def forget(shown: Shown) -> None:
    """Delete a result's files and return its memory to the system."""
    if shown.folder is not None:
        rmtree(shown.folder, ignore_errors=True)
    gc.collect()
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)  # glibc keeps freed memory otherwise, more after every job


def delete_uploads(folders: Iterable[Path]) -> None:
    """Delete these folders, and empty folders left by the server's clean-up."""
    for folder in folders:
        rmtree(folder, ignore_errors=True)
    for folder in Path(tempfile.gettempdir()).iterdir():
        with suppress(OSError):  # not empty, or already deleted
            if folder.is_dir() and time.time() - folder.stat().st_mtime > MIN_EMPTY_AGE_S:
                folder.rmdir()


@dataclass(eq=False)
class Result:
    """A result on display, and the pixels measured in it; ``writing`` is held while its files are written."""

    shown: Shown
    pixels: Pixels = field(default_factory=list)
    writing: threading.Lock = field(default_factory=threading.Lock)


class ResultStore:
    """Stores results until they expire, keyed by a secret that only the visitor's browser knows."""

    def __init__(self) -> None:
        self._results: dict[str, Result] = {}
        self._ends: dict[str, threading.Timer] = {}
        self._lock = threading.Lock()

    def add(self, result: Result) -> str:
        """Store a result for ``FORGET_AFTER_S`` and return its secret."""
        secret = secrets.token_hex(16)
        self._results[secret] = result
        self.end_in(secret, FORGET_AFTER_S)
        return secret

    def get(self, secret: str) -> Result | None:
        """Return the result of a secret, or ``None`` if it has expired."""
        return self._results.get(secret)

    def add_files(self, secret: str, folder: Path) -> bool:
        """Add the files of a result; delete them and return ``False`` if it has expired meanwhile."""
        with self._lock:
            if result := self._results.get(secret):
                result.shown = replace(result.shown, folder=folder)
                return True
        rmtree(folder, ignore_errors=True)
        return False

    def end_in(self, secret: str, seconds: float) -> None:
        """Reset the time until a result expires."""
        with self._lock:
            if secret not in self._results:
                return
            if before := self._ends.pop(secret, None):
                before.cancel()
            timer = self._ends[secret] = threading.Timer(seconds, self.drop, [secret])
            timer.daemon = True
            timer.start()

    def drop(self, secret: str) -> None:
        """Delete a result now."""
        with self._lock:
            result, timer = self._results.pop(secret, None), self._ends.pop(secret, None)
        if timer is not None:
            timer.cancel()
        if result is not None:
            forget(result.shown)


@dataclass(eq=False)
class Run:
    """One run of a visitor. Compared by identity, so that ``list.index`` finds this one."""

    stop: threading.Event = field(default_factory=threading.Event)


@dataclass(eq=False)
class Session:
    """One open tab.

    Attributes:
        first: the precomputed result with this visitor's points, on display until the first run.
        secret: secret of the result on display; empty for the precomputed one.
        drawn: secret of the result that the page shows; not yet ``secret`` if a later run began meanwhile.
        run: the latest run, ``None`` when it has ended.
        uploads: folders of the visitor's uploads.
        tab: name of the open tab of the result.
    """

    first: Result
    secret: str = ""
    drawn: str = ""
    run: Run | None = None
    uploads: set[Path] = field(default_factory=set)
    tab: str = ""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def begin(self) -> Run:
        """Begin a run, which replaces the previous one."""
        with self.lock:
            if self.run is not None:
                self.run.stop.set()
            self.run = Run()
            return self.run

    def end(self, run: Run) -> bool:
        """End a run; return whether it was the latest one."""
        with self.lock:
            latest = self.run is run
            self.run = None if latest else self.run
            return latest

    def stop(self) -> None:
        """Stop the latest run before its next step."""
        with self.lock:
            if self.run is not None:
                self.run.stop.set()


class Sessions:
    """Open tabs by gradio's session hash; API calls may have none."""

    def __init__(self, store: ResultStore, first: Callable[[], Result]) -> None:
        self.store = store
        self._first = first
        self._of: dict[str | None, Session] = {}

    def of(self, name: str | None) -> Session:
        """Return the session of a hash, created if missing."""
        return self._of.setdefault(name, Session(self._first()))

    def result(self, session: Session) -> Result | None:
        """Return the result on display in a tab; ``None`` if it has expired."""
        return self.store.get(session.secret) if session.secret else session.first

    def show(self, session: Session, run: Run, shown: Shown, pixels: Pixels) -> None:
        """Make this the result of a tab, in place of the previous one.

        Raises:
            Stopped: The visitor stopped or replaced the run in its last stage, or closed the tab.
        """
        with session.lock:
            if session.run is not run or run.stop.is_set():
                raise Stopped
            before = session.secret
            session.secret = self.store.add(Result(shown, pixels))
        if not self._is_shown(before):
            self.store.drop(before)

    def _is_shown(self, secret: str) -> bool:
        """Whether an open tab shows this result, such as the duplicate of a tab that no longer does."""
        return any(session.secret == secret for session in list(self._of.values()))

    def leave(self, name: str | None) -> None:
        """Stop a session's run, delete its uploads unless shared, and expire its result in ``RELOAD_S``."""
        session = self._of.pop(name, None)
        if session is None:
            return
        session.stop()
        delete_uploads(session.uploads.difference(*(other.uploads for other in self._of.values())))
        if not self._is_shown(session.secret):  # a reloaded tab uses it again
            self.store.end_in(session.secret, RELOAD_S)


class RunQueue:
    """Run queue: one run at a time in order of arrival, with a limited length."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[Run] = []

    @contextmanager
    def acquire(self, run: Run, notify: Callable[[int], None]) -> Iterator[None]:
        """Wait for the earlier runs, and hold the queue's lock inside the block.

        Calls ``notify`` with the number of runs ahead while it waits.

        Raises:
            PageError: The queue is full.
            Stopped: The visitor stopped or replaced the run.
        """
        if len(self._waiting) >= MAX_WAITING:
            raise PageError("The queue is full. Please try again in a few minutes.")
        self._waiting.append(run)
        try:
            while self._waiting[0] is not run or not self._lock.acquire(timeout=0.2):
                if run.stop.is_set():
                    raise Stopped
                notify(max(1, self._waiting.index(run)))
                time.sleep(0.3)
        finally:
            self._waiting.remove(run)
        try:
            yield
        finally:
            self._lock.release()
