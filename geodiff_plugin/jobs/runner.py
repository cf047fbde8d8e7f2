"""One resumable loop for long jobs: ``geodiff depth`` over many pairs, captures and the evaluation.

A ``Runner`` takes every ``Item`` without a result through the stages of the work and appends its record to a
``Journal``, a JSONL file. Several processes (``torchrun``, or two terminals) share a job by its journal: each
claims an item with a lock that the kernel gives back when the process ends, however it ends. The first waits
for what others have claimed, takes it over should they die, and returns the records of all. Failures are
records too, tried again by the next run. Nothing here imports torch.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import sys
import time
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import unwritable

try:
    import fcntl
except ImportError:  # Windows: two processes may do the same work twice
    fcntl = None  # type: ignore[assignment]

Record = dict[str, Any]
Stage = Callable[[Any], Any]

BROKEN, MOST_NAMES, POLL_S = "broken", 5, 0.2


def fingerprint(*parts: Any) -> str:
    """20 hexadecimal digits that name inputs: JSON values, and paths, which count by what the file holds."""
    text = json.dumps([_readable(part) for part in parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _readable(part: Any) -> Any:
    if isinstance(part, Path):
        try:
            return file_digest(part)
        except OSError:  # a folder, or what whoever reads it will complain of
            return None
    if isinstance(part, dict):
        return {name: _readable(value) for name, value in part.items()}
    return [_readable(value) for value in part] if isinstance(part, (list, tuple)) else part


@dataclass(frozen=True)
class Process:
    """Which of how many processes of a launcher this one is, from 0, and its index on its own machine."""

    index: int
    count: int
    local: int


def this_process() -> Process:
    """What ``torchrun`` or ``accelerate launch`` has put into the environment; one of one without them."""
    defaults = (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0))
    return Process(*(int(os.environ.get(name, default)) for name, default in defaults))


@dataclass(frozen=True, eq=False)
class Item:
    """One piece of work; a record of the same ``key`` and ``inputs`` (a fingerprint) says that it is done.

    The first stage works on ``payload``. ``head`` begins its record, also where it fails. ``words`` are texts
    of this item alone, such as its paths, which are no part of the cause of a failure; else its label.
    """

    key: str
    payload: Any = None
    inputs: str = ""
    name: str = ""
    words: tuple[str, ...] = ()
    head: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Its name in messages."""
        return self.name or self.key


class Journal:
    """Records of a job in a JSONL file that several processes may append to; failures in it do not count.

    An item is claimed by a lock on a byte of the file that its key names. The system drops these locks as
    soon as the process closes the file anywhere: it stays open, and nothing else may open it during a run.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._read_bytes = path, 0
        self._records: dict[tuple[str, str], Record] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(path, "a+b", buffering=0)
        except OSError as error:
            unwritable(path.parent, error)
        self.close = weakref.finalize(self, self._file.close)
        self.refresh()
        self._records = {key: r for key, r in self._records.items() if r.get("status") != BROKEN}

    def refresh(self) -> None:
        """Read what was appended since the last time; lines that a killed process left torn are skipped."""
        self._file.seek(self._read_bytes)
        *lines, torn = self._file.read().split(b"\n")
        self._read_bytes = self._file.tell() - len(torn)
        for line in lines:
            with suppress(ValueError):
                record = json.loads(line)
                if isinstance(record, dict) and "key" in record:
                    self._records[record["key"], record.get("inputs", "")] = record

    def get(self, item: Item) -> Record | None:
        """The last record of an item; ``None`` where it is still to be made."""
        return self._records.get((item.key, item.inputs))

    def forget(self, item: Item) -> None:
        """Let the record of an item not count, so that it is made again."""
        self._records.pop((item.key, item.inputs), None)

    def put(self, item: Item, record: Record) -> None:
        """Append the record of an item, forced to the disk."""
        named = {"key": item.key, "inputs": item.inputs} if item.inputs else {"key": item.key}
        record = named | {**item.head} | record
        line = (json.dumps(record) + "\n").encode()
        self._lock(0, wait=True)
        try:
            if self._file.seek(0, os.SEEK_END) > 0:
                self._file.seek(-1, os.SEEK_END)
                line = line if self._file.read(1) == b"\n" else b"\n" + line
            if self._file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
            os.fsync(self._file.fileno())
        finally:
            self._unlock(0)
        self._records[item.key, item.inputs] = record

    def _lock(self, byte: int, wait: bool = False) -> bool:
        if fcntl:
            try:
                fcntl.lockf(self._file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, byte)
            except (BlockingIOError, PermissionError):
                return False
        return True

    def _unlock(self, byte: int) -> None:
        if fcntl:
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, byte)

    def claim(self, item: Item) -> bool:
        """Hold an item until ``release``; ``False`` where another process has it."""
        return self._lock(_byte(item))

    def release(self, item: Item) -> None:
        """Give a claimed item back."""
        self._unlock(_byte(item))


def _byte(item: Item) -> int:
    """The byte of a journal that stands for an item, there or not; the first one is for appending."""
    return 1 + int(fingerprint(item.key, item.inputs)[:15], 16)


class Runner:
    """Takes the items of a job through stages, but for those that have a record.

    No two items have one key; ``noun`` is what an item is, for messages and the bar (``progress``), which the
    first process shows. Exceptions of ``survives`` fail their item only, every other one ends the run. Where
    ``whole`` says that what a record stands for is not there any more, it is made anew.
    """

    def __init__(
        self,
        items: Sequence[Item],
        journal: Journal,
        *,
        noun: str = "item",
        survives: tuple[type[Exception], ...] = (),
        progress: bool = True,
        whole: Callable[[Item, Record], bool] | None = None,
    ) -> None:
        self.items, self.journal, self.process = list(items), journal, this_process()
        if len({(item.key, item.inputs) for item in self.items}) < len(self.items):
            bad_value("items", "of different keys", f"{len(self.items)} {noun}s, some of one key")
        for item in self.items:
            record = journal.get(item)
            if record is not None and whole is not None and not whole(item, record):
                journal.forget(item)
        self._noun, self._survives = noun, survives
        self._progress = progress and self.process.index == 0
        self._begun = set[Item]()
        low, high = (len(items) * (self.process.index + i) // self.process.count for i in (0, 1))
        # Of another's share from the end on, where its process arrives last.
        self._left = deque(self.items[low:high] + self.items[:low][::-1] + self.items[high:][::-1])
        self._struck: dict[str, list[str]] = {}  # labels of the items that failed, by the cause
        self._unsaid: list[str] = []  # the first failure, as long as every item fails as the first one did
        self._any_passed = False

    def run(
        self, *stages: Stage, release: Callable[[Item], None] | None = None, most: int = 4
    ) -> list[Record]:
        """Work on every item without a record; the records that are there, in the order of ``items``.

        The first stage takes an item, every other one what the stage before returned, and the last returns
        the body of the record. Several run side by side, a thread each, on ``most`` items at a time.
        ``release`` is called with every item that was begun, once it is through or has failed.
        ``InputError``: all items failed for one reason.
        """

        def leave(item: Item) -> None:
            if release is not None:
                release(item)
            self.journal.release(item)

        pools = [ThreadPoolExecutor(1) for _ in stages] if len(stages) > 1 else []
        most = most if pools else 1
        on_the_way: deque[tuple[Item, Callable[[], Record]]] = deque()
        about = {"unit": f" {self._noun}", "file": sys.stderr, "disable": not self._progress}
        bar = tqdm(total=len(self.items), initial=len(self._records()), **about)
        try:
            while True:
                item = self._next() if len(on_the_way) < most else None
                if item is not None:
                    on_the_way.append((item, _begin(item, stages, pools)))
                elif on_the_way:
                    self._record(*on_the_way[0])
                    leave(on_the_way.popleft()[0])
                    bar.update(len(self._records()) - bar.n)
                elif not self._look_again():
                    break
        finally:
            bar.update(len(self._records()) - bar.n)  # with what other processes did
            bar.close()
            for pool in pools:  # every stage ends what it is at, and hands it on
                pool.shutdown(cancel_futures=True)
            for item, _ in on_the_way:
                leave(item)
        self._report()
        return self._records()

    def _records(self) -> list[Record]:
        self.journal.refresh()
        return [record for item in self.items if (record := self.journal.get(item)) is not None]

    def _record(self, item: Item, result: Callable[[], Record]) -> None:
        try:
            record = result()
        except self._survives as error:
            record = {"status": BROKEN, "error": self._fail(item, error)}
        else:
            self._any_passed = True
        if self._any_passed or len(self._struck) > 1:
            self._say_unsaid()
        self.journal.put(item, record)

    def _next(self) -> Item | None:
        """Claim the next item without a record; ``None`` where there is none at present."""
        while self._left:
            item = self._left.popleft()
            if item in self._begun or self.journal.get(item) is not None or not self.journal.claim(item):
                continue
            self.journal.refresh()
            if self.journal.get(item) is None:
                self._begun.add(item)
                return item
            self.journal.release(item)  # another process finished it a moment ago
        return None

    def _look_again(self) -> bool:
        """Wait for what others have claimed, and take it if they have lost it; ``False``: nothing is left."""
        self.journal.refresh()
        left = [i for i in self.items if i not in self._begun and self.journal.get(i) is None]
        if not left or self.process.index > 0:
            return False
        time.sleep(POLL_S)
        self._left.extend(left)
        return True

    def _fail(self, item: Item, error: Exception) -> str:
        """Note a failure to be said, unless its cause has been; returns the message."""
        is_plain = isinstance(error, (InputError, OSError, ValueError))
        message = str(error) if is_plain else f"{type(error).__name__}: {error}"
        cause = message
        for word in sorted(item.words or (item.label,), key=len, reverse=True):
            cause = cause.replace(word, "")
        if cause not in self._struck:
            self._unsaid.append(f"{item.label}: {message}")
            if not is_plain:  # a defect of ours
                _say("".join(traceback.format_exception(error)).rstrip())
        self._struck.setdefault(cause, []).append(item.label)
        return message

    def _say_unsaid(self) -> None:
        for message in self._unsaid:
            _say(f"geodiff: {message}")
        self._unsaid.clear()

    def _report(self) -> None:
        """Say which items each cause struck, where several; raise if it was one, and all items."""
        if self._unsaid and sum(map(len, self._struck.values())) == len(self.items) > 1:
            everywhere = f"The same holds for all {len(self.items)} {self._noun}s; nothing was computed."
            raise InputError(f"{self._unsaid[0]} {everywhere}")
        self._say_unsaid()
        for labels in self._struck.values():
            if len(labels) > 1:
                names = ", ".join(labels[:MOST_NAMES]) + (", ..." if len(labels) > MOST_NAMES else "")
                count = f"{len(labels)} of {len(self.items)} {self._noun}s"
                _say(f"geodiff: {count} failed for one reason: {names}.")


def _begin(item: Item, stages: Sequence[Stage], pools: Sequence[ThreadPoolExecutor]) -> Callable[[], Record]:
    """Send an item through the stages, each in its pool's thread, or the only one in that of who waits."""
    if not pools:
        return partial(stages[0], item)
    future = pools[0].submit(stages[0], item)
    for pool, stage in zip(pools[1:], stages[1:], strict=True):
        future = pool.submit(lambda after, before: after(before.result()), stage, future)
    return future.result


def _say(sentence: str) -> None:
    tqdm.write(sentence, file=sys.stderr)  # above the bar
    sys.stderr.flush()
