"""List the kernels that a guided call launches on CUDA: geodiff_plugin/_internal/first_launches.json.

    python -m tests.benchmarks.first_launches --write

Data flow: the demo pair, the bundled prior -> one ``Launch`` for each kernel that Triton compiles.
Without ``--write`` it reports whether the file is up to date. ``--compile THREADS`` compiles for an H100,
without a GPU, and prints the seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from diffusers.utils import logging as diffusers_logging
from triton.backends.compiler import GPUTarget
from triton.runtime import driver

from geodiff_plugin._internal import compilation as _compilation
from geodiff_plugin._internal.compilation import FIRST_LAUNCHES, Launch, compile_kernels
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from tests.benchmarks.launches import Counting, as_on_cuda, guided_demo_call
from tests.benchmarks.measuring import holders

__all__ = ["as_text", "compiled_in", "first_launches"]

#: Compute capability of an H100.
CAPABILITY = 90
#: Triton compiles another kernel for integers of 1 and for multiples of this.
DIVISOR = 16


class _Recording(Counting):
    """Keeps what is launched."""

    def __init__(self) -> None:
        super().__init__()
        self.launches: dict[str, Launch] = {}

    def launch(self, kernel: Any, grid: Any) -> Callable[..., None]:
        """In place of ``kernel[grid]``: keeps one launch of all for which the same is compiled."""

        def kept(*args: Any, **kwargs: Any) -> None:
            if self._off:
                return
            module = kernel.fn.__module__.partition(".")[2]
            arguments = [str(x.dtype)[6:] if isinstance(x, torch.Tensor) else x for x in args]
            made = Launch(module, kernel.fn.__name__, arguments, kwargs)
            self.launches.setdefault(_compiled_for(kernel, made), made)

        return kept


def _compiled_for(kernel: Any, launch: Launch) -> str:
    """What of a launch Triton compiles for, as a key."""
    seen: list[Any] = [launch.module, launch.kernel, launch.options]
    for parameter, value in zip(kernel.params, launch.arguments, strict=False):
        if parameter.is_constexpr or isinstance(value, (str, bool)):
            seen.append(value)
        elif isinstance(value, int):
            is_seen = not parameter.do_not_specialize
            seen.append((value == 1, value % DIVISOR == 0) if is_seen else "int")
        else:
            seen.append("float")
    return repr(seen)


def as_text(launches: Sequence[Launch]) -> str:
    """JSON that ``read_launches`` reads, a line each."""
    return "[\n" + ",\n".join(json.dumps(asdict(launch)) for launch in launches) + "\n]\n"


def first_launches() -> list[Launch]:
    """Those of a guided call of the demo pair, by module and kernel."""
    pipe, recording = enable_geometry_guidance(load_bundled_prior()), _Recording()
    call = guided_demo_call(pipe, None)
    with as_on_cuda(recording, pipe), ExitStack() as stack:
        # It takes an option of CUDA's launches out of others.
        for owner, name, _ in list(holders("launched_on")):
            stack.enter_context(patch.object(owner, name, lambda tensor, launch: launch))
        call()
    return sorted(recording.launches.values(), key=lambda launch: (launch.module, launch.kernel))


class _Card:
    """Stands in for Triton's driver of a card that is not there: kernels are compiled, and never loaded."""

    def get_current_target(self) -> GPUTarget:
        return GPUTarget("cuda", CAPABILITY, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0


@contextmanager
def without_card(cache: str) -> Iterator[None]:
    """Triton compiles for a card that is not there, into a cache of its own."""
    with ExitStack() as stack:
        stack.enter_context(patch.dict(os.environ, {"TRITON_CACHE_DIR": cache}))
        stack.enter_context(patch.object(torch.version, "hip", None))
        stack.enter_context(patch.object(torch.cuda, "device", lambda device: nullcontext()))
        stack.enter_context(patch.object(driver, "_active", _Card()))
        yield


def compiled_in(threads: int) -> tuple[float, int]:
    """Seconds in which so many threads compile all of them, and how many kernels there are then."""
    with tempfile.TemporaryDirectory() as cache, without_card(cache):
        started = time.perf_counter()
        with patch.object(_compilation, "available_cores", lambda: threads):
            compile_kernels(torch.device("cuda"), lambda line: None)
        return time.perf_counter() - started, len(list(Path(cache).glob("*/*.cubin")))


def main() -> None:
    """Write the file, check it, or compile."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--write", action="store_true", help="write the file")
    parser.add_argument("--compile", type=int, metavar="THREADS", help="number of threads that compile")
    diffusers_logging.set_verbosity_error()
    typed = parser.parse_args()
    if typed.compile:
        seconds, kernels = compiled_in(typed.compile)
        print(f"{typed.compile} threads: {kernels} kernels in {seconds:.1f} s")
        return
    launches = first_launches()
    if typed.write:
        FIRST_LAUNCHES.write_text(as_text(launches), encoding="utf-8")
    elif as_text(launches) != FIRST_LAUNCHES.read_text(encoding="utf-8"):
        raise SystemExit("Not up to date: python -m tests.benchmarks.first_launches --write")
    print(f"{len(launches)} kernels")


if __name__ == "__main__":
    main()
