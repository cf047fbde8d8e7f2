"""The table of a job from those of its shards (``geodiff merge``)."""

from __future__ import annotations

import csv
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import refuse
from geodiff_plugin.jobs.journal import Shard, shards_beside
from geodiff_plugin.jobs.pairs import COLUMNS, SUMMARY
from geodiff_plugin.jobs.tables import write_table

#: Columns of the table that hold numbers.
NUMBERS = ("near_m", "median_m", "far_m", "confidence", "seconds")


def merge_shards(folder: Path) -> list[dict[str, Any]]:
    """Join the tables of all shards of ``geodiff depth --shard`` in a folder into ``pairs.csv``; its rows.

    Raises:
        InputError: no tables of shards, or not all of one job.
    """
    tables = shards_beside(folder / SUMMARY)
    if not tables:
        refuse(f"{folder} holds no table of a shard: give the --out of geodiff depth --shard.")
    counts = sorted({shard.count for shard in tables})
    if len(counts) > 1:
        kinds = " and of ".join(map(str, counts))
        refuse(f"{folder} holds tables of {kinds} shards: remove those that are not of this job.")
    missing = [f"{i}/{counts[0]}" for i in range(counts[0]) if Shard(i, counts[0]) not in tables]
    if missing:
        refuse(f"Shards have no table yet: run --shard {', --shard '.join(missing)}.")
    every = zip_longest(*(_read(path) for path in tables.values()))  # a shard has every so many-th pair
    rows = [row for row in chain.from_iterable(every) if row is not None]
    write_table(folder / SUMMARY, rows)
    return rows


def _read(path: Path) -> list[dict[str, Any]]:
    with open(path, newline="", encoding="utf-8") as file:
        rows = [{name: row.get(name) or None for name in COLUMNS} for row in csv.DictReader(file)]
    return [row | {name: float(value) for name in NUMBERS if (value := row[name])} for row in rows]
