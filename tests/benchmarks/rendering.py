"""Scenes per second of the renderer, by image size and device.

Data flow: nothing -> a table on standard output.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import torch
from rich.console import Console
from rich.table import Table

from geodiff_plugin._internal.checks import bad_value
from tests.scenes.layouts import KINDS, sample_scene
from tests.scenes.mono import render_mono
from tests.scenes.pairs import render_pair

__all__ = ["main", "measure"]


def _rate(work, count: int, device: str) -> float:
    """Calls of ``work(0) ... work(count - 1)`` a second."""
    start = time.perf_counter()
    work(count)
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    return count / (time.perf_counter() - start)


def measure(
    size: tuple[int, int], device: str = "cpu", scenes: int = 20, kind: str | None = None
) -> dict[str, float]:
    """Scenes per second: geometry alone, single views as for training, antialiased stereo pairs.

    Args:
        size: ``(H, W)`` pixels.
        device: where to render.
        scenes: how many to time; pairs take a quarter of them.
        kind: one of ``KINDS``; None for the mixture.

    Returns:
        rates by name.

    Raises:
        ValueError: ``scenes`` below 4.
    """
    if scenes < 4:
        bad_value("scenes", "at least 4", scenes)
    render_mono([0], size, device)  # bakes the textures and warms up
    return {
        "sample_scene": _rate(lambda n: [sample_scene(s, kind) for s in range(n)], scenes, "cpu"),
        "render_mono": _rate(lambda n: render_mono(range(n), size, device, kind=kind), scenes, device),
        "render_pair": _rate(
            lambda n: [render_pair(s, kind, size, device=device) for s in range(n)], scenes // 4, device
        ),
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Command line: ``python -m tests.benchmarks.rendering``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=["96x128", "192x256"], metavar="HxW")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--kind", choices=KINDS, default=None, help="kind of scene (default: all)")
    parser.add_argument("--threads", type=int, default=1, help="number of CPU threads")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    table = Table(title=f"scenes per second on {args.device}, {args.threads} CPU thread(s)")
    for column in ("size", "sample_scene", "render_mono", "render_pair"):
        table.add_column(column, justify="right")
    for text in args.sizes:
        height, width = (int(x) for x in text.lower().split("x"))
        rates = measure((height, width), args.device, args.scenes, args.kind)
        table.add_row(text, *(f"{rates[k]:.1f}" for k in ("sample_scene", "render_mono", "render_pair")))
    Console().print(table)


if __name__ == "__main__":
    main()
