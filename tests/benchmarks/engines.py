"""Compare the engines of ``geodiff depth`` on many pairs: one process, and Ray with some workers.

Data flow: rendered pairs in two folders -> the command, once per engine, observed from outside -> a table
    (``python -m tests.benchmarks.many --engine ray``).
"""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pyarrow.parquet as pq

from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef

#: Seconds between two looks at a command: short next to a pair, long next to a look.
INTERVAL_S = 0.25
#: One thread for each process that computes, and none nicer than another: Ray's are nice by 15 without it.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "RAY_worker_niceness": "0"}
#: Pairs that are rendered; all further ones repeat them, as a pair costs the same whatever the others are.
RENDERED = 24
#: Pairs whose list is measured.
LISTED = 100_000


@dataclass(frozen=True)
class Look:
    """A command at one moment: seconds since its start, CPU seconds of all its processes, and results."""

    seconds: float
    cpu_seconds: float
    done: int


@dataclass
class Watch:
    """What a command took, seen from outside.

    Attributes:
        first: when the first results were there: all before it is the start.
        last: when all were there.
        driver_bytes: most memory of the command's own process, without those that it started.
    """

    first: Look | None = None
    last: Look | None = None
    driver_bytes: int = 0
    _cpu_seconds: dict[int, float] = field(default_factory=dict)

    def look(self, process: psutil.Process, started: float, done: int) -> None:
        """Note what a command has taken up to now."""
        with suppress(psutil.Error):
            self.driver_bytes = max(self.driver_bytes, process.memory_info().rss)
            for each in (process, *process.children(recursive=True)):
                with suppress(psutil.Error):
                    self._cpu_seconds[each.pid] = sum(each.cpu_times()[:2])
        now = Look(time.perf_counter() - started, sum(self._cpu_seconds.values()), done)
        self.last = now if self.last is None or done > self.last.done else self.last
        self.first = now if self.first is None and done else self.first

    def seconds_a_pair(self) -> tuple[float, float]:
        """Seconds of the clock and of all CPUs for a pair, between the first results and the last."""
        assert self.first is not None and self.last is not None
        count = self.last.done - self.first.done
        if not count:
            raise ValueError("All results came at once: take more pairs.")
        clock, cpu = self.last.seconds - self.first.seconds, self.last.cpu_seconds - self.first.cpu_seconds
        return clock / count, cpu / count


def folders_done(out: Path) -> int:
    """How many pairs have a folder."""
    return sum(1 for _ in out.glob("*/report.json"))


def rows_done(out: Path) -> int:
    """How many pairs have a row in a Parquet file."""
    return sum(pq.read_metadata(path).num_rows for path in out.glob("part-*"))


def watch(words: list[str], out: Path, done: Callable[[Path], int]) -> Watch:
    """Run ``geodiff`` with these words, and watch it.

    Raises:
        RuntimeError: the command failed; its last lines.
    """
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "geodiff_plugin", *words, "--out", str(out)]
    seen, started = Watch(), time.perf_counter()
    with open(out.with_suffix(".log"), "w+") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        while process.poll() is None:
            seen.look(psutil.Process(process.pid), started, done(out))
            time.sleep(INTERVAL_S)
        if process.returncode:
            log.seek(0)
            raise RuntimeError("".join(log.readlines()[-5:]))
    return seen


def repeat_pairs(options: DepthOptions, count: int) -> None:
    """Copy the pairs that are there under further names, until there are so many."""
    for folder in (options.left, options.right):
        assert folder is not None
        rendered = sorted(folder.iterdir())
        for number in range(len(rendered), count):
            shutil.copy(rendered[number % len(rendered)], folder / f"{number:06}.png")


def bytes_of_a_listed_pair() -> int:
    """Memory of the driver for each pair that it knows: its reference, and its row for Ray."""
    process = psutil.Process()
    before = process.memory_info().rss
    refs = [
        PairRef(f"{n:09}", Path(f"/data/left/{n:09}.png"), Path(f"/data/right/{n:09}.png"))
        for n in range(LISTED)
    ]
    rows = [{"key": ref.name, "state": pickle.dumps(ref)} for ref in refs]
    return (process.memory_info().rss - before) // len(rows)


def words_of(options: DepthOptions) -> list[str]:
    """The command for rendered pairs, one thread an engine's process."""
    cameras = {name: getattr(options, name) for name in ("fx", "fy", "cx", "cy", "baseline")}
    typed = [word for name, value in cameras.items() for word in (f"--{name}", str(value))]
    images = [str(options.left), str(options.right)]
    return ["depth", *images, *typed, "--prior", options.prior, "--device", options.device, "-q"]


def compare_engines(options: DepthOptions, pairs: int, workers: int, folder: Path) -> None:
    """Print a table: the same pairs by one process, and by Ray into folders and into Parquet files."""
    words, on_ray = words_of(options), ["--engine", "ray", "--workers", str(workers)]
    ways = {
        "one process": ([], folders_done),
        f"Ray, {workers} workers, folders": ([*on_ray, "--format", "folders"], folders_done),
        f"Ray, {workers} workers, Parquet": ([*on_ray, "--format", "parquet"], rows_done),
    }
    headings = ("engine", "startup, s", "total, s", "pairs/s", "CPU s/pair", "driver, MB")
    table = new_table(
        headings, f"{pairs} pairs; rates exclude the startup, which ends with the first results"
    )
    for number, (way, (more, done)) in enumerate(ways.items()):
        seen = watch([*words, *more], folder / f"out-{number}", done)
        assert seen.first is not None and seen.last is not None
        clock, cpu = seen.seconds_a_pair()
        whole = f"{seen.first.seconds:.0f}", f"{seen.last.seconds:.0f}"
        table.add_row(way, *whole, f"{1 / clock:.2f}", f"{cpu:.2f}", f"{seen.driver_bytes / 1e6:.0f}")
    show(table)
    print(f"Each listed pair takes {bytes_of_a_listed_pair()} bytes in the driver.")
