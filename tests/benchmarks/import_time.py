"""Seconds to import the package, to start the command, and of each stage of ``geodiff depth``.

Data flow: fresh interpreters, which alternate between the lines -> two tables on standard output.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.cli.terminal import new_table, show

__all__ = ["STARTS", "main", "medians", "stage_rows", "stages"]

Starts = Mapping[str, Sequence[str]]

STARTS: Starts = {
    "python alone": ("-c", "pass"),
    "import geodiff_plugin": ("-c", "import geodiff_plugin"),
    "geodiff --version": ("-m", "geodiff_plugin", "--version"),
    "geodiff --help": ("-m", "geodiff_plugin", "--help"),
    "geodiff depth --help": ("-m", "geodiff_plugin", "depth", "--help"),
    "GeometryGuidance": ("-c", "from geodiff_plugin import GeometryGuidance"),
    "enable_geometry_guidance": ("-c", "from geodiff_plugin import enable_geometry_guidance"),
    "from diffusers import MarigoldDepthPipeline": ("-c", "from diffusers import MarigoldDepthPipeline"),
    "import geodiff_plugin.cli.run": ("-c", "import geodiff_plugin.cli.run"),
}
"""Row of the table -> arguments of the interpreter."""
#: Context in which commands import, without two imports of diffusers that they do not need.
AS_COMMANDS = (
    "from geodiff_plugin._internal.lazy import fewer_imports, gc_frozen\nwith gc_frozen(), fewer_imports(): "
)


def stages(out: Path) -> Starts:
    """Return the stages of ``geodiff depth`` on the bundled pair, each of which includes those before it.

    Args:
        out: folder for the results of the command.
    """
    left, right, calib = (str(DEMO_PAIR_FOLDER / name) for name in ("left.png", "right.png", "calib.txt"))
    command = ("depth", left, right, "--calib", calib, "-o", str(out), "--overwrite", "-q")
    return {
        "python": ("-c", "pass"),
        "torch": ("-c", f"{AS_COMMANDS}import torch"),
        "diffusers and transformers": ("-c", f"{AS_COMMANDS}from diffusers import MarigoldDepthPipeline"),
        "this package": ("-c", f"{AS_COMMANDS}import geodiff_plugin.cli.run"),
        "work": ("-m", "geodiff_plugin", *command),
    }


def medians(starts: Starts, repeats: int = 3) -> dict[str, float]:
    """Return the median seconds of fresh interpreters, which alternate so that a load affects all rows alike.

    Args:
        starts: row -> arguments of the interpreter.
        repeats: runs per row, >= 1.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    taken: dict[str, list[float]] = {name: [] for name in starts}
    for _ in range(repeats):
        for name, arguments in starts.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
            taken[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in taken.items()}


def stage_rows(seconds: Mapping[str, float]) -> list[tuple[str, str, str, str]]:
    """Return stage, seconds up to its end, its own seconds, and these in percent of the last stage's end."""
    total, before, rows = list(seconds.values())[-1], 0.0, []
    for name, end in seconds.items():
        own = end - before
        rows.append((name, f"{end:.2f}", f"{own:.2f}", f"{100.0 * own / total:.0f}"))
        before = end
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=3, help="interpreters per line; the median is shown")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        of_depth = stages(Path(folder))
        # Keys differ, so that both tables are measured in the same rounds.
        seconds = medians(dict(STARTS) | dict(of_depth), options.repeats)
    table = new_table(("", "seconds"))
    for name in STARTS:
        table.add_row(name, f"{seconds[name]:.2f}")
    show(table)
    table = new_table(("geodiff depth, bundled pair", "ends at, s", "seconds", "% of the command"))
    for row in stage_rows({name: seconds[name] for name in of_depth}):
        table.add_row(*row)
    show(table)


if __name__ == "__main__":
    main()
