"""Threads: of torch on the CPU, never more than cores that this process may use; and ``BackgroundTask``.

With twice as many threads as cores a guided call takes twice as long. torch does not count the CPU quota of a
container, and takes any number from ``OMP_NUM_THREADS`` and ``torch.set_num_threads``. The number belongs to
the thread that calls. OpenCV's own, of the whole process, is left alone: more are not slower there.
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
#: More pieces of work than there ever are at a time: with fewer threads they could wait for each other.
MOST_TASKS = 1 << 16


def available_cores() -> int:
    """Number of cores that this process may use, >= 1, by its affinity and its cgroup's quota."""
    cores = cv2.getNumberOfCPUs()  # reads the quota of cgroups v1 and v2, but only once
    if hasattr(os, "sched_getaffinity"):  # Linux
        cores = min(cores, len(os.sched_getaffinity(0)))
    return max(1, cores)


class WithinCores:
    """Context manager: torch has at most ``available_cores()`` threads inside, afterwards what it had.

    ``among`` parts of a program that work at the same time share the cores. A lower number holds as it is,
    and so does one that is set inside. Once left, it may be entered again.
    """

    _before: int | None = None
    _capped = 0

    def __init__(self, among: int = 1) -> None:
        self._among = among

    def __enter__(self) -> None:
        threads, cores = torch.get_num_threads(), max(1, available_cores() // self._among)
        if threads > cores:
            self._before, self._capped = threads, cores
            torch.set_num_threads(cores)

    def __exit__(self, *exc: object) -> None:
        before, self._before = self._before, None
        if before is not None and torch.get_num_threads() == self._capped:
            torch.set_num_threads(before)


def leaves_cpu_free(device: torch.device) -> bool:
    """Whether work on a device leaves the CPU free, so that work of the CPU beside it saves time."""
    return device.type == "cuda"


class BackgroundTask(Generic[T]):
    """The answer of a function that another thread works out while the caller goes on.

    A guided call on CUDA makes its evidence like this, beside the network's first steps, which are not
    guided; in it the features of the pose check, which keep the CPU busy while the GPU matches; and after it
    the rest of the check and the matches of rows, which only the result asks for, and what the verdict asks
    of them. The thread has the caller's context variables and takes no gradients. On other devices both would
    compete for the same cores, so the function is called at once.

    Args:
        function: what is worked out.
        device: on which it works.
        own_stream: its work on CUDA goes to a stream beside the caller's, after what the caller has asked of
            the device until now. What it reads from the device then does not wait for the caller's network.
        follows: ``False`` where it reads nothing from the device that the caller has made. Then its own
            stream waits for nothing, neither for what other threads have asked of the caller's.
    """

    def __init__(
        self,
        function: Callable[[], T],
        device: torch.device,
        *,
        own_stream: bool = False,
        follows: bool = True,
    ) -> None:
        self._stream, self._waiting = None, set[torch.cuda.Stream]()
        if not leaves_cpu_free(device):
            self._answer = Future[T]()
            self._answer.set_result(function())
            return
        context, ready = contextvars.copy_context(), None
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
        # To start the thread is not enough: the caller would keep Python's lock, for up to five milliseconds,
        # while the thread, whose answer it needs soon, could not ask anything of the device.
        begun.wait()

    @classmethod
    def known(cls, answer: T) -> BackgroundTask[T]:
        """An answer that is there already."""
        return cls(lambda: answer, torch.device("cpu"))

    def result(self) -> T:
        """The answer, or what the function raised; the caller's stream then waits for the thread's."""
        answer = self._answer.result()
        if self._stream is not None:
            stream = torch.cuda.current_stream(self._stream.device)
            if stream != self._stream and stream not in self._waiting:
                stream.wait_stream(self._stream)
                for tensor in tensors_of(answer):  # else their memory could be given away while they are read
                    if tensor.is_cuda:
                        tensor.record_stream(stream)
                self._waiting.add(stream)
        return answer

    def close(self) -> None:
        """Wait until its work and that which its answer holds have ended, whether anybody asked or not.

        The caller's stream waits as well: the memory of what was read is not given away before.
        """
        if self._answer.exception() is None:
            for part in _parts_of(self.result()):
                if isinstance(part, BackgroundTask):
                    part.close()


def _in_new_thread(work: Callable[[], T]) -> Future[T]:
    """Its answer; the thread gives back at its end what CUDA's libraries keep for it, memory among it."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="geodiff-evidence")
    answer = pool.submit(work)
    pool.shutdown(wait=False)  # it ends with its work, even if nobody asks for the answer
    return answer


@functools.cache
def _task_threads(process: int) -> ThreadPoolExecutor:
    """Threads of a process for work of the CPU, one more where all are busy: one may wait for another.

    They stay for what comes next. To start one takes long while others have Python's lock, and who starts it
    waits meanwhile.
    """
    return ThreadPoolExecutor(MOST_TASKS, thread_name_prefix="geodiff-background")


@functools.cache
def _task_stream(device: torch.device) -> torch.cuda.Stream:
    """One stream for all, as memory that one stream has freed is not given to another.

    Its small kernels go before those of a network, of which each would otherwise wait for a large one to end.
    """
    return torch.cuda.Stream(device, priority=-1)


def sent_to_cpu(tensor: Tensor) -> Callable[[], Tensor]:
    """Ask the device for a tensor now; the function that is returned waits for it and gives it on the CPU.

    It does not wait for what the stream of the caller is told in the meantime, as ``tensor.cpu()`` would.
    """
    if not tensor.is_cuda:
        there = tensor.cpu()
        return lambda: there
    sent = tensor.to("cpu", non_blocking=True)
    arrived = torch.cuda.current_stream(tensor.device).record_event()

    def received() -> Tensor:
        arrived.synchronize()
        return sent

    return received


def tensors_of(value: object) -> Iterator[Tensor]:
    """The tensors of a record, of its parts, and of what these have worked out and kept."""
    return (part for part in _parts_of(value) if isinstance(part, Tensor))


def _parts_of(value: object) -> Iterator[object]:
    """What a record, its parts, and what these have worked out and kept are made of in the end."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        value = value.values()
    if isinstance(value, (tuple, list, ValuesView)):
        for part in value:
            yield from _parts_of(part)
    else:
        yield value
