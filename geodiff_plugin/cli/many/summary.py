"""``pairs.csv``: one row a pair, checked for its place before the work and written behind it.

Data flow: ``--out`` as typed -> a folder that takes the table; rows -> the table.
Paper: none.

Nothing here imports torch: what is wrong with a folder is said at once.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.out import atomic_path, reason_of

__all__ = ["COLUMNS", "SUMMARY", "Row", "check_summary", "write_summary"]

SUMMARY = "pairs.csv"
COLUMNS = ("pair", "result", "near_m", "median_m", "far_m", "trusted", "confidence", "seconds", "message")

Row = dict[str, Any]


def check_summary(folder: Path) -> None:
    """See that the table can be written when the pairs are done, and that no other file is lost by it.

    Nothing is left behind, also no folder: several processes may look at the same time.

    Args:
        folder: of the run, checked by ``check_out``; it need not exist.

    Raises:
        ValueError: it cannot be written to; its ``pairs.csv`` is a folder, or a file of the user's, such as
            the list of pairs.
    """
    path = folder / SUMMARY
    try:
        if os.path.lexists(path) and not _is_summary(path):
            got = f"{path}, which is {'a folder' if path.is_dir() else 'not the table of an earlier run'}"
            cure = f"Name another --out, or move that {SUMMARY}: a table of the results takes its place."
            bad_value("--out", f"a folder whose {SUMMARY} may be replaced", got, cure)
        absolute = folder.absolute()
        there = next(path for path in (absolute, *absolute.parents) if path.exists())
        with TemporaryFile(dir=there) as file:  # finds out whether the disk takes a byte
            file.write(b"0")
    except OSError as error:
        cure = "Name another with --out, or free disk space and check its permissions."
        bad_value("--out", "a folder that can be written to", f"{folder} ({reason_of(error)})", cure)


def _is_summary(path: Path) -> bool:
    """Whether a file has the heading of our table."""
    if not path.is_file():
        return False
    with open(path, encoding="utf-8", errors="replace") as file:
        return file.readline().rstrip("\n") == ",".join(COLUMNS)


def write_summary(folder: Path, rows: Sequence[Row]) -> None:
    """Write the table.

    Args:
        folder: of the run; it is made where it is missing.
        rows: by the names of ``COLUMNS``, one a pair.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (
        atomic_path(folder / SUMMARY) as temporary,
        open(temporary, "w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
