"""Reports devices, package versions, time and peak memory of this machine."""

from __future__ import annotations

import functools
import platform
import re
import threading
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import psutil  # comes with accelerate
import torch

from geodiff_plugin._internal.checks import bad_value

PACKAGES = ("geodiff-plugin", "torch", "diffusers", "transformers", "accelerate", "kornia", "numpy", "pillow")
SAMPLING_INTERVAL_S = 0.05
#: Matches the name of a supported device.
DEVICE = re.compile(r"(?P<kind>cuda|mps|cpu)(:(?P<index>0|[1-9][0-9]*))?")


@functools.cache
def _version_of(package: str) -> str:
    """Return a package's version, cached: reading it takes milliseconds and every report includes it."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Return the version of Python and of every package that a result depends on."""
    numbers = {"python": platform.python_version(), "platform": f"{platform.system()} {platform.machine()}"}
    return numbers | {name: _version_of(name) for name in PACKAGES}


def pick_device(name: str) -> torch.device:
    """Return the named device if this machine has it; ``"auto"`` prefers CUDA, then MPS, then the CPU."""
    here = {"cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available()), "cpu": 1}
    if name == "auto":
        return torch.device(next(kind for kind, count in here.items() if count))
    # torch.device wraps numbers to 8 bits: its cuda:256 is cuda:0.
    found = DEVICE.fullmatch(name)
    if found is None:
        bad_value("--device", "auto, cpu, cuda, cuda:N or mps", repr(name))
    kind, index = found["kind"], found["index"]
    count = here[kind]
    if int(index or 0) >= count:
        got = f"PyTorch finds {count or 'no'} {kind} devices."
        bad_value("--device", "a device of this machine", repr(name), got)
    return torch.device(name)


def timed(call: Callable[[], object], device: torch.device) -> float:
    """Measure the seconds of a call; on CUDA until its last kernel has finished."""
    started = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - started


class PeakMemory:
    """Peak memory inside a ``with`` block, available as ``peak_bytes`` afterwards.

    On CUDA it is ``max_memory_allocated``, weights included. On the CPU it is the growth of the process's
    resident set, sampled every 50 ms.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.peak_bytes = device, 0
        self._resident: list[int] = []
        self._process, self._done = psutil.Process(), threading.Event()
        self._sampler = threading.Thread(target=self._sample_until_done, daemon=True)

    def _sample(self) -> None:
        self._resident.append(self._process.memory_info().rss)

    def _sample_until_done(self) -> None:
        while not self._done.wait(SAMPLING_INTERVAL_S):
            self._sample()

    def __enter__(self) -> PeakMemory:
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            self._sample()
            self._sampler.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.device.type == "cuda":
            self.peak_bytes = torch.cuda.max_memory_allocated(self.device)
            return
        self._done.set()
        self._sampler.join()
        self._sample()
        self.peak_bytes = max(self._resident) - self._resident[0]
