"""Compile the kernels for the first guided call in advance, in parallel on all cores.

Triton compiles each kernel on its first launch, one after another. The compilers mostly run without the GIL,
so threads speed this up.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin._internal.kernels import compilation_ahead
from geodiff_plugin._internal.lazy import imported
from geodiff_plugin._internal.threads import available_cores

#: Kernel launches of a guided call on a rectified pair, from ``python -m tests.benchmarks.first_launches
#: --write``.
FIRST_LAUNCHES = Path(__file__).with_name("first_launches.json")
#: Maximum number of threads. More would be idle while the largest kernel is compiled.
MAX_THREADS = 16


@dataclass(frozen=True)
class Launch:
    """The properties of a kernel launch that Triton compiles for.

    Attributes:
        module: module of the kernel, relative to this package.
        kernel: name of the kernel.
        arguments: for each argument the dtype of a tensor or the value of a number.
        options: constants of the kernel and launch options; a list represents a tuple.
    """

    module: str
    kernel: str
    arguments: Sequence[str | float]
    options: Mapping[str, Any]

    def compile(self) -> None:
        """Compile the kernel for the current device, or load it from Triton's cache."""
        kernel = imported(f"{self.module}.{self.kernel}")
        arguments = [getattr(torch, each) if isinstance(each, str) else each for each in self.arguments]
        options = {k: tuple(v) if isinstance(v, list) else v for k, v in self.options.items()}
        kernel.warmup(*arguments, grid=(1,), **options)


def read_launches() -> list[Launch]:
    """Read the launches from ``FIRST_LAUNCHES``."""
    return [Launch(**row) for row in json.loads(FIRST_LAUNCHES.read_text(encoding="utf-8"))]


def compile_kernels(device: torch.device, notify: Callable[[str], object]) -> None:
    """Compile the kernels of the first guided call if they are not cached, after calling ``notify``.

    Triton compiles other kernels, such as the kernels for known points, in the call that needs them.
    """
    line = compilation_ahead(device)
    if line is None:
        return
    notify(line)
    with ThreadPoolExecutor(min(available_cores(), MAX_THREADS)) as threads:
        list(threads.map(partial(_compile_on, device), read_launches()))


def _compile_on(device: torch.device, launch: Launch) -> None:
    """Compile a launch in a worker thread, whose current device differs from the caller's."""
    try:
        with torch.cuda.device(device):
            launch.compile()
    except Exception:  # the call compiles the kernel again and raises the error
        logging.getLogger(__name__).debug("%s was not compiled in advance", launch.kernel, exc_info=True)
