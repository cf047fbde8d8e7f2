"""Provides one resumable loop for long jobs: ``geodiff depth`` over many pairs, captures and the evaluation.

A ``Runner`` takes every ``Item`` without a record through the stages of the work, and appends its record to a
``Journal``. Failures are records too, and are retried by the next run. Nothing here imports torch.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from threading import Lock, Semaphore
from typing import Any

from tqdm import tqdm

from geodiff_plugin._internal.checks import InputError, bad_value, raise_input_error
from geodiff_plugin._internal.lazy import imported
from geodiff_plugin.jobs.failures import Failures
from geodiff_plugin.jobs.journal import BROKEN, Done, Item, Journal, Record
from geodiff_plugin.jobs.notices import Notify, say
from geodiff_plugin.jobs.processes import ProcessEnded, WorkerProcess

Stage = Callable[[Any], Any]


@dataclass(frozen=True)
class ParallelStage:
    """A stage called by this many threads at once, each with a different item."""

    stage: Stage
    threads: int

    def __call__(self, before: Any) -> Any:
        """Call the stage's function."""
        return self.stage(before)


class Runner:
    """Takes the items without a record through the stages of a job.

    Keys of items are unique; ``noun`` names an item in messages and the progress bar (``progress``).
    Exceptions accepted by ``is_recoverable`` fail their item only; all others end the run. ``whole`` checks
    whether the result of a record still exists; if it does not, the item is processed again.
    """

    def __init__(
        self,
        items: Sequence[Item],
        journal: Journal,
        *,
        noun: str = "item",
        is_recoverable: tuple[type[Exception], ...] = (),
        progress: bool = True,
        whole: Callable[[Item, Record], bool] | None = None,
    ) -> None:
        self.items = list(items)
        self.journal = journal
        if len({(item.key, item.inputs) for item in self.items}) < len(self.items):
            bad_value("items", "unique by key", f"{len(self.items)} {noun}s, some with the same key")
        for item in self.items:
            record = journal.get(item)
            if record is not None and whole is not None and not whole(item, record):
                journal.forget(item)
        self._noun, self._is_recoverable, self._progress = noun, is_recoverable, progress
        self._failures = Failures(len(self.items), noun, say)
        self._recording = Lock()

    @property
    def left(self) -> list[Item]:
        """Return the items without a record."""
        return [item for item in self.items if self.journal.get(item) is None]

    def run(
        self, *stages: Stage, release: Callable[[Item], None] | None = None, max_items: int | None = None
    ) -> list[Record]:
        """Process every item without a record; return all records in the order of ``items``.

        The first stage takes an item, every other one the result of the previous stage, and the last returns
        the body of the record. The stages run concurrently, in one thread each or in as many as
        ``ParallelStage`` sets, on ``max_items`` items. The default is one item per thread: fewer would leave
        a thread idle, and more would only use memory. ``release`` is called with every item that was started,
        after it has finished or failed.

        Raises:
            InputError: all items failed for one reason.
        """
        left = self.left
        line = _StagePipeline(stages)
        max_items = max_items or line.threads
        begun: deque[tuple[Item, Callable[[], Record]]] = deque()
        release = release or (lambda _: None)
        try:
            with self._bar() as bar:
                while left or begun:
                    if left and len(begun) < max_items:
                        item = left.pop(0)
                        begun.append((item, line.begin(item)))
                        continue
                    self._record(*begun[0], bar)
                    release(begun.popleft()[0])
        finally:
            line.close()
            for item, _ in begun:
                release(item)
        return self._records()

    def run_with(
        self, processes: Sequence[WorkerProcess], function: Callable[[Item], Record], stage: Stage
    ) -> list[Record]:
        """Run ``stage`` like ``run``, while each of ``processes`` calls ``function`` with one item at a time.

        A free thread or process takes the next item. If a process ends or raises ``ProcessEnded``, its item
        is processed here. An error or Ctrl-C that ends the run also ends the processes.
        """
        left = _ItemQueue(self.left)
        with self._bar() as bar, ThreadPoolExecutor(len(processes)) as pool:
            try:
                calls = [partial(process.call, function) for process in processes]
                futures = [pool.submit(self._take, left, call, bar) for call in calls]
                self._take(left, stage, bar)
                for each in futures:
                    each.result()
                self._take(left, stage, bar)  # items returned by processes that ended
            except BaseException:
                left.stop()
                for process in processes:
                    process.end()
                raise
        return self._records()

    def _take(self, left: _ItemQueue, stage: Stage, bar: tqdm) -> None:
        """Take items one by one through a stage."""
        try:
            while (item := left.take()) is not None:
                self._record(item, partial(stage, item), bar)
        except ProcessEnded as error:
            assert item is not None
            if left.put_back(item):
                say(f"geodiff: {item.label} is being reprocessed: {error}")
        except BaseException:
            left.stop()
            raise

    def run_elsewhere(
        self, work: Callable[[list[Item]], Iterable[Done]], notify: Notify = say
    ) -> list[Record]:
        """Run like ``run`` with another engine: ``work`` takes the items without a record, yields outcomes.

        ``notify`` receives messages about failures.
        """
        of_key = {item.key: item for item in self.items}
        failures = Failures(len(self.items), self._noun, notify)
        with self._bar() as bar:
            for done in work(self.left) if self.left else ():
                error = None if done.error is None else InputError(done.error)
                self._put(of_key[done.key], done.record, error, failures)
                bar.update()
        return self._records(failures)

    def _bar(self) -> tqdm:
        total, left = len(self.items), len(self.left)
        about = {"unit": f" {self._noun}", "file": sys.stderr, "disable": not self._progress}
        return tqdm(total=total, initial=total - left, **about)

    def _record(self, item: Item, result: Callable[[], Record], bar: tqdm) -> None:
        record, error = None, None
        try:
            record = result()
        except ProcessEnded:  # not a failure of the item
            raise
        except self._is_recoverable as raised:
            error = raised
        with self._recording:
            self._put(item, record, error, self._failures)
            bar.update()

    def _put(self, item: Item, record: Record | None, error: Exception | None, failures: Failures) -> None:
        """Append the record of an item, or a record of its error."""
        if record is None:
            assert error is not None
            record = {"status": BROKEN, "error": failures.add(item, error)}
        else:
            failures.passed()
        self.journal.put(item, record)

    def _records(self, failures: Failures | None = None) -> list[Record]:
        (failures or self._failures).report()
        return [record for item in self.items if (record := self.journal.get(item)) is not None]


class _ItemQueue:
    """Queue of items shared by several threads, until it is empty or stopped."""

    def __init__(self, items: Sequence[Item]) -> None:
        self._items = deque(items)
        self._stopped = False

    def take(self) -> Item | None:
        """Return the next item, or ``None``."""
        with suppress(IndexError):
            return self._items.popleft()
        return None

    def put_back(self, item: Item) -> bool:
        """Return an item for another thread; ``False`` if no other thread may take it."""
        if not self._stopped:
            self._items.appendleft(item)
        return not self._stopped

    def stop(self) -> None:
        """Empty the queue."""
        self._stopped = True
        self._items.clear()


class _StagePipeline:
    """Pipeline of stages with a thread pool each; a single stage with one thread runs in the caller's thread.

    A stage runs at most one item ahead of the next stage. Otherwise a fast stage would process all items at
    once, and their intermediate results, possibly on a GPU, would fill the memory.
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        threads = [stage.threads if isinstance(stage, ParallelStage) else 1 for stage in stages]
        self.threads = sum(threads)
        self._stages = stages
        self._pools = [ThreadPoolExecutor(count) for count in threads] if self.threads > 1 else []
        self._room = [
            Semaphore(count + 1) for count in threads
        ]  # counts items that the next stage has not taken

    def begin(self, item: Item) -> Callable[[], Record]:
        """Send an item through the stages; returns a function that waits for its record."""
        if not self._pools:
            return partial(self._stages[0], item)
        handed: Callable[[], Any] = partial(_identity, item)
        for number, pool in enumerate(self._pools):
            handed = pool.submit(self._work, number, handed).result
        return handed

    def _work(self, number: int, handed: Callable[[], Any]) -> Any:
        if number < len(self._stages) - 1:
            self._room[number].acquire()
        try:
            taken = handed()
        finally:
            if number > 0:
                self._room[number - 1].release()
        return self._stages[number](taken)

    def close(self) -> None:
        """Let every stage finish and pass on its current item; queued items are not started."""
        for pool in self._pools:  # in order: a stage may wait until the next one has taken its item
            pool.shutdown(cancel_futures=True)


def _identity(item: Item) -> Item:
    return item


def on_ray(name: str) -> Any:
    """Return a function of ``jobs.cluster``; raises ``InputError`` if Ray is not installed."""
    try:
        return imported(f"jobs.cluster.{name}")
    except ModuleNotFoundError as error:
        if error.name not in ("ray", "pyarrow"):
            raise
        raise_input_error("--engine ray needs Ray. Install it with: pip install 'geodiff-plugin[ray]'.")
