"""Seconds of a stock call: ``python -m tests.benchmarks.bundled_prior``.

Data flow: bundled prior, a rendered image -> wall-clock of the stock pipeline at its defaults.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time

import torch

from geodiff_plugin.bundled import load_bundled_prior

__all__ = ["main", "seconds_per_call"]


def seconds_per_call(pipeline, size: tuple[int, int] = (480, 640), repeats: int = 5) -> float:
    """Median seconds of a stock call with default settings, after one warm-up call.

    Args:
        pipeline: a ``MarigoldDepthPipeline``.
        size: of the image, (H, W).
        repeats: timed calls, >= 1.

    Returns:
        Seconds.
    """
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        pipeline(image, generator=torch.Generator(pipeline.device).manual_seed(0))
        taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:])


def main(argv: list[str] | None = None) -> None:
    """Command line; see ``--help``."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.bundled_prior", description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 640), metavar=("H", "W"))
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(argv)
    pipeline = load_bundled_prior(options.device)
    seconds = seconds_per_call(pipeline, tuple(options.size), options.repeats)
    print(
        f"stock call, {options.size[1]}x{options.size[0]} image, processed at "
        f"{pipeline.default_processing_resolution} px, {pipeline.default_denoising_steps} step(s), "
        f"{options.device} ({platform.machine()}, {torch.get_num_threads()} threads): {seconds:.3f} s"
    )


if __name__ == "__main__":
    main()
