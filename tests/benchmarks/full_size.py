"""Cost of guidance at Marigold v1-1's size, with random weights, compared with Marigold-DC's published loop.

Data flow: a seed -> plain, guided, guided with a tiny decoder, Marigold-DC
    -> seconds, memory, operations, ratios.
Paper: S5.4 (cost), as ratios and not as seconds of another machine.

``--count`` runs nothing of that size but counts operations (``operations``).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import torch
from diffusers.utils import logging as diffusers_logging

from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.machine import PeakMemory, pick_device, timed
from tests.benchmarks.measuring import waits_by_place
from tests.benchmarks.operations import WAYS, Size, call_of, calls_of_all, count_operations, tiny_folder
from tests.benchmarks.random_marigold import random_marigold

__all__ = ["Found", "main", "measure"]


@dataclass(frozen=True)
class Found:
    """Seconds of a call, the most memory in bytes, and on CUDA how often the whole call waits for it."""

    seconds: float
    peak_bytes: int
    waits: int | None


def measure(way: str, size: Size, device_name: str, folder: str) -> Found:
    """Cost of one call on the demo pair, to be run in a process of its own.

    Args:
        way: of ``WAYS``.
        size: what is measured.
        device_name: torch device.
        folder: of a tiny autoencoder.
    """
    device = torch.device(device_name)
    pipe = random_marigold(device=device, width=size.width, dtype=getattr(torch, size.dtype))
    pipe.set_progress_bar_config(disable=True)
    call = call_of(way, enable_geometry_guidance(pipe), size, folder)
    with PeakMemory(device) as memory:
        seconds = timed(call, device)
    if size.repeats:
        seconds = min(timed(call, device) for _ in range(size.repeats))
    return Found(seconds, memory.peak_bytes, waits_by_place(call).total() if device.type == "cuda" else None)


def _print_counted(size: Size) -> None:
    operations = count_operations(size)
    print(
        f"Marigold v1-1's configuration x {size.width:g}, {size.resolution} px, {size.steps} steps, by count"
    )
    print("TFLOP of one call: " + ", ".join(f"{kind} {n / 1e12:.3f}" for kind, n in operations.items()))
    print(f"{'':<24}{'TFLOP':>10}{'x plain':>9}  calls", flush=True)
    plain = 0
    for way, calls in calls_of_all(size).items():
        total = sum(n * operations[kind] for kind, n in calls.items())
        plain = plain or total
        counts = ", ".join(f"{n} {kind}" for kind, n in sorted(calls.items()))
        print(f"{way:<24}{total / 1e12:>10.2f}{total / plain:>9.2f}  {counts}", flush=True)
    print("Not counted, because they are not matrix products: evidence, match fitting and the final fit.")


def _print_measured(size: Size, device: torch.device) -> None:
    where = f"{device}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    print(
        f"Marigold v1-1's configuration x {size.width:g}, random weights, {size.dtype}, "
        f"{size.resolution} px, {size.steps} steps (Marigold-DC {size.dc_steps}); {where}; demo pair"
    )
    print(f"{'':<24}{'seconds':>10}{'x plain':>9}{'peak MB':>10}{'x plain':>9}{'waits':>8}", flush=True)
    plain: Found | None = None
    with tempfile.TemporaryDirectory() as parent:
        folder = tiny_folder(parent, size.width)
        for way in WAYS:
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
                found = fresh_process.submit(measure, way, size, str(device), folder).result()
            plain = plain or found
            print(
                f"{way:<24}{found.seconds:>10.2f}{found.seconds / plain.seconds:>9.2f}"
                f"{found.peak_bytes / 1e6:>10.0f}{found.peak_bytes / max(plain.peak_bytes, 1):>9.2f}"
                f"{'-' if found.waits is None else found.waits:>8}",
                flush=True,
            )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:N or mps")
    parser.add_argument("--count", action="store_true", help="count operations with fake tensors instead")
    parser.add_argument(
        "--width", type=float, default=1.0, help="fraction of the published number of channels"
    )
    parser.add_argument("--resolution", type=int, default=768, help="longer side in pixels")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--dc-steps", type=int, default=50, help="number of steps of Marigold-DC")
    parser.add_argument("--dtype", default="float32", choices=("float32", "float16", "bfloat16"))
    parser.add_argument("--repeats", type=int, default=2, help="number of calls after the first")
    typed = parser.parse_args(arguments)
    diffusers_logging.set_verbosity_error()
    size = Size(typed.width, typed.resolution, typed.steps, typed.dc_steps, typed.dtype, typed.repeats)
    if typed.count:
        _print_counted(size)
    else:
        _print_measured(size, pick_device(typed.device))


if __name__ == "__main__":
    main()
