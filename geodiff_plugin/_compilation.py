"""Compiles the kernels of a first guided call before it, on all cores at once.

Triton compiles a kernel where it is first launched, one after the other. Most of that is work of compilers
that do not need Python's lock, so threads share it well.
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

from geodiff_plugin._kernels import compilation_ahead
from geodiff_plugin._lazy import imported
from geodiff_plugin._threads import available_cores

#: What a guided call of a rectified pair launches: ``python -m tests.benchmarks.first_launches --write``.
FIRST_LAUNCHES = Path(__file__).with_name("first_launches.json")
#: More threads than this would have nothing to do while the largest kernel is compiled.
MOST_THREADS = 16


@dataclass(frozen=True)
class Launch:
    """A launch of a kernel, as far as Triton compiles for it.

    Attributes:
        module: of the kernel, below this package.
        kernel: its name there.
        arguments: the number type of a tensor, or the value of a number.
        options: constants of the kernel and of its launch; a list stands for a tuple.
    """

    module: str
    kernel: str
    arguments: Sequence[str | float]
    options: Mapping[str, Any]

    def compile(self) -> None:
        """Compile it for the current device, or load it from Triton's cache."""
        kernel = imported(f"{self.module}.{self.kernel}")
        arguments = [getattr(torch, each) if isinstance(each, str) else each for each in self.arguments]
        options = {k: tuple(v) if isinstance(v, list) else v for k, v in self.options.items()}
        kernel.warmup(*arguments, grid=(1,), **options)


def read_launches() -> list[Launch]:
    """Those of ``FIRST_LAUNCHES``."""
    return [Launch(**row) for row in json.loads(FIRST_LAUNCHES.read_text(encoding="utf-8"))]


def compile_kernels(device: torch.device, tell: Callable[[str], object]) -> None:
    """Compile what a first guided call will launch, where Triton has not yet; ``tell`` hears of it before.

    Triton compiles other kernels, such as those for known points, in the call that needs them.
    """
    line = compilation_ahead(device)
    if line is None:
        return
    tell(line)
    with ThreadPoolExecutor(min(available_cores(), MOST_THREADS)) as threads:
        list(threads.map(partial(_compile_on, device), read_launches()))


def _compile_on(device: torch.device, launch: Launch) -> None:
    """Compile a launch in a thread, whose current device is not that of the thread that asks."""
    try:
        with torch.cuda.device(device):
            launch.compile()
    except Exception:  # the call will compile it as well, and then the error is one of the call
        logging.getLogger(__name__).debug("%s was not compiled ahead", launch.kernel, exc_info=True)
