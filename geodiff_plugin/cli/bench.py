"""``geodiff bench``: time and memory of a guided call against a plain one, and the seconds of a command."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import torch
from rich.live import Live

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from geodiff_plugin.cli.terminal import new_console, new_table
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.machine import PeakMemory, pick_device, timed
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance

#: Name in the table -> gradient of the guidance, ``None`` for the plain pipeline.
VARIANTS = {"plain": None, "guided, denoised gradient": "denoised", "guided, full gradient": "full"}


@dataclass(frozen=True)
class Workload:
    """What is measured; it travels to another process.

    Attributes:
        title: heading of the table.
        load: function of a module, from a device to a pipeline.
        knobs: of the guidance.
        options: of the call.
        repeats: calls after the first one, of which the fastest tells the seconds; 0: the first one does.
    """

    title: str
    load: Callable[[torch.device], Any]
    knobs: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    repeats: int = 2


def _load_bundled(device: torch.device) -> Any:
    return load_prior("bundled", device=device)


BUNDLED = Workload("bundled prior, default guidance", _load_bundled)


def measure(gradient: str | None, workload: Workload, device_name: str) -> tuple[float, int]:
    """Seconds of one call on the demo pair, and the most bytes that it took; in a process of its own.

    The first call of a process tells its memory, since what is freed later stays with the allocator.

    Args:
        gradient: of the guidance; ``None`` for the plain pipeline.
        workload: prior and settings; plain and guided calls run the same number of steps.
        device_name: torch device.
    """
    device = torch.device(device_name)
    pair = read_demo_pair()
    pipe = workload.load(device)
    pipe.set_progress_bar_config(disable=True)
    enable_geometry_guidance(pipe)
    cameras = (pair.rig.K_left, pair.rig.K_right), pair.rig.E
    guidance = GeometryGuidance(pair.right, *cameras, gradient=gradient or "denoised", **workload.knobs)
    options = workload.options | {"num_inference_steps": guidance.denoising_steps(None, 1)}
    if gradient is not None:
        options["guidance"] = guidance

    def call() -> None:
        pipe(pair.left, generator=torch.Generator("cpu").manual_seed(0), **options)

    with PeakMemory(device) as memory:
        first = timed(call, device)
    return min([timed(call, device) for _ in range(workload.repeats)], default=first), memory.peak_bytes


def command_seconds(device_name: str) -> dict[str, float]:
    """Wall-clock seconds of ``geodiff depth`` on the demo pair by stage, in a process of its own.

    "start" imports torch and diffusers, "python" is what comes before and behind the stages.
    """
    with tempfile.TemporaryDirectory() as folder:
        left, right, calib = (str(DEMO_PAIR_FOLDER / name) for name in ("left.png", "right.png", "calib.txt"))
        words = ["depth", left, right, "--calib", calib, "--device", device_name, "--json", "--quiet"]
        words = [sys.executable, "-m", "geodiff_plugin", *words, "--out", f"{folder}/out"]
        started = time.perf_counter()
        answer = subprocess.run(words, check=True, capture_output=True, text=True)
        whole = time.perf_counter() - started
    stages: dict[str, float] = json.loads(answer.stdout)["seconds"]
    return stages | {"python": whole - sum(stages.values())}


def run_bench(device_name: str, workload: Workload = BUNDLED) -> None:
    """Print the table.

    Args:
        device_name: as ``--device``.
        workload: what is measured.

    Raises:
        ValueError: no such device.
    """
    device, console = pick_device(device_name), new_console()
    where = f"{device}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    console.print(f"{workload.title}; {where}; demo pair")
    table = new_table(("", "seconds", "peak MB", "time x", "memory x"))
    plain = None
    with Live(table, console=console):
        for name, gradient in VARIANTS.items():
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
                cost = fresh_process.submit(measure, gradient, workload, str(device)).result()
            plain = plain or cost
            ratios = cost[0] / plain[0], cost[1] / max(plain[1], 1)
            numbers = (f"{ratio:.2f}" for ratio in ratios)
            table.add_row(name, f"{cost[0]:.2f}", f"{cost[1] / 1e6:.0f}", *numbers)
    stages = command_seconds(device_name)
    told = ", ".join(f"{name} {seconds:.1f}" for name, seconds in stages.items())
    console.print(f"geodiff depth on the demo pair: {sum(stages.values()):.1f} s ({told})")
