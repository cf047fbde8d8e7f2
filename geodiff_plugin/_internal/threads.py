"""Limit torch's CPU threads to the available cores, and run functions in the background.

With twice as many threads as cores a guided call takes twice as long. torch ignores the CPU quota of a
container, and accepts any number from ``OMP_NUM_THREADS`` and ``torch.set_num_threads``. The number belongs
to the calling thread. OpenCV's number of threads is not changed, because more threads do not slow it down.
"""

from __future__ import annotations

import contextvars
import functools
import os
import threading
from collections.abc import Callable, Iterator, Mapping, ValuesView
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import is_dataclass
from typing import Generic, TypeVar

import cv2
import torch
from torch import Tensor

T = TypeVar("T")
#: Maximum number of threads, more than there are concurrent tasks. With fewer threads, tasks could deadlock.
MAX_TASKS = 1 << 16


def available_cores() -> int:
    """Return the number of cores available to this process, >= 1, from its affinity and cgroup quota."""
    cores = cv2.getNumberOfCPUs()  # reads the quota of cgroups v1 and v2 once
    if hasattr(os, "sched_getaffinity"):  # Linux
        cores = min(cores, len(os.sched_getaffinity(0)))
    return max(1, cores)


class WithinCores:
    """Context manager that limits torch to ``available_cores()`` threads and restores the number on exit.

    The cores are divided by ``among``, the number of concurrent parts of a program. A lower number of threads
    is kept, and so is a number that is set inside the block. The context manager is reusable.
    """

    _before: int | None = None
    _capped = 0

    def __init__(self, among: int = 1) -> None:
        self._among = among

    def __enter__(self) -> None:
        threads = torch.get_num_threads()
        cores = max(1, available_cores() // self._among)
        if threads > cores:
            self._before, self._capped = threads, cores
            torch.set_num_threads(cores)

    def __exit__(self, *exc: object) -> None:
        before = self._before
        self._before = None
        if before is not None and torch.get_num_threads() == self._capped:
            torch.set_num_threads(before)


def leaves_cpu_free(device: torch.device) -> bool:
    """Whether work on a device leaves the CPU free, so that concurrent CPU work saves time."""
    return device.type == "cuda"


class BackgroundTask(Generic[T]):
    """The result of a function that runs in another thread while the caller continues.

    A guided call on CUDA uses background tasks for three purposes. It prepares the evidence during the
    network's first steps, which are not guided. During that, it computes the features of the pose check on
    the CPU while the GPU matches. Afterwards it computes what only the result and the verdict need: the rest
    of the pose check and the row matches. The thread inherits the caller's context variables and computes no
    gradients. On other devices both threads would compete for the same cores, so the function runs
    immediately in the caller's thread.

    Args:
        function: function to run.
        device: device on which the function works.
        own_stream: whether the function uses its own CUDA stream, which starts after the work that the caller
            has enqueued so far. Its reads from the device then do not wait for the caller's network.
        follows: ``False`` if the function reads no data that the caller created on the device. Its stream
            then waits for no other work.
    """

    def __init__(
        self,
        function: Callable[[], T],
        device: torch.device,
        *,
        own_stream: bool = False,
        follows: bool = True,
    ) -> None:
        self._stream = None
        self._waiting = set[torch.cuda.Stream]()
        if not leaves_cpu_free(device):
            self._answer = Future[T]()
            self._answer.set_result(function())
            return
        context = contextvars.copy_context()
        ready = None
        if device.type == "cuda":
            self._stream = torch.cuda.current_stream(device)
            if own_stream:
                ready = self._stream.record_event() if follows else None
                self._stream = _task_stream(device)

        begun = threading.Event()

        def work() -> T:
            begun.set()
            with torch.no_grad(), torch.cuda.stream(self._stream):
                if ready is not None:
                    ready.wait()
                return context.run(function)

        if not own_stream:
            self._answer = _task_threads(os.getpid()).submit(work)
            return
        self._answer = _in_new_thread(work)
        # Wait until the thread runs. Otherwise the caller could keep the GIL for up to five milliseconds, in
        # which the thread, whose result is needed soon, could not enqueue any work.
        begun.wait()

    @classmethod
    def known(cls, answer: T) -> BackgroundTask[T]:
        """Create a task whose result is already known."""
        return cls(lambda: answer, torch.device("cpu"))

    def result(self) -> T:
        """Return the result or raise the function's exception; the caller's stream waits for the thread's."""
        answer = self._answer.result()
        if self._stream is not None:
            stream = torch.cuda.current_stream(self._stream.device)
            if stream != self._stream and stream not in self._waiting:
                stream.wait_stream(self._stream)
                for tensor in tensors_of(answer):  # prevents reuse of their memory while they are read
                    if tensor.is_cuda:
                        tensor.record_stream(stream)
                self._waiting.add(stream)
        return answer

    @property
    def failed(self) -> bool:
        """Whether the function raised an exception; waits for its end."""
        return self._answer.exception() is not None

    def close(self) -> None:
        """Wait until the function has ended, even if its result is not used."""
        if not self.failed:
            self.result()


def _in_new_thread(work: Callable[[], T]) -> Future[T]:
    """Run ``work`` in a new thread. At its end, CUDA libraries release resources such as memory."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="geodiff-evidence")
    answer = pool.submit(work)
    pool.shutdown(wait=False)  # the thread ends with its work
    return answer


@functools.cache
def _task_threads(process: int) -> ThreadPoolExecutor:
    """Return the process's pool for CPU tasks, which grows if all threads are busy to avoid deadlocks.

    The threads are reused, because starting a thread blocks the caller for long while others hold the GIL.
    """
    return ThreadPoolExecutor(MAX_TASKS, thread_name_prefix="geodiff-background")


@functools.cache
def _task_stream(device: torch.device) -> torch.cuda.Stream:
    """Return the one stream of all tasks, because memory freed by one stream is not reused by another.

    Its high priority lets its small kernels run before the large kernels of a network.
    """
    return torch.cuda.Stream(device, priority=-1)


def sent_to_cpu(tensor: Tensor) -> Callable[[], Tensor]:
    """Start copying a tensor to the CPU; the returned function waits for the copy and returns it.

    Unlike ``tensor.cpu()``, it does not wait for work that the caller enqueues in the meantime.
    """
    if not tensor.is_cuda:
        copied = tensor.cpu()
        return lambda: copied
    sent = tensor.to("cpu", non_blocking=True)
    arrived = torch.cuda.current_stream(tensor.device).record_event()

    def received() -> Tensor:
        arrived.synchronize()
        return sent

    return received


def tensors_of(value: object) -> Iterator[Tensor]:
    """Yield the tensors in a dataclass, in its fields, and in their cached properties."""
    return (part for part in _parts_of(value) if isinstance(part, Tensor))


def _parts_of(value: object) -> Iterator[object]:
    """Yield the leaves of a dataclass, of its fields, and of their cached properties."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        value = value.values()
    if isinstance(value, (tuple, list, ValuesView)):
        for part in value:
            yield from _parts_of(part)
    else:
        yield value
