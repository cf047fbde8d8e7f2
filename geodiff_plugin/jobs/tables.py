"""The table of a run over many pairs, ``pairs.csv``."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from geodiff_plugin.formats.out import atomic_path, reason_of
from geodiff_plugin.jobs.pairs import COLUMNS
from geodiff_plugin.jobs.telling import Tell, silent


def write_table(out: Path, rows: Sequence[dict[str, Any]], tell: Tell = silent) -> None:
    """Write the rows of a run as CSV."""
    try:
        with atomic_path(out) as path, open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:  # what became of the pairs is told, and each result is in its folder
        tell(f"geodiff: {out} could not be written ({reason_of(error)}).")
