"""Which implementation of a stage runs: its Triton kernel, or its reference in plain torch.

Every kernel stands beside its reference, which stays the truth. A kernel runs on CUDA where Triton can be
imported (it ships with torch for Linux), unless ``without_kernels`` switches it off. With the environment
variable ``TRITON_INTERPRET=1`` kernels also run on CPU tensors: that is how tests compare both without a GPU.
"""

from __future__ import annotations

import functools
import importlib.util
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch

#: A kernel that every guided call with a second view launches, by its name in Triton's cache.
ALWAYS_LAUNCHED = "paths_kernel"
_switched_on: ContextVar[bool] = ContextVar("geodiff_kernels", default=True)
#: Triton's caches that are known to hold compiled kernels. To look into one takes milliseconds, in which a
#: GPU would wait at every call.
_FILLED = set[Path]()


@functools.cache
def has_triton() -> bool:
    """Whether Triton is installed."""
    return importlib.util.find_spec("triton") is not None


def interpreting() -> bool:
    """Whether Triton's interpreter runs kernels on the CPU, as Triton itself reads it when it is imported."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def use_kernel(tensor: torch.Tensor) -> bool:
    """Whether a stage that works on ``tensor`` runs its kernel; otherwise its reference runs."""
    # ROCm devices are called "cuda" as well; the kernels were never run there.
    on_device = tensor.is_cuda and torch.version.hip is None
    return _switched_on.get() and has_triton() and (on_device or interpreting())


def launch_bound(tensor: torch.Tensor) -> bool:
    """Whether small operations on ``tensor`` take the time of their launches, so that few large ones pay.

    On a CPU many small ones pay, which stay in its caches. As kernels do, such a stage takes the way of a
    device in Triton's interpreter, where tests compare both.
    """
    return tensor.device.type != "cpu" or interpreting()


def kernels_in_use() -> str:
    """Whether stages run by kernels on this machine, and if not, why; for ``geodiff info``."""
    if not has_triton():
        return "plain torch: Triton is not installed"
    if interpreting():
        return "Triton's interpreter, on the CPU"
    if not torch.cuda.is_available() or torch.version.hip is not None:
        return "plain torch: kernels need CUDA"
    return "Triton on CUDA, compiled at the first call on a machine"


def compilation_ahead(device: torch.device) -> str | None:
    """A sentence for who waits, where the first guided call on a device compiles kernels; else ``None``.

    That is where Triton's cache has none of them yet. It keeps them in ``TRITON_CACHE_DIR``, by default
    ``~/.triton/cache``, for each kind of card and version of Triton.
    """
    on_cuda = device.type == "cuda" and torch.version.hip is None
    if not on_cuda or not _switched_on.get() or not has_triton():
        return None
    home = Path(os.environ.get("TRITON_HOME") or Path.home())
    cache = Path(os.environ.get("TRITON_CACHE_DIR") or home / ".triton" / "cache")
    if cache not in _FILLED and any(cache.glob(f"*/{ALWAYS_LAUNCHED}.cubin")):
        _FILLED.add(cache)
    if cache in _FILLED:
        return None
    return "The first guided call compiles its Triton kernels, which takes some seconds; Triton keeps them."


def launched_on(tensor: torch.Tensor, launch: Callable[..., Any]) -> Callable[..., Any]:
    """``kernel[grid]`` on the device of a tensor: Triton's own launch is on the current device."""

    def launched(*args: Any, **kwargs: Any) -> None:
        if not tensor.is_cuda:  # Triton's interpreter does not know this option
            kwargs.pop("launch_cooperative_grid", None)
        with torch.cuda.device_of(tensor):
            launch(*args, **kwargs)

    return launched


@contextmanager
def without_kernels(off: bool = True) -> Iterator[None]:
    """Run the reference of every stage within the block, in this thread, if ``off``."""
    token = _switched_on.set(_switched_on.get() and not off)
    try:
        yield
    finally:
        _switched_on.reset(token)
