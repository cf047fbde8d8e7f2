"""Threads of torch on the CPU: never more than cores that this process may use.

With twice as many threads as cores a guided call takes twice as long. torch does not count the CPU quota of a
container, and takes any number from ``OMP_NUM_THREADS`` and ``torch.set_num_threads``. The number belongs to
the thread that calls. OpenCV's own, of the whole process, is left alone: more are not slower there.
"""

from __future__ import annotations

import os

import cv2
import torch


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
