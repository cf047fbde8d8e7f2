"""One resumable loop for long jobs: ``geodiff depth`` over many pairs, captures and the evaluation.

A ``Runner`` takes every ``Item`` without a record through the stages of the work, and appends its record to a
``Journal``. Failures are records too, tried again by the next run. Nothing here imports torch.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from tqdm import tqdm

from geodiff_plugin._checks import bad_value
from geodiff_plugin.jobs.failures import Failures
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Record
from geodiff_plugin.jobs.telling import say

Stage = Callable[[Any], Any]


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
        self, *stages: Stage, release: Callable[[Item], None] | None = None, most: int = 4
    ) -> list[Record]:
        """Work on every item without a record; the records of all, in the order of ``items``.

        The first stage takes an item, every other one what the stage before returned, and the last returns
        the body of the record. Several run side by side, a thread each, on ``most`` items at a time.
        ``release`` is called with every item that was begun, once it is through or has failed.

        Raises:
            InputError: all items failed for one reason.
        """
        left = [item for item in self.items if self.journal.get(item) is None]
        pools = [ThreadPoolExecutor(1) for _ in stages] if len(stages) > 1 else []
        begun: deque[tuple[Item, Callable[[], Record]]] = deque()
        about = {"unit": f" {self._noun}", "file": sys.stderr, "disable": not self._progress}
        release = release or (lambda _: None)
        try:
            with tqdm(total=len(self.items), initial=len(self.items) - len(left), **about) as bar:
                while left or begun:
                    if left and len(begun) < (most if pools else 1):
                        item = left.pop(0)
                        begun.append((item, _begin(item, stages, pools)))
                        continue
                    self._record(*begun[0])
                    release(begun.popleft()[0])
                    bar.update()
        finally:
            for pool in pools:  # every stage ends what it is at, and hands it on
                pool.shutdown(cancel_futures=True)
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


def _begin(item: Item, stages: Sequence[Stage], pools: Sequence[ThreadPoolExecutor]) -> Callable[[], Record]:
    """Send an item through the stages, each in its pool's thread, or the only one in that of who waits."""
    if not pools:
        return partial(stages[0], item)
    future = pools[0].submit(stages[0], item)
    for pool, stage in zip(pools[1:], stages[1:], strict=True):
        future = pool.submit(lambda after, before: after(before.result()), stage, future)
    return future.result
