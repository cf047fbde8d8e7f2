"""Time, memory, kernel launches and waits of calls on a device, side by side, and seconds of their stages.

Data flow: calls by name, made in turn -> a ``Cost`` each; one call -> milliseconds by function.
"""

from __future__ import annotations

import functools
import statistics
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from geodiff_plugin.runtime.machine import PeakMemory, timed

__all__ = ["Cost", "Traced", "costs", "holders", "stage_milliseconds", "traced", "waits_by_place"]

Call = Callable[[], object]
#: Parts of the names under which CUPTI records that the host launches work, and that it waits for it.
LAUNCHES = ("aunchKernel", "GraphLaunch")
WAITS = ("StreamSynchronize", "EventSynchronize")


@dataclass(frozen=True)
class Traced:
    """What the profiler saw of one call on CUDA.

    Attributes:
        launches: of kernels, or of whole graphs.
        waits: of the host for the device.
        busy_ms: time of the device's kernels and copies.
    """

    launches: int
    waits: int
    busy_ms: float


@dataclass(frozen=True)
class Cost:
    """What a call costs.

    Attributes:
        milliseconds: the median of several calls.
        fastest_ms: the least of them, which is more robust if other work slows the host down occasionally.
        peak_bytes: most memory, as ``PeakMemory`` counts it.
        traced: on CUDA only.
    """

    milliseconds: float
    fastest_ms: float
    peak_bytes: int
    traced: Traced | None


def traced(call: Call) -> Traced:
    """Launches, waits and busy time of a call on CUDA, which has run before."""
    # The runtime's calls alone are far fewer events; an older profiler records them with the operators only.
    for activities in ([ProfilerActivity.CUDA], [ProfilerActivity.CPU, ProfilerActivity.CUDA]):
        torch.cuda.synchronize()
        with profile(activities=activities) as profiler:
            call()
            torch.cuda.synchronize()  # recorded as a synchronisation of the device, which is not counted
        events = profiler.key_averages()
        launches, waits = (
            sum(event.count for event in events if any(part in event.key for part in parts))
            for parts in (LAUNCHES, WAITS)
        )
        if launches:
            break
    # Operators repeat the time of their kernels, which are events of the device.
    of_device = [event for event in events if event.device_type == DeviceType.CUDA]
    return Traced(launches, waits, sum(event.self_device_time_total for event in of_device) / 1e3)


def costs(
    calls: Mapping[str, Call], device: torch.device, repeats: int = 5, until: float = float("inf")
) -> dict[str, Cost | Exception]:
    """The cost of every call, or what it raised.

    After a first round that counts for nothing the calls are made in turn, so that whatever slows the machine
    down slows all of them; a last round is traced.

    Args:
        calls: by name.
        device: where they run.
        repeats: rounds that are timed, >= 1.
        until: time of ``time.monotonic`` from which no further round begins.
    """
    taken: dict[str, list[float]] = {name: [] for name in calls}
    found: dict[str, Cost | Exception] = {}
    for turn in range(repeats + 1):
        if turn > 1 and time.monotonic() > until:
            break
        for name, call in calls.items():
            if name in found:
                continue
            try:
                seconds = timed(call, device)
            except Exception as error:  # one way that fails does not end the others
                traceback.print_exc()
                found[name] = error
                continue
            if turn:
                taken[name].append(seconds)
    for name, call in calls.items():
        if name not in found:
            with PeakMemory(device) as memory:
                call()
            seen = traced(call) if device.type == "cuda" else None
            times = [1e3 * seconds for seconds in taken[name]]
            found[name] = Cost(statistics.median(times), min(times), memory.peak_bytes, seen)
    return found


def waits_by_place(call: Call) -> Counter[str]:
    """How often a call on CUDA waits for the device, by file and line, as torch sees it."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits = [one for one in caught if "synchroniz" in str(one.message)]
    return Counter(f"{'/'.join(one.filename.split('/')[-2:])}:{one.lineno}" for one in waits)


def holders(name: str) -> Iterator[tuple[Any, str, Any]]:
    """Where the package holds a function, or a method as ``Class.method``: owner, attribute, function."""
    modules = [m for key, m in list(sys.modules.items()) if key.partition(".")[0] == "geodiff_plugin"]
    classes = {
        value for module in modules for value in list(vars(module).values()) if isinstance(value, type)
    }
    for owner in (*modules, *classes):
        for attribute, value in list(vars(owner).items()):
            is_of_package = getattr(value, "__module__", None) in sys.modules and callable(value)
            if is_of_package and getattr(value, "__qualname__", None) == name:
                yield owner, attribute, value


@contextmanager
def _clocked(
    places: Sequence[tuple[Any, str, Any]], label: str, device: torch.device, spent: dict[str, list[float]]
) -> Iterator[None]:
    """Take the milliseconds of every call of these functions, with the device waited for around each."""

    def clocked(own: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(own)
        def measured(*args: Any, **kwargs: Any) -> Any:
            results: list[Any] = []
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            seconds = timed(lambda: results.append(own(*args, **kwargs)), device)
            spent.setdefault(label, []).append(1e3 * seconds)
            return results[0]

        return measured

    with ExitStack() as stack:
        for owner, attribute, function in places:
            stack.enter_context(patch.object(owner, attribute, clocked(function)))
        yield


def stage_milliseconds(
    call: Call, stages: Sequence[str], networks: Mapping[str, tuple[Any, str]], device: torch.device
) -> dict[str, list[float] | None]:
    """Milliseconds of every call of the stages within one call; a stage contains those that it calls.

    Args:
        call: what is taken apart.
        stages: functions of the package by name, methods as ``Class.method``.
        networks: label -> object and method.
        device: where it runs.

    Returns:
        Label -> milliseconds, one of each call; ``None`` for a stage that the package does not have.
    """
    spent: dict[str, list[float]] = {}
    places = {name: list(holders(name)) for name in stages}
    places |= {label: [(owner, m, getattr(owner, m))] for label, (owner, m) in networks.items()}
    with ExitStack() as stack:
        for label, found in places.items():
            stack.enter_context(_clocked(found, label, device, spent))
        call()
    return {label: spent.get(label, []) if found else None for label, found in places.items()}
