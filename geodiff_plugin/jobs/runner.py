"""One resumable loop for long jobs: ``geodiff depth`` over many pairs, captures and the evaluation.

A ``Runner`` takes every ``Item`` without a record through the stages of the work, and appends its record to a
``Journal``. Failures are records too, tried again by the next run. Nothing here imports torch.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from threading import Lock, Semaphore
from typing import Any

from tqdm import tqdm

from geodiff_plugin._checks import bad_value
from geodiff_plugin.jobs.failures import Failures
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Record
from geodiff_plugin.jobs.separate import ProcessEnded, SeparateProcess
from geodiff_plugin.jobs.telling import say

Stage = Callable[[Any], Any]


@dataclass(frozen=True)
class SideBySide:
    """A stage that so many threads call, each with another item."""

    stage: Stage
    threads: int

    def __call__(self, before: Any) -> Any:
        """What the stage returns."""
        return self.stage(before)


class Runner:
    """Takes the items of a job through stages, but for those that have a record.

    No two items have one key; ``noun`` is what an item is, for messages and the bar (``progress``).
    Exceptions of ``survives`` fail their item only, every other one ends the run. Where ``whole`` says that
    what a record stands for is not there any more, it is made anew.
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
        self.items, self.journal = list(items), journal
        if len({(item.key, item.inputs) for item in self.items}) < len(self.items):
            bad_value("items", "of different keys", f"{len(self.items)} {noun}s, some of one key")
        for item in self.items:
            record = journal.get(item)
            if record is not None and whole is not None and not whole(item, record):
                journal.forget(item)
        self._noun, self._survives, self._progress = noun, survives, progress
        self._failures, self._recording = Failures(len(self.items), noun, say), Lock()

    @property
    def left(self) -> list[Item]:
        """Items without a record."""
        return [item for item in self.items if self.journal.get(item) is None]

    def run(
        self, *stages: Stage, release: Callable[[Item], None] | None = None, most: int | None = None
    ) -> list[Record]:
        """Work on every item without a record; the records of all, in the order of ``items``.

        The first stage takes an item, every other one what the stage before returned, and the last returns
        the body of the record. Several stages work at the same time, a thread each or ``SideBySide`` more,
        on ``most`` items, by default one a thread: fewer would leave a thread without work, and more would
        only take memory. ``release`` is called with every item that was begun, once it is through or has
        failed.

        Raises:
            InputError: all items failed for one reason.
        """
        left, line = self.left, _Line(stages)
        most = most or line.threads
        begun: deque[tuple[Item, Callable[[], Record]]] = deque()
        release = release or (lambda _: None)
        try:
            with self._bar() as bar:
                while left or begun:
                    if left and len(begun) < most:
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
        self, processes: Sequence[SeparateProcess], function: Callable[[Item], Record], stage: Stage
    ) -> list[Record]:
        """As ``run(stage)``, while each of ``processes`` calls ``function`` likewise with an item at a time.

        Whoever is free takes the next item. One whose process ends, or raises ``ProcessEnded``, is made here.
        An error or Ctrl-C, which ends the run, ends the processes as well.
        """
        left = _Left(self.left)
        with self._bar() as bar, ThreadPoolExecutor(len(processes)) as pool:
            try:
                calls = [partial(process.call, function) for process in processes]
                beside = [pool.submit(self._take, left, call, bar) for call in calls]
                self._take(left, stage, bar)
                for each in beside:
                    each.result()
                self._take(left, stage, bar)  # what a process has left at last
            except BaseException:
                left.stop()
                for process in processes:
                    process.end()
                raise
        return self._records()

    def _take(self, left: _Left, stage: Stage, bar: tqdm) -> None:
        """Put one item after the other through a stage."""
        try:
            while (item := left.take()) is not None:
                self._record(item, partial(stage, item), bar)
        except ProcessEnded as error:
            assert item is not None
            if left.put_back(item):
                say(f"geodiff: {item.label} is made anew: {error}")
        except BaseException:
            left.stop()
            raise

    def _bar(self) -> tqdm:
        total, left = len(self.items), len(self.left)
        about = {"unit": f" {self._noun}", "file": sys.stderr, "disable": not self._progress}
        return tqdm(total=total, initial=total - left, **about)

    def _record(self, item: Item, result: Callable[[], Record], bar: tqdm) -> None:
        error: Exception | None = None
        try:
            record = result()
        except ProcessEnded:  # it says nothing of the item
            raise
        except self._survives as raised:
            error = raised
        with self._recording:
            if error is None:
                self._failures.passed()
            else:
                record = {"status": BROKEN, "error": self._failures.add(item, error)}
            self.journal.put(item, record)
            bar.update()

    def _records(self) -> list[Record]:
        self._failures.report()
        return [record for item in self.items if (record := self.journal.get(item)) is not None]


class _Left:
    """Items that several threads take, until there are none or these are to stop."""

    def __init__(self, items: Sequence[Item]) -> None:
        self._items, self._stopped = deque(items), False

    def take(self) -> Item | None:
        """The next one."""
        with suppress(IndexError):
            return self._items.popleft()
        return None

    def put_back(self, item: Item) -> bool:
        """Let another thread take it; whether one may."""
        if not self._stopped:
            self._items.appendleft(item)
        return not self._stopped

    def stop(self) -> None:
        """Let there be none."""
        self._stopped = True
        self._items.clear()


class _Line:
    """Stages one after the other, each with threads of its own; a single thread is that of who waits.

    A stage gets at most one item ahead of the next one. Else a quick stage would do all items on the way at
    once, and what it makes of them, which may lie on a GPU, would wait in memory.
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        threads = [stage.threads if isinstance(stage, SideBySide) else 1 for stage in stages]
        self.threads, self._stages = sum(threads), stages
        self._pools = [ThreadPoolExecutor(count) for count in threads] if self.threads > 1 else []
        self._room = [Semaphore(count + 1) for count in threads]  # for items that the next has not taken

    def begin(self, item: Item) -> Callable[[], Record]:
        """Send an item through the stages; what is returned waits for its record."""
        if not self._pools:
            return partial(self._stages[0], item)
        handed: Callable[[], Any] = partial(_itself, item)
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
        """Let every stage end what it is at and hand it on; what waits is not begun."""
        for pool in self._pools:  # in this order: a stage may wait for room until the next has gone on
            pool.shutdown(cancel_futures=True)


def _itself(item: Item) -> Item:
    return item
