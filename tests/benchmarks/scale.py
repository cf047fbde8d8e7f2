"""Estimate the cost of a million pairs: hours, terabytes, and CPU cores per GPU.

Data flow: milliseconds of a guided call (given, from a table of ``tests.benchmarks.gpu``), bytes and CPU
    seconds of the demo pair (measured here) -> a table (``python -m tests.benchmarks.scale``).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pair import run_read_pair
from geodiff_plugin.jobs.prior import prior_of_options
from geodiff_plugin.jobs.records import ReadPair
from geodiff_plugin.jobs.rows import read_columns, result_columns
from geodiff_plugin.jobs.writing import write_pair
from geodiff_plugin.runtime.machine import pick_device

__all__ = ["Pair", "main"]

CARDS = (1, 8, 64)
SECONDS_AN_HOUR = 3600
REPEATS = 5


@dataclass(frozen=True)
class Pair:
    """What a pair takes next to its guided call.

    Attributes:
        read_bytes: of its two image files.
        written_bytes: of its row.
        read_seconds: of one core, to decode it and make it ready.
        row_seconds: of one core, to encode its row.
        folder_seconds: of one core, to write its folder instead.
    """

    read_bytes: int
    written_bytes: int
    read_seconds: float
    row_seconds: float
    folder_seconds: float


def measure_pair() -> Pair:
    """Read the demo pair as a row, guide it by the bundled prior, and encode its result."""
    images = {side: DEMO_PAIR_FOLDER / f"{side}.png" for side in ("left", "right")}
    options = DepthOptions(left=Path(), device="cpu", steps=1)
    row = {"key": "demo", "calib": str(DEMO_PAIR_FOLDER / "calib.txt")}
    row |= {side: path.read_bytes() for side, path in images.items()}

    def read() -> ReadPair:
        return read_columns(options, row)

    run = run_read_pair(prior_of_options(options, pick_device("cpu")), read())
    columns = result_columns(run)
    with tempfile.TemporaryDirectory() as folder, OutFolder(Path(folder) / "out", overwrite=True) as out:
        folder_seconds = _core_seconds(lambda: write_pair(out, run))
    return Pair(
        read_bytes=sum(path.stat().st_size for path in images.values()),
        written_bytes=sum(len(column) for column in columns.values() if isinstance(column, bytes)),
        read_seconds=_core_seconds(read),
        row_seconds=_core_seconds(lambda: result_columns(run)),
        folder_seconds=folder_seconds,
    )


def _core_seconds(work: Callable[[], Any]) -> float:
    """Seconds of one core, the median of some runs."""
    taken = []
    for _ in range(REPEATS):
        started = time.process_time()
        work()
        taken.append(time.process_time() - started)
    return median(taken)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--ms", type=float, required=True, help="milliseconds of a guided call on one GPU")
    parser.add_argument("--pairs", type=int, default=1_000_000)
    parser.add_argument(
        "--driver-bytes", type=int, default=0, help="bytes per listed pair (from tests.benchmarks.many)"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    pair = measure_pair()
    title = f"{options.pairs:,} pairs of the demo pair's size, {options.ms:g} ms/call, one worker per GPU"
    headings = ("GPUs", "pairs/s", "hours", "MB/s read", "MB/s written", "busy cores")
    table = new_table(headings, title)
    for cards in CARDS:
        rate = 1000 * cards / options.ms
        hours = options.pairs / rate / SECONDS_AN_HOUR
        flows = f"{rate * pair.read_bytes / 1e6:.1f}", f"{rate * pair.written_bytes / 1e6:.1f}"
        cores = rate * (pair.read_seconds + pair.row_seconds)
        table.add_row(f"{cards}", f"{rate:.1f}", f"{hours:.1f}", *flows, f"{cores:.1f}")
    show(table)
    print(
        f"Read {options.pairs * pair.read_bytes / 1e12:.2f} TB, "
        f"written {options.pairs * pair.written_bytes / 1e12:.2f} TB."
    )
    print(
        f"CPU seconds per pair: {pair.read_seconds:.3f} to read, {pair.row_seconds:.3f} to encode as a row, "
        f"{pair.folder_seconds:.3f} to write as a folder."
    )
    if options.driver_bytes:
        print(f"The list of pairs takes {options.pairs * options.driver_bytes / 1e9:.1f} GB in the driver.")


if __name__ == "__main__":
    main()
