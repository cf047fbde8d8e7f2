"""Select the implementation of a stage: its Triton kernel, or its reference in plain torch.

Other code calls the reference of a stage. ``has_kernel`` registers its kernel, which has the same parameters
and the same result. Kernels are selected nowhere else. A kernel runs on CUDA if Triton can be imported (it
ships with torch for Linux), unless ``without_kernels`` disables it. With the environment variable
``TRITON_INTERPRET=1`` kernels also run on CPU tensors, so that tests can compare both without a GPU.
"""

from __future__ import annotations

import functools
import importlib.util
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch

from geodiff_plugin._internal.lazy import imported

P = ParamSpec("P")
R = TypeVar("R")

#: Name in Triton's cache of a kernel that every guided call with a second view launches.
ALWAYS_LAUNCHED = "paths_kernel"
_switched_on: ContextVar[bool] = ContextVar("geodiff_kernels", default=True)
#: Triton caches that are known to hold compiled kernels. A lookup takes milliseconds, during which the GPU
#: would be idle at every call.
_FILLED = set[Path]()


@functools.cache
def has_triton() -> bool:
    """Whether Triton is installed."""
    return importlib.util.find_spec("triton") is not None


def interpreting() -> bool:
    """Whether Triton's interpreter runs kernels on the CPU. Triton reads the same variable on import."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def use_kernel(tensor: torch.Tensor) -> bool:
    """Whether a stage that works on ``tensor`` runs its kernel instead of its reference."""
    # ROCm devices are also called "cuda", but the kernels have never been tested there.
    on_device = tensor.is_cuda and torch.version.hip is None
    return _switched_on.get() and has_triton() and (on_device or interpreting())


def has_kernel(
    kernel: str, *, when: Callable[..., bool] | None = None
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a reference so that its kernel runs instead if ``use_kernel`` returns ``True``.

    The first tensor among the arguments and the fields of dataclass arguments determines the device.

    Args:
        kernel: dotted name of a function in this package, with the parameters and the result of the
            reference. Its module imports Triton and is imported when the kernel first runs, so it must not
            import the module of the reference.
        when: function of the same arguments that returns whether the kernel supports them. ``None``: the
            kernel supports all arguments.
    """

    def decorate(reference: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(reference)
        def stage(*args: P.args, **kwargs: P.kwargs) -> R:
            tensor = _first_tensor((*args, *kwargs.values()))
            if use_kernel(tensor) and (when is None or when(*args, **kwargs)):
                by_kernel: Callable[P, R] = imported(kernel)
                return by_kernel(*args, **kwargs)
            return reference(*args, **kwargs)

        return stage

    return decorate


def _first_tensor(values: Iterable[object]) -> torch.Tensor:
    """Return the first tensor among ``values`` and the fields of dataclasses and tuples."""
    for value in values:
        if isinstance(value, torch.Tensor):
            return value
        fields = value if isinstance(value, tuple) else vars(value).values() if is_dataclass(value) else ()
        for field in fields:
            if isinstance(field, torch.Tensor):
                return field
    raise TypeError("a stage with a kernel needs a tensor among its arguments")


def launch_bound(tensor: torch.Tensor) -> bool:
    """Whether small operations on ``tensor`` are dominated by launch overhead.

    Few large operations are then faster. On a CPU many small operations are faster, because their data stays
    in its caches. With Triton's interpreter the device path is used, so that tests can compare both.
    """
    return tensor.device.type != "cpu" or interpreting()


def kernels_in_use() -> str:
    """Describe for ``geodiff info`` whether stages run as kernels on this machine, and if not, why."""
    if not has_triton():
        return "plain PyTorch: Triton is not installed"
    if interpreting():
        return "Triton's interpreter on the CPU"
    if not torch.cuda.is_available() or torch.version.hip is not None:
        return "plain PyTorch: kernels need CUDA"
    return "Triton on CUDA, compiled on the first call on a machine"


def compilation_ahead(device: torch.device) -> str | None:
    """Return a message if the first guided call on a device will compile kernels, else ``None``.

    Kernels are compiled if Triton's cache does not have them. The cache is in ``TRITON_CACHE_DIR``, by
    default ``~/.triton/cache``, and separate for each GPU model and version of Triton.
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
    return "The first guided call compiles its Triton kernels, which takes a few seconds; Triton caches them."


def launched_on(tensor: torch.Tensor, launch: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap ``kernel[grid]`` to launch on a tensor's device. Triton launches on the current device."""

    def launched(*args: Any, **kwargs: Any) -> None:
        if not tensor.is_cuda:  # Triton's interpreter does not support this option
            kwargs.pop("launch_cooperative_grid", None)
        with torch.cuda.device_of(tensor):
            launch(*args, **kwargs)

    return launched


@contextmanager
def without_kernels(off: bool = True) -> Iterator[None]:
    """Run the reference of every stage in this thread within the block if ``off``."""
    token = _switched_on.set(_switched_on.get() and not off)
    try:
        yield
    finally:
        _switched_on.reset(token)
