"""What a call holds: one guided call at a time on the same pipeline and networks, with threads for the cores.

Data flow: pipeline -> locks of it and of its networks, and torch's number of threads, held for a call, given
    back for the length of a callback.
Paper: none.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any
from weakref import WeakKeyDictionary

import torch

from geodiff_plugin._threads import WithinCores

__all__ = ["Exclusive", "exclusive_call"]

_LOCKS: WeakKeyDictionary[Any, threading.RLock] = WeakKeyDictionary()
_OF_LOCKS = threading.Lock()


def _lock_of(owner: Any) -> threading.RLock:
    with _OF_LOCKS:
        return _LOCKS.setdefault(owner, threading.RLock())


class Exclusive:
    """Context manager that holds the locks of some objects; what the thread holds already it may take again.

    Args:
        owners: objects that can be weakly referenced.
        inside: further context managers, entered when the locks are held; they are entered again after
            ``given_back``.
    """

    def __init__(self, owners: Iterable[Any], *inside: AbstractContextManager[object]) -> None:
        # In one order for all threads, so that no two wait for each other.
        self._locks = sorted({id(lock): lock for lock in map(_lock_of, owners)}.items())
        self._inside, self._stack = inside, ExitStack()

    def __enter__(self) -> Exclusive:
        with ExitStack() as stack:
            for _, lock in self._locks:
                stack.enter_context(lock)
            for one in self._inside:
                stack.enter_context(one)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    @contextmanager
    def given_back(self) -> Iterator[None]:
        """Leave everything for a while, and wait for the locks afterwards."""
        self.__exit__()
        try:
            yield
        finally:
            self.__enter__()


def exclusive_call(pipe: Any, guided: bool) -> Exclusive:
    """What a call of a pipeline holds: the pipeline, and a guided one also its networks and ``WithinCores``.

    So a guided call does not change a pipeline while its stock call runs in another thread, and two pipelines
    that share networks are not guided at once. Stock calls of other pipelines are not held up.
    """
    if not guided:
        return Exclusive([pipe])
    modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
    return Exclusive([pipe, *modules], WithinCores())
