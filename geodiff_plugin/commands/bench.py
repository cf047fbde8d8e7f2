"""``geodiff bench``: what guidance costs over the plain pipeline, in time and memory, in one run.

Hop: a prior and the demo pair -> plain, guided ("denoised"), guided ("full") -> ratios.
Paper: S5.4 (cost), as ratios and not as seconds of another machine.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import psutil  # comes with accelerate
import torch

from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.commands.arguments import pick_device
from geodiff_plugin.commands.full_size import random_marigold
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.pipeline import enable_geometry_guidance
from geodiff_plugin.priors import load_prior

__all__ = ["Cost", "PeakMemory", "measure", "run_bench"]

#: Name in the table -> gradient of the guidance, ``None`` for the plain pipeline.
VARIANTS = {"plain": None, "guided, denoised gradient": "denoised", "guided, full gradient": "full"}
SAMPLING_INTERVAL_S = 0.05
TIMED_CALLS = 2
FULL_SIZE_RESOLUTION = 256


@dataclass(frozen=True)
class Cost:
    """Seconds of a call, and the most memory that it took, in bytes."""

    seconds: float
    peak_bytes: int


class PeakMemory:
    """The most memory in use inside a ``with`` block, in ``peak_bytes`` after it.

    CUDA: ``max_memory_allocated``, weights included. CPU: resident set of the process, sampled every
    50 ms, as increase over the start.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.peak_bytes = device, 0
        self._process, self._done = psutil.Process(), threading.Event()
        self._sampler = threading.Thread(target=self._sample, daemon=True)

    def _resident(self) -> int:
        return self._process.memory_info().rss

    def _sample(self) -> None:
        while not self._done.wait(SAMPLING_INTERVAL_S):
            self._highest = max(self._highest, self._resident())

    def __enter__(self) -> PeakMemory:
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            self._start = self._highest = self._resident()
            self._sampler.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.device.type == "cuda":
            self.peak_bytes = torch.cuda.max_memory_allocated(self.device)
            return
        self._done.set()
        self._sampler.join()
        self.peak_bytes = max(self._highest, self._resident()) - self._start


def _timed(call: Callable[[], Any], device: torch.device) -> float:
    started = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - started


def measure(gradient: str | None, full_size: bool, device_name: str) -> Cost:
    """Cost of one call on the demo pair, to be run in a process of its own.

    The first call of a process tells its memory, since what is freed later stays with the allocator. Of a
    small prior later calls tell the time; the full size is timed by its only one.

    Args:
        gradient: of the guidance; ``None`` for the plain pipeline.
        full_size: Marigold v1-1 with random weights at 256 px, 1 step and 1 update, or the bundled prior
            with the default guidance; plain and guided calls run the same number of steps.
        device_name: torch device.
    """
    device = torch.device(device_name)
    pair = read_demo_pair()
    pipe = random_marigold(device=device) if full_size else load_prior("bundled", device=device)
    pipe.set_progress_bar_config(disable=True)
    enable_geometry_guidance(pipe)
    knobs = {"inner_steps": 1, "min_steps": 1} if full_size else {}
    cameras = (pair.rig.K_left, pair.rig.K_right), pair.rig.E
    guidance = GeometryGuidance(pair.right, *cameras, gradient=gradient or "denoised", **knobs)
    options: dict[str, Any] = {"num_inference_steps": guidance.denoising_steps(None, 1)}
    if full_size:
        options["processing_resolution"] = FULL_SIZE_RESOLUTION
    if gradient is not None:
        options["guidance"] = guidance

    def call() -> None:
        pipe(pair.left, generator=torch.Generator("cpu").manual_seed(0), **options)

    with PeakMemory(device) as memory:
        seconds = _timed(call, device)
    if not full_size:
        seconds = min(_timed(call, device) for _ in range(TIMED_CALLS))
    return Cost(seconds, memory.peak_bytes)


def run_bench(full_size: bool, device_name: str) -> None:
    """Print the table.

    Args:
        full_size: as ``measure``.
        device_name: as ``--device``.

    Raises:
        ValueError: no such device.
    """
    device = pick_device(device_name)
    prior = "bundled prior, default guidance"
    if full_size:
        prior = "Marigold v1-1's configuration, random weights, 256 px, 1 step, 1 update"
    print(f"{prior}; {device}, {torch.get_num_threads()} threads, torch {torch.__version__}; demo pair")
    print(f"{'':<28}{'seconds':>9}{'peak MB':>9}{'time x':>8}{'memory x':>10}", flush=True)
    plain = None
    for name, gradient in VARIANTS.items():
        with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
            cost = fresh_process.submit(measure, gradient, full_size, str(device)).result()
        plain = cost if plain is None else plain
        ratios = cost.seconds / plain.seconds, cost.peak_bytes / max(plain.peak_bytes, 1)
        print(
            f"{name:<28}{cost.seconds:>9.2f}{cost.peak_bytes / 1e6:>9.0f}{ratios[0]:>8.2f}{ratios[1]:>10.2f}",
            flush=True,
        )
