"""Gain from overlapping the stages of ``geodiff depth`` on many pairs, compared with one pair at a time.

Data flow: rendered pairs in two folders -> the stages of the command, overlapped and not -> a table
    (``python -m tests.benchmarks.many``); with ``--engine ray``, the command by one process and by Ray.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.jobs.journal import Item, Journal
from geodiff_plugin.jobs.many import Stages, count_writers
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import start_many
from geodiff_plugin.jobs.prior import load_guided_prior
from geodiff_plugin.jobs.runner import Runner
from geodiff_plugin.options import ENGINES
from geodiff_plugin.runtime.machine import pick_device
from tests.scenes import render_pair

__all__ = ["WAYS", "ManyPairs", "main"]

#: Name -> pairs that may be on the way at a time (as many as the command has), and whether matching and
#: guiding share the cores.
WAYS = {
    "one after the other": (1, False),
    "overlapped, all threads each": (None, False),
    "overlapped": (None, True),
}
KIND, BASELINE_M = "street", 0.54


def write_pairs(folder: Path, count: int, size: tuple[int, int]) -> DepthOptions:
    """Write rendered pairs of one rig, and give the options that ``geodiff depth`` takes for them.

    Args:
        folder: for ``left``, ``right`` and ``out``.
        count: pairs.
        size: ``(H, W)`` pixels.
    """
    height, width = size
    K = np.array([[0.6 * width, 0, (width - 1) / 2], [0, 0.6 * width, (height - 1) / 2], [0, 0, 1]])
    for seed in range(count):
        pair = render_pair(seed, KIND, size, BASELINE_M, K_left=K)
        for side in ("left", "right"):
            (folder / side).mkdir(exist_ok=True)
            pixels = (getattr(pair, side).image_01 * 255).round().byte().permute(1, 2, 0).numpy()
            Image.fromarray(pixels).save(folder / side / f"{seed:06}.png")
    return DepthOptions(
        left=folder / "left",
        right=folder / "right",
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        baseline=BASELINE_M,
        out=folder / "out",
        overwrite=True,
        quiet=True,
    )


class ManyPairs:
    """The work of a run on many pairs, to be done as often as wanted with the same prior.

    Args:
        options: of the run.
        pipe: a guided pipeline, in place of the prior that the options name.
    """

    def __init__(self, options: DepthOptions, pipe: Any = None) -> None:
        self._options, self._refs = options, start_many(options)
        self._device = pick_device(options.device)
        self._pipe = load_guided_prior(options.prior, self._device) if pipe is None else pipe
        self._stages = dict[int, Stages]()  # kept: next to a GPU each starts processes

    def close(self) -> None:
        """End what the stages have opened and started."""
        for stages in self._stages.values():
            stages.close()

    def seconds(self, most: int | None, shared: bool) -> tuple[float, float]:
        """Seconds of a clock and of all cores for all pairs.

        Args:
            most: pairs that may be on the way at a time; ``None`` for as many as the command has.
            shared: matching and guiding share the cores, as in the command.

        Raises:
            Exception: what a stage raised.
        """
        among = 2 if shared else 1
        if among not in self._stages:
            writers = count_writers(self._device, len(self._refs), 1)
            stages = Stages(self._options, self._device, self._pipe, among=among, writers=writers)
            self._stages[among] = stages
        stages = self._stages[among]
        with tempfile.TemporaryDirectory() as folder:
            items = [Item(ref.name, ref) for ref in self._refs]
            with Journal(Path(folder) / "pairs.jsonl") as journal:
                runner = Runner(items, journal, progress=False)
                clock, cores = time.perf_counter(), time.process_time()
                runner.run(*stages.all, release=stages.release, most=most)
                return time.perf_counter() - clock, time.process_time() - cores


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(375, 1242), metavar=("H", "W"))
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--prior", default="bundled")
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads, rows for each"
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="number of alternating runs; the median is shown"
    )
    parser.add_argument("--engine", choices=ENGINES, default="local", help="ray: compare the engines")
    parser.add_argument("--workers", type=int, default=2, help="number of Ray workers")
    options = parser.parse_args(arguments)
    if options.engine == "ray":
        from tests.benchmarks.engines import RENDERED, compare_engines, repeat_pairs  # ray

        with tempfile.TemporaryDirectory() as folder:
            typed = write_pairs(Path(folder), min(options.pairs, RENDERED), tuple(options.size))
            repeat_pairs(typed, options.pairs)
            typed = replace(typed, device=options.device, prior=options.prior)
            compare_engines(typed, options.pairs, options.workers, Path(folder))
        return
    table = new_table(("threads", *WAYS, "ratio"), "seconds of a clock (of all cores) a pair")
    before = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        typed = write_pairs(Path(folder), options.pairs, tuple(options.size))
        many = ManyPairs(replace(typed, device=options.device, prior=options.prior))
        stack.callback(many.close)
        many.seconds(1, False)  # warms up
        for threads in options.threads:
            torch.set_num_threads(threads)
            taken = {way: [] for way in WAYS}
            for _ in range(options.repeats):
                for way, how in WAYS.items():
                    taken[way].append([value / options.pairs for value in many.seconds(*how)])
            clock, cores = ({way: median(t[i] for t in taken[way]) for way in WAYS} for i in (0, 1))
            ratio = clock["overlapped"] / clock["one after the other"]
            shown = [f"{clock[way]:.2f} ({cores[way]:.2f})" for way in WAYS]
            table.add_row(f"{threads}", *shown, f"{ratio:.2f}")
    torch.set_num_threads(before)
    show(table)


if __name__ == "__main__":
    main()
