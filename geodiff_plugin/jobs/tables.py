"""Writes ``pairs.csv``, the table of a run over many pairs, and merges the tables of shards."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from geodiff_plugin._internal.checks import raise_input_error
from geodiff_plugin.formats import atomic_path, reason_of
from geodiff_plugin.jobs.journal import Shard, shard_files
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.pairs import COLUMNS, SUMMARY

#: Numeric columns of the table.
NUMBERS = ("near_m", "median_m", "far_m", "confidence", "seconds")


def write_table(out: Path, rows: Sequence[dict[str, Any]], notify: Notify = silent) -> None:
    """Write the rows of a run as CSV."""
    try:
        with atomic_path(out) as path, open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:  # outcomes were reported, and each result is in its folder
        notify(f"geodiff: {out} could not be written ({reason_of(error)}).")


def merge_shards(folder: Path) -> list[dict[str, Any]]:
    """Merge the tables of all shards of ``geodiff depth --shard`` into ``pairs.csv``; return its rows.

    Raises:
        InputError: no tables of shards, or not all of one job.
    """
    tables = shard_files(folder / SUMMARY)
    if not tables:
        raise_input_error(f"{folder} has no table of a shard. Pass the --out of geodiff depth --shard.")
    counts = sorted({shard.count for shard in tables})
    if len(counts) > 1:
        kinds = " and of ".join(map(str, counts))
        raise_input_error(f"{folder} has tables of {kinds} shards. Remove tables of other jobs.")
    missing = [f"{i}/{counts[0]}" for i in range(counts[0]) if Shard(i, counts[0]) not in tables]
    if missing:
        raise_input_error(f"Tables of shards are missing. Run --shard {', --shard '.join(missing)}.")
    every = zip_longest(*(_read(path) for path in tables.values()))  # a shard has every N-th pair
    rows = [row for row in chain.from_iterable(every) if row is not None]
    write_table(folder / SUMMARY, rows)
    return rows


def _read(path: Path) -> list[dict[str, Any]]:
    with open(path, newline="", encoding="utf-8") as file:
        rows = [{name: row.get(name) or None for name in COLUMNS} for row in csv.DictReader(file)]
    return [row | {name: float(value) for name in NUMBERS if (value := row[name])} for row in rows]
