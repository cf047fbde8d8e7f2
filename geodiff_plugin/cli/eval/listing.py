"""``geodiff eval list``: data sets, whether they are there and how to obtain them, and methods."""

from __future__ import annotations

import re
from pathlib import Path

from geodiff_plugin.cli.terminal import print_lines
from geodiff_plugin.evaluation.baselines import FAMILIES, METHODS
from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs

__all__ = ["run_list"]


def _dataset_rows(data: Path | None) -> list[tuple[str, str]]:
    rows = []
    for name, dataset in DATASETS.items():
        count = 0 if data is None else len(find_pairs(data, [name]))
        found = "not found" if data is not None else "no --data given"
        if count or not dataset.needs_folder:
            found = f"{count or 'any number of'} {'sample' if count == 1 else 'samples'}"
        full = f" of {dataset.full_count}" if count and dataset.full_count else ""
        rows.append((name, f"{found}{full}\n{dataset.obtain}"))
    return rows


def _method_rows() -> list[tuple[str, str]]:
    rows = [(name, method.summary) for name, method in METHODS.items()]
    for name, family in FAMILIES.items():
        summary = re.split(r"[.;]", family.__doc__ or " ", maxsplit=1)[0]
        rows.append((f"{name}:...", f"{summary[0].lower()}{summary[1:]}"))
    return [
        *rows,
        ("METHOD@PRIOR", "a method that uses a prior, with another one than --prior's first"),
        ("METHOD#SEED", "the same with another seed than --seed; METHOD@PRIOR#SEED for both"),
    ]


def run_list(data: Path | None) -> None:
    """Print for every data set whether ``data`` has it, how many samples, and how to obtain it.

    Raises:
        ValueError: ``data`` is given and is not a folder.
    """
    print_lines([*_dataset_rows(data), ("", ""), *_method_rows()])
