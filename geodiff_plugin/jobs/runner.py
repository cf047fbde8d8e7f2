"""One resumable loop for long jobs: ``geodiff depth`` over many pairs, captures and the evaluation.

A ``Runner`` takes every ``Item`` without a record through the stages of the work, and appends its record to a
``Journal``. Failures are records too, tried again by the next run. Nothing here imports torch.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from threading import Semaphore
from typing import Any

from tqdm import tqdm

from geodiff_plugin._checks import bad_value
from geodiff_plugin.jobs.failures import Failures
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Record
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
        self._failures = Failures(len(self.items), noun, say)

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
        left = [item for item in self.items if self.journal.get(item) is None]
        line = _Line(stages)
        most = most or line.threads
        begun: deque[tuple[Item, Callable[[], Record]]] = deque()
        about = {"unit": f" {self._noun}", "file": sys.stderr, "disable": not self._progress}
        release = release or (lambda _: None)
        try:
            with tqdm(total=len(self.items), initial=len(self.items) - len(left), **about) as bar:
                while left or begun:
                    if left and len(begun) < most:
                        item = left.pop(0)
                        begun.append((item, line.begin(item)))
                        continue
                    self._record(*begun[0])
                    release(begun.popleft()[0])
                    bar.update()
        finally:
            line.close()
            for item, _ in begun:
                release(item)
        self._failures.report()
        return [record for item in self.items if (record := self.journal.get(item)) is not None]

    def _record(self, item: Item, result: Callable[[], Record]) -> None:
        try:
            record = result()
        except self._survives as error:
            record = {"status": BROKEN, "error": self._failures.add(item, error)}
        else:
            self._failures.passed()
        self.journal.put(item, record)


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
