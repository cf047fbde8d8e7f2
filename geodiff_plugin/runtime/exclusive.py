"""Locks: one guided call at a time on the same pipeline and networks.

Data flow: pipeline -> locks of it and of its networks, held for a call, given back for the length of a
    callback.
Paper: none.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from weakref import WeakKeyDictionary

import torch

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
    """

    def __init__(self, owners: Iterable[Any]) -> None:
        # In one order for all threads, so that no two wait for each other.
        self._locks = sorted({id(lock): lock for lock in map(_lock_of, owners)}.items())
        self._stack = ExitStack()

    def __enter__(self) -> Exclusive:
        with ExitStack() as stack:
            for _, lock in self._locks:
                stack.enter_context(lock)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    @contextmanager
    def given_back(self) -> Iterator[None]:
        """Free the locks for a while, and wait for them afterwards."""
        self.__exit__()
        try:
            yield
        finally:
            self.__enter__()


def exclusive_call(pipe: Any, guided: bool) -> Exclusive:
    """What a call of a pipeline holds: the pipeline, and a guided one also its networks.

    So a guided call does not change a pipeline while its stock call runs in another thread, and two pipelines
    that share networks are not guided at once. Stock calls of other pipelines are not held up.
    """
    modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)] if guided else []
    return Exclusive([pipe, *modules])
