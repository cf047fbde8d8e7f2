"""A pipeline of threads: each stage works on one item while the next item is in the stage before.

Data flow: items -> one thread a stage, a bounded number of items at a time -> finished items, in order.
Paper: none.

Nothing here imports torch.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

__all__ = ["Conveyor"]

Item = TypeVar("Item")
#: Goes through the queues behind the last item.
_END: Any = object()
#: Seconds between two looks of a thread that waits at whether it shall stop.
_LOOK_S = 0.2


class Conveyor(Generic[Item]):
    """Takes items through stages, each stage one item after the other in a thread of its own.

    Every item leaves, also one whose stage raised: the stages after that are left out for it.

    Args:
        stages: functions of an item, in order; what they find they keep in the item.
        failed: called with the item and the exception of a stage.
        most: items that may be on the way at a time, >= 1.
    """

    def __init__(
        self,
        stages: Sequence[Callable[[Item], None]],
        failed: Callable[[Item, Exception], None],
        most: int = 4,
    ) -> None:
        self._stages, self._failed = list(stages), failed
        self._room, self._stop = threading.Semaphore(most), threading.Event()
        self._source_error: BaseException | None = None

    def run(self, items: Iterable[Item]) -> Generator[Item, None, None]:
        """Every item, when it is through all stages; in order.

        Closing the generator, as leaving its loop does, lets every stage end what it is at and no more.

        Raises:
            Exception: what ``items`` itself raised, behind the items before.
        """
        queues: list[SimpleQueue[Any]] = [SimpleQueue() for _ in range(len(self._stages) + 1)]
        workers = [threading.Thread(target=self._feed, args=(items, queues[0]), daemon=True)]
        for stage, before, after in zip(self._stages, queues, queues[1:], strict=False):
            workers.append(threading.Thread(target=self._work, args=(stage, before, after), daemon=True))
        for worker in workers:
            worker.start()
        try:
            while (entry := queues[-1].get()) is not _END:
                yield entry[0]
                self._room.release()
            if self._source_error is not None:
                raise self._source_error
        finally:
            self._stop.set()
            for worker in workers:
                worker.join()

    def _feed(self, items: Iterable[Item], first: SimpleQueue[Any]) -> None:
        try:
            for item in items:
                while not self._room.acquire(timeout=_LOOK_S):
                    if self._stop.is_set():
                        return
                first.put((item, False))
                if self._stop.is_set():
                    return
        except BaseException as error:  # told where the items are taken, not in a thread that nobody watches
            self._source_error = error
        finally:
            first.put(_END)

    def _work(self, stage: Callable[[Item], None], before: SimpleQueue[Any], after: SimpleQueue[Any]) -> None:
        while (entry := before.get()) is not _END:
            item, has_failed = entry
            if not has_failed and not self._stop.is_set():
                try:
                    stage(item)
                except Exception as error:
                    has_failed = True
                    self._failed(item, error)
            after.put((item, has_failed))
        after.put(_END)
