"""Who has what on the server: open tabs with their uploads and runs, and results, each for a while."""

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
from dataclasses import dataclass, field
from pathlib import Path
from shutil import rmtree

from geodiff_plugin._checks import refuse
from geodiff_plugin.app.shown import Shown

#: A result is deleted after this long.
FORGET_AFTER_S = 600
#: A tab that was closed may come back within this time, as on a reload.
AWAY_S = 10
#: Runs that wait; a further visitor is asked to come back.
MOST_WAITING = 8
#: An empty folder of uploads that is younger may be about to get a file.
EMPTY_FOR_S = 60


class Stopped(Exception):
    """The visitor asked to stop."""


def forget(shown: Shown) -> None:
    """Delete a result's files, and give its memory back."""
    if shown.folder is not None:
        rmtree(shown.folder, ignore_errors=True)
    gc.collect()
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)  # else glibc keeps freed memory, more of it after every job


def delete_uploads(folders: Iterable[Path]) -> None:
    """Delete these folders, and empty ones that the server's clean-up has left beside them."""
    for folder in folders:
        rmtree(folder, ignore_errors=True)
    for folder in Path(tempfile.gettempdir()).iterdir():
        with suppress(OSError):  # not empty, or gone
            if folder.is_dir() and time.time() - folder.stat().st_mtime > EMPTY_FOR_S:
                folder.rmdir()


class Keeper:
    """Results by a secret that only their visitor's browser has, each until its time is over."""

    def __init__(self) -> None:
        self._shown: dict[str, Shown] = {}
        self._ends: dict[str, threading.Timer] = {}
        self._lock = threading.Lock()

    def add(self, shown: Shown) -> str:
        """Keep a result for ``FORGET_AFTER_S``; its secret."""
        secret = secrets.token_hex(16)
        self._shown[secret] = shown
        self.end_in(secret, FORGET_AFTER_S)
        return secret

    def get(self, secret: str) -> Shown | None:
        """The result of a secret, while it is kept."""
        return self._shown.get(secret)

    def end_in(self, secret: str, seconds: float) -> None:
        """Forget a result in so many seconds, instead of when it was to be forgotten before."""
        with self._lock:
            if secret not in self._shown:
                return
            if before := self._ends.pop(secret, None):
                before.cancel()
            timer = self._ends[secret] = threading.Timer(seconds, self.drop, [secret])
            timer.daemon = True
            timer.start()

    def drop(self, secret: str) -> None:
        """Forget a result now."""
        with self._lock:
            shown, timer = self._shown.pop(secret, None), self._ends.pop(secret, None)
        if timer is not None:
            timer.cancel()
        if shown is not None:
            forget(shown)


@dataclass
class Session:
    """One open tab: what ends its run, whether one runs, the folders of its uploads, and its last result."""

    stop: threading.Event = field(default_factory=threading.Event)
    runs: bool = False
    uploads: set[Path] = field(default_factory=set)
    secret: str = ""


class Sessions:
    """The open tabs by gradio's name for them; a call over the API may have none."""

    def __init__(self, keeper: Keeper) -> None:
        self.keeper = keeper
        self._of: dict[str | None, Session] = {}

    def of(self, name: str | None) -> Session:
        """The session of a name."""
        return self._of.setdefault(name, Session())

    def leave(self, name: str | None) -> None:
        """End a session's run, and delete what no other one has: the uploads now, its result soon."""
        session = self._of.pop(name, Session())
        session.stop.set()
        delete_uploads(session.uploads.difference(*(other.uploads for other in self._of.values())))
        if all(other.secret != session.secret for other in self._of.values()):  # a reloaded tab has it again
            self.keeper.end_in(session.secret, AWAY_S)


class Turns:
    """One run at a time, in the order of coming, one a visitor and not too many that wait."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._waiting: list[Session] = []

    @contextmanager
    def turn(self, session: Session, tell: Callable[[int], None]) -> Iterator[None]:
        """Hold the turn; until then ``tell`` is called with how many runs are before this one.

        Raises:
            InputError: the visitor's last run still works, or too many wait.
            Stopped: the visitor asked to stop.
        """
        if session.runs:
            refuse("Your last run still works: wait for it, or stop it.")
        if len(self._waiting) >= MOST_WAITING:
            refuse("Many visitors are waiting already. Please try again in a few minutes.")
        session.runs = True
        self._waiting.append(session)
        try:
            while self._waiting[0] is not session or not self._turn.acquire(timeout=0.2):
                if session.stop.is_set():
                    raise Stopped
                tell(max(1, self._waiting.index(session)))
                time.sleep(0.3)
            self._waiting.remove(session)
            try:
                yield
            finally:
                self._turn.release()
        finally:
            session.runs = False
            if session in self._waiting:
                self._waiting.remove(session)
