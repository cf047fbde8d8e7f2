"""One runner for long jobs: ``geodiff depth`` over many pairs, captures and the evaluation.

A job is a list of ``Item``; its results are lines of a ``Journal``, a JSONL file. ``Runner.run`` takes every
item without a result through the stages of the work and appends one record each::

    items = [Item(fingerprint(name, settings, path, __version__), path) for ...]
    runner = Runner(items, Journal(out / "samples.jsonl"), noun="sample")
    records = runner.run(lambda item: {"abs_rel": measure(item.payload)})

- **Resuming.** A key is the fingerprint of all inputs, so an item whose inputs did not change has its record
  already. Where a result has a place with a name, such as a folder for each pair, the key is that name, and
  ``Item.inputs`` is the fingerprint.
- **Several processes**, started by ``torchrun``, ``accelerate launch`` or in two terminals, share a job by
  sharing its journal. Each claims an item before the work, with a lock that the kernel gives back when the
  process ends, however it ends. The first process waits for what others have claimed, takes it over should
  they die, and returns the records of all; the others leave when nothing is left to claim.
- **Failures** are records too (``status`` ``"broken"``, ``error``), tried again by the next run.
- **kill -9** loses the items that were on the way. A line goes out in one write; a torn last line is skipped,
  and ended before the next is appended.

Nothing here imports torch.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any

from tqdm import tqdm

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import take_lock

try:
    import fcntl
except ImportError:  # no flock: processes keep to their shares, and two runs of one job do its work twice
    CAN_LOCK = False
else:
    CAN_LOCK = True

__all__ = ["BROKEN", "Item", "Journal", "Record", "Runner", "fingerprint", "this_process"]

Record = dict[str, Any]
Stage = Callable[[Any], Any]

#: ``status`` of an item that failed.
BROKEN = "broken"
#: Seconds between two looks at what other processes have finished, and at whether to stop.
POLL_S = 0.2
#: Names that a sentence about several failures gives.
MOST_NAMES = 5


def fingerprint(*parts: Any) -> str:
    """20 hexadecimal digits that name inputs: the same inputs give the same, any other ones another.

    Args:
        parts: JSON values, also nested; a ``Path`` counts by what the file holds, not by where it lies. A
            folder, or a file that cannot be read, counts as ``None``, and as an entry of a dict not at all.
    """
    text = json.dumps([_readable(part) for part in parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _readable(part: Any) -> Any:
    if isinstance(part, Path):
        try:
            return file_digest(part)
        except OSError:
            return None
    if isinstance(part, dict):
        entries = ((name, value, _readable(value)) for name, value in part.items())
        return {name: read for name, value, read in entries if read is not None or value is None}
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
    """One piece of work.

    Attributes:
        key: its name, no two items of a job share one.
        payload: what the first stage works on.
        inputs: fingerprint of its inputs, unless ``key`` is it; a record of other inputs does not count.
        name: in messages; ``key`` by default.
        head: what its record begins with, also where it fails.
        words: texts of this item alone, such as its paths, which are no part of the cause of a failure; its
            label where there are none.
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
    """Records of a job in a JSONL file that several processes may append to.

    Records of failures that the file holds at first do not count, so that they are tried again.

    Args:
        path: the file; its folder is made where it is missing, and ``ValueError`` says where it cannot be.
        option: what the folder was given as, for messages.
    """

    def __init__(self, path: Path, option: str = "--out") -> None:
        self.path = path
        self._claims = path.with_name(f".{path.name}.claims")
        self._mine: dict[Path, IO[bytes]] = {}
        self._records: dict[tuple[str, str], Record] = {}
        self._read_bytes, self._lock = 0, threading.RLock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "ab"):
                pass
        except OSError as error:
            cure = "Name another, or free disk space and check its permissions."
            got = f"{path.parent} ({error.strerror or error})"
            bad_value(option, "a folder that can be written to", got, cure)
        self.refresh()
        self._records = {key: r for key, r in self._records.items() if r.get("status") != BROKEN}

    def refresh(self) -> None:
        """Read what was appended since the last time; lines that a killed process left torn are skipped."""
        with self._lock, open(self.path, "rb") as file:
            file.seek(self._read_bytes)
            *lines, torn = file.read().split(b"\n")
            self._read_bytes = file.tell() - len(torn)
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

    def put(self, item: Item, record: Record) -> Record:
        """Append the record of an item, forced to the disk, and return it with its key."""
        record = {"key": item.key} | ({"inputs": item.inputs} if item.inputs else {}) | {**item.head} | record
        line = (json.dumps(record) + "\n").encode()
        with self._lock, open(self.path, "a+b", buffering=0) as file:
            if CAN_LOCK:
                fcntl.flock(file, fcntl.LOCK_EX)  # until it is closed
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                line = line if file.read(1) == b"\n" else b"\n" + line
            if file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
            os.fsync(file.fileno())
            self._records[item.key, item.inputs] = record
        return record

    def _claim_path(self, item: Item) -> Path:
        return self._claims / fingerprint(item.key, item.inputs)

    def claim(self, item: Item) -> bool:
        """Hold an item until ``release``; ``False`` where another process, or thread, has it."""
        path = self._claim_path(item)
        while CAN_LOCK:
            self._claims.mkdir(exist_ok=True)
            try:
                file = open(path, "ab")
            except FileNotFoundError:  # whoever was last to release has removed the folder in between
                continue
            if not take_lock(file):
                file.close()
                return False
            # Who held it before has removed the file meanwhile: what we hold then is nobody's lock.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    self._mine[path] = file
                    break
            file.close()
        return True

    def release(self, item: Item) -> None:
        """Give a claimed item back."""
        file = self._mine.pop(self._claim_path(item), None)
        if file is not None:
            self._claim_path(item).unlink(missing_ok=True)
            file.close()
        with suppress(OSError):  # others hold claims
            self._claims.rmdir()

    def others_work(self) -> bool:
        """Whether another process holds an item of this job."""
        for path in set(self._claims.glob("*")) - set(self._mine):
            with suppress(FileNotFoundError), open(path, "rb") as file:
                if not take_lock(file):
                    return True
        return False


class Runner:
    """Takes the items of a job through stages, but for those that have a record.

    Args:
        items: in the order in which records are returned; no two of one key.
        journal: of the records.
        noun: what an item is, for the bar and messages.
        survives: exceptions of a stage that fail its item only; every other one ends the run.
        progress: show a bar with the time left, in the first process.
        show: what the bar says of the records so far, such as running means.
        whole: whether what a record stands for is still there, such as files beside it; else it is made anew.
        in_order: an item goes on from the one before, so a process takes items of another's share only when
            no other process works any more.
        say: prints a sentence about failures; by default on stderr.
    """

    def __init__(
        self,
        items: Sequence[Item],
        journal: Journal,
        *,
        noun: str = "item",
        survives: tuple[type[Exception], ...] = (),
        progress: bool = True,
        show: Callable[[Sequence[Record]], dict[str, str]] | None = None,
        whole: Callable[[Item, Record], bool] | None = None,
        in_order: bool = False,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.items, self.journal, self.process = list(items), journal, this_process()
        if len({(item.key, item.inputs) for item in self.items}) < len(self.items):
            bad_value("items", "of different keys", f"{len(self.items)} {noun}s, some of one key")
        if self.process.count > 1 and not CAN_LOCK:
            bad_value("the number of processes", "1 on a system without flock", self.process.count)
        for item in self.items:
            record = journal.get(item)
            if record is not None and whole is not None and not whole(item, record):
                journal.forget(item)
        self._noun, self._survives, self._show, self._in_order = noun, survives, show, in_order
        self._progress = progress and self.process.index == 0
        self._failures = _Failures(noun, len(self.items), say or _say)
        self._begun, self._stop = set[Item](), threading.Event()

    def run(
        self, *stages: Stage, release: Callable[[Item], None] | None = None, most: int = 4
    ) -> list[Record]:
        """Work on every item without a record.

        Args:
            stages: the first takes an item, every other one what the stage before returned; the last returns
                the body of the record. Several run side by side, a thread each, on different items.
            release: called with every item that was begun, once it is through or has failed.
            most: items on the way at a time.

        Returns:
            The records that are there, in the order of ``items``; in the first process those of all items.

        Raises:
            ValueError: every item failed, all for one reason.
            Exception: of a stage, unless it is one of ``survives``.
        """

        def leave(item: Item) -> None:
            on_the_way.discard(item)
            if release is not None:
                release(item)
            self.journal.release(item)

        on_the_way: set[Item] = set()
        done, total, unit = len(self._records()), len(self.items), f" {self._noun}"
        work = _in_turn if len(stages) == 1 else _side_by_side
        bar = tqdm(total=total, initial=done, unit=unit, file=sys.stderr, disable=not self._progress)
        try:
            with bar, closing(work(self._todo(on_the_way), stages, self._stop, most)) as results:
                for item, result in results:
                    self._record(item, result)
                    leave(item)
                    records = self._records()
                    if self._show is not None:
                        bar.set_postfix(self._show(records), refresh=False)
                    bar.update(len(records) - bar.n)
        finally:
            for item in tuple(on_the_way):
                leave(item)
        self._failures.report()
        return self._records()

    def _records(self) -> list[Record]:
        self.journal.refresh()
        return [record for item in self.items if (record := self.journal.get(item)) is not None]

    def _record(self, item: Item, result: Any) -> None:
        if not isinstance(result, _Failed):
            self.journal.put(item, result)
            self._failures.passed()
        elif isinstance(result.error, self._survives):
            self.journal.put(item, {"status": BROKEN, "error": self._failures.add(item, result.error)})
        else:
            raise result.error

    def _todo(self, on_the_way: set[Item]) -> Iterator[Item]:
        """Items without a record, claimed: of this process's share, then what others leave or have lost."""
        index, count = self.process.index, self.process.count
        low, high = (len(self.items) * i // count for i in (index, index + 1))
        left = self.items[low:high]
        left += [] if self._in_order else self.items[high:] + self.items[:low]
        while True:
            for item in left:
                if self._stop.is_set():
                    return
                if self._take(item):
                    on_the_way.add(item)
                    yield item
            if index > 0:
                return
            while True:
                self.journal.refresh()
                left = [i for i in self.items if i not in self._begun and self.journal.get(i) is None]
                if not left or self._stop.wait(POLL_S):
                    return
                if not (self._in_order and self.journal.others_work()):
                    break

    def _take(self, item: Item) -> bool:
        if item in self._begun or self.journal.get(item) is not None or not self.journal.claim(item):
            return False
        self.journal.refresh()
        if self.journal.get(item) is not None:  # another process finished it a moment ago
            self.journal.release(item)
            return False
        self._begun.add(item)
        return True


@dataclass(frozen=True)
class _Failed:
    """What a stage raised, on its way to the thread that records it."""

    error: BaseException


Results = Generator[tuple[Item, Any], None, None]


def _attempt(stage: Stage, value: Any) -> Any:
    try:
        return stage(value)
    except BaseException as error:  # raised again where the items are recorded, unless the run survives it
        return _Failed(error)


def _in_turn(items: Iterable[Item], stages: Sequence[Stage], stop: threading.Event, most: int) -> Results:
    """Every item with the result of the only stage, in this thread."""
    try:
        for item in items:
            yield item, _attempt(stages[0], item)
    finally:
        stop.set()


#: What ends a queue; in the place of an item, what stands beside it is the error of the source.
_END: Any = object()


def _side_by_side(
    items: Iterable[Item], stages: Sequence[Stage], stop: threading.Event, most: int
) -> Results:
    """Every item with what the last stage returned, or ``_Failed``; in order, each stage in its thread.

    Closing the generator lets every stage end what it is at and no more. What ``items`` itself raises is
    raised behind the items before.
    """
    queues: list[SimpleQueue[Any]] = [SimpleQueue() for _ in range(len(stages) + 1)]
    room = threading.Semaphore(most)
    jobs: list[tuple[Callable[..., None], tuple[Any, ...]]] = [(_feed, (items, queues, room, stop))]
    jobs += [(_work, (stage, *ends, stop)) for stage, *ends in zip(stages, queues, queues[1:], strict=False)]
    workers = [threading.Thread(target=target, args=args, daemon=True) for target, args in jobs]
    for worker in workers:
        worker.start()
    source_error: BaseException | None = None
    try:
        while (entry := queues[-1].get()) is not _END:
            if entry[0] is _END:
                source_error = entry[1]
                continue
            yield entry
            room.release()
        if source_error is not None:
            raise source_error
    finally:
        stop.set()
        for worker in workers:
            worker.join()


def _feed(
    items: Iterable[Item],
    queues: Sequence[SimpleQueue[Any]],
    room: threading.Semaphore,
    stop: threading.Event,
) -> None:
    """Put items into the first queue as long as there is room; an error goes to the last one."""
    try:
        for item in items:
            queues[0].put((item, item))
            while not room.acquire(timeout=POLL_S):
                if stop.is_set():
                    return
    except BaseException as error:  # told where the items are taken, not in a thread that nobody watches
        queues[-1].put((_END, error))
    finally:
        queues[0].put(_END)


def _work(stage: Stage, before: SimpleQueue[Any], after: SimpleQueue[Any], stop: threading.Event) -> None:
    """Take every value of one queue through a stage into the next one."""
    while (entry := before.get()) is not _END:
        item, value = entry
        if not isinstance(value, _Failed) and not stop.is_set():
            value = _attempt(stage, value)
        after.put((item, value))
    after.put(_END)


def _say(sentence: str) -> None:
    tqdm.write(sentence, file=sys.stderr)  # above the bar
    sys.stderr.flush()


class _Failures:
    """Says why items failed: each cause once, and at the end how many items it struck."""

    def __init__(self, noun: str, total: int, say: Callable[[str], None]) -> None:
        self._noun, self._total, self._say = noun, total, say
        self._labels: dict[str, list[str]] = {}
        self._unsaid: str | None = None  # the first message, as long as every item fails as the first one did
        self._any_passed = False

    def add(self, item: Item, error: Exception) -> str:
        """Note a failure, say it unless its cause has been said, and return the message."""
        is_plain = isinstance(error, (InputError, OSError, ValueError))
        message = str(error) if is_plain else f"{type(error).__name__}: {error}"
        cause = message
        for word in sorted(item.words or (item.label,), key=len, reverse=True):
            cause = cause.replace(word, "") if word else cause
        is_new = cause not in self._labels
        self._labels.setdefault(cause, []).append(item.label)
        if is_new and not is_plain:  # a defect of ours
            self._say("".join(traceback.format_exception(error)).rstrip())
        if is_new and len(self._labels) == 1 and not self._any_passed:
            self._unsaid = f"{item.label}: {message}"
        elif is_new:
            self._flush()
            self._say(f"geodiff: {item.label}: {message}")
        return message

    def passed(self) -> None:
        """Note that an item has not failed."""
        self._any_passed = True
        self._flush()

    def _flush(self) -> None:
        if self._unsaid is not None:
            self._say(f"geodiff: {self._unsaid}")
        self._unsaid = None

    def report(self) -> None:
        """Say how many items each cause struck, where several.

        Raises:
            ValueError: all items of the run failed, for one cause.
        """
        if self._unsaid is not None and sum(map(len, self._labels.values())) == self._total > 1:
            everywhere = f"The same holds for all {self._total} {self._noun}s; nothing was computed."
            raise InputError(f"{self._unsaid} {everywhere}")
        self._flush()
        for labels in self._labels.values():
            if len(labels) > 1:
                names = ", ".join(labels[:MOST_NAMES])
                names += f" and {len(labels) - MOST_NAMES} more" if len(labels) > MOST_NAMES else ""
                count = f"{len(labels)} of {self._total} {self._noun}s"
                self._say(f"geodiff: {count} failed for one reason: {names}.")
