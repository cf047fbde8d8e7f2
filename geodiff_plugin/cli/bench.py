"""``geodiff bench``: time and memory of a guided call against a plain one."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import torch
from rich.live import Live

from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.cli.terminal import new_console, new_table
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.machine import PeakMemory, pick_device, timed
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance

#: Name in the table -> gradient of the guidance, ``None`` for the plain pipeline.
VARIANTS = {"plain": None, "guided, denoised gradient": "denoised", "guided, full gradient": "full"}


def measure(gradient: str | None, device_name: str, repeats: int = 2, **knobs: Any) -> tuple[float, int]:
    """Seconds of one call of the bundled prior on the demo pair, and the most bytes that it took.

    Plain and guided calls run the same number of steps. The first call of a process tells its memory, since
    what is freed later stays with the allocator; the fastest of ``repeats`` more, if any, tells the seconds.
    """
    device, pair = torch.device(device_name), read_demo_pair()
    pipe = load_prior("bundled", device=device)
    pipe.set_progress_bar_config(disable=True)
    enable_geometry_guidance(pipe)
    cameras = (pair.rig.K_left, pair.rig.K_right), pair.rig.E
    guidance = GeometryGuidance(pair.right, *cameras, gradient=gradient or "denoised", **knobs)
    options: dict[str, Any] = {"num_inference_steps": guidance.denoising_steps(None, 1)}
    if gradient is not None:
        options["guidance"] = guidance

    def call() -> None:
        pipe(pair.left, generator=torch.Generator("cpu").manual_seed(0), **options)

    with PeakMemory(device) as memory:
        first = timed(call, device)
    return min([timed(call, device) for _ in range(repeats)], default=first), memory.peak_bytes


def run_bench(device: str) -> None:
    """Print the table; every row is measured in a process of its own."""
    place, console, plain = pick_device(device), new_console(), None
    where = f"{place}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    console.print(f"bundled prior, default guidance; {where}; demo pair")
    table = new_table(("", "seconds", "peak MB", "time x", "memory x"))
    with Live(table, console=console):
        for name, gradient in VARIANTS.items():
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
                cost = fresh_process.submit(measure, gradient, str(place)).result()
            plain = plain or cost
            ratios = (f"{cost[0] / plain[0]:.2f}", f"{cost[1] / max(plain[1], 1):.2f}")
            table.add_row(name, f"{cost[0]:.2f}", f"{cost[1] / 1e6:.0f}", *ratios)
