"""What guidance costs at the size of Marigold v1-1, with random weights, as ``geodiff bench`` prints it.

Hop: a seed -> plain, guided ("denoised"), guided ("full") -> ratios.
Paper: S5.4 (cost), as ratios and not as seconds of another machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from diffusers import MarigoldDepthPipeline

from geodiff_plugin.cli.bench import Workload, run_bench
from geodiff_plugin.development.random_marigold import random_marigold

__all__ = ["FULL_SIZE", "main"]


def _load(device: torch.device) -> MarigoldDepthPipeline:
    return random_marigold(device=device)


FULL_SIZE = Workload(
    "Marigold v1-1's configuration, random weights, 256 px, 1 step, 1 update",
    _load,
    knobs={"inner_steps": 1, "min_steps": 1},
    options={"processing_resolution": 256},
    repeats=0,
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:N or mps")
    run_bench(parser.parse_args(arguments).device, FULL_SIZE)


if __name__ == "__main__":
    main()
