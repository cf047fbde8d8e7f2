"""``Beside``: work of the host beside the first steps of a network on a GPU."""

from __future__ import annotations

import contextvars
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import torch

T = TypeVar("T")


class Beside(Generic[T]):
    """The answer of a function that a thread of its own works out while the caller goes on.

    A guided call on CUDA makes its evidence like this: the pose check keeps the CPU busy for as long as the
    network's first steps, which are not guided, keep the GPU busy. The thread has the caller's context
    variables and stream, and takes no gradients. On other devices both would compete for the same cores, so
    the function is called at once.
    """

    def __init__(self, function: Callable[[], T], device: torch.device) -> None:
        self._pool = None
        if device.type != "cuda":
            answer = function()
            self.result: Callable[[], T] = lambda: answer
            return
        context, stream = contextvars.copy_context(), torch.cuda.current_stream(device)

        def work() -> T:
            with torch.no_grad(), torch.cuda.stream(stream):
                return context.run(function)

        self._pool = ThreadPoolExecutor(1, thread_name_prefix="geodiff-evidence")
        self.result = self._pool.submit(work).result

    def close(self) -> None:
        """Wait until the thread has ended, whether its answer was asked for or not."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
