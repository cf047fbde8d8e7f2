"""Seconds to import the package and to start the command.

Data flow: one fresh interpreter per line -> a table on standard output.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence

from geodiff_plugin.cli.terminal import new_table, show

__all__ = ["STARTS", "main", "seconds"]

STARTS = {
    "python alone": ("-c", "pass"),
    "import geodiff_plugin": ("-c", "import geodiff_plugin"),
    "geodiff --version": ("-m", "geodiff_plugin", "--version"),
    "geodiff --help": ("-m", "geodiff_plugin", "--help"),
    "geodiff depth --help": ("-m", "geodiff_plugin", "depth", "--help"),
    "GeometryGuidance": ("-c", "from geodiff_plugin import GeometryGuidance"),
    "enable_geometry_guidance": ("-c", "from geodiff_plugin import enable_geometry_guidance"),
    "imports of geodiff depth": (
        "-c",
        "from geodiff_plugin.cli.app import _imported as i; i('cli.run.run_depth')",
    ),
}
"""Row of the table -> arguments of the interpreter."""


def seconds(arguments: Sequence[str], repeats: int = 3) -> float:
    """Median seconds of a fresh interpreter with these arguments.

    Args:
        arguments: behind the interpreter's name.
        repeats: runs, >= 1.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=3, help="interpreters per line; the median is shown")
    options = parser.parse_args(arguments)
    table = new_table(("", "seconds"))
    for name, start in STARTS.items():
        table.add_row(name, f"{seconds(start, options.repeats):.2f}")
    show(table)


if __name__ == "__main__":
    main()
