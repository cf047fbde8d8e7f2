"""Implements ``geodiff eval baseline``: whether depth follows the length of the baseline, and another K."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geodiff_plugin.evaluation import experiment, tables
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import SampleRef, select
from geodiff_plugin.evaluation.datasets.sample import changed_ref
from geodiff_plugin.evaluation.experiment import Experiment, Page, map_path, run_experiment
from geodiff_plugin.evaluation.options import PairsOptions
from geodiff_plugin.evaluation.tables import Table, cell, headline, label_of
from geodiff_plugin.jobs import Record


class Change(NamedTuple):
    """Factors of all translations, and of the size of the right image."""

    translation: float
    right: float


GIVEN = Change(1.0, 1.0)
#: Changes by heading, without the pair as given; a smaller right image has another K than the left one.
CHANGES = {"b × 0.5": Change(0.5, 1.0), "b × 2": Change(2.0, 1.0), "right × 0.75": Change(1.0, 0.75)}
#: Quantiles of the ratio over the pixels.
QUANTILES = (0.5, 0.05, 0.95)
NOTE = (
    "All translations are multiplied by a factor, or the right image is resized, which changes its K. "
    "The ratio compares depth with the pair as given (median [5 %, 95 %] of the pixels) and should be "
    "the factor. Ground truth is multiplied by it, too."
)

#: Change -> record of one pair and method.
ByChange = Mapping[Change, Record]


def ratio_of(changed_m: np.ndarray, given_m: np.ndarray) -> tuple[float, ...]:
    """``QUANTILES`` of the ratio of two depth maps ``(H, W)`` over pixels with both; NaN for none."""
    both = np.isfinite(changed_m) & np.isfinite(given_m) & (changed_m > 0) & (given_m > 0)
    if not both.any():
        return (float("nan"),) * len(QUANTILES)
    return tuple(np.quantile(changed_m[both] / given_m[both], QUANTILES).tolist())


def _ratio(out: Path, by_change: ByChange, change: Change) -> tuple[float, ...] | None:
    """Return ``ratio_of`` the saved maps of a changed pair and of the given one, if there are both."""
    records = [by_change.get(change), by_change.get(GIVEN)]
    if any(record is None or record["status"] != "ok" for record in records):
        return None
    maps = [np.load(map_path(out, r["method"], r["dataset"], r["sample"])) for r in records if r]
    return ratio_of(*maps)


def ratio_table(title: str, pairs: Mapping[str, ByChange], out: Path) -> Table:
    """Return the ratios and errors of each pair, and their means over rectified and over posed pairs."""
    rows = []
    numbers = dict[str, list[float | None]]()
    for label, by_change in pairs.items():
        ratios = [_ratio(out, by_change, change) for change in CHANGES.values()]
        records = [by_change.get(change) for change in (GIVEN, *CHANGES.values())]
        errors = [headline(record) if record else None for record in records]
        shown = ["-" if r is None else f"{r[0]:.3f} [{r[1]:.3f}, {r[2]:.3f}]" for r in ratios]
        rows.append((label, *shown, *map(cell, errors)))
        numbers[label] = [*(None if r is None else r[0] for r in ratios), *errors]
    given = [by_change[GIVEN] for by_change in pairs.values() if GIVEN in by_change]
    for group, members in tables.groups_of(_named(given, pairs)).items():
        columns = zip(*(numbers[label] for label in pairs if label in members), strict=True)
        rows.append((f"mean of {group}", *(tables.mean_cell(column) for column in columns)))
    header = ("pair", *CHANGES, "as given", *CHANGES)
    groups = (("", 1), ("ratio", len(CHANGES)), ("AbsRel", 1 + len(CHANGES)))
    return Table(title, header, tuple(rows), NOTE, groups)


def _named(records: Sequence[Record], pairs: Mapping[str, ByChange]) -> list[Record]:
    """Return the records under the names of their unchanged pairs."""
    samples = [label.partition("/")[2] for label, by_change in pairs.items() if GIVEN in by_change]
    return [record | {"sample": sample} for record, sample in zip(records, samples, strict=True)]


def run_baseline_scale(name: str, options: PairsOptions) -> Page | None:
    """Measure every pair as given and with each change; errors as in ``run_experiment``."""
    changed = dict[str, tuple[SampleRef, Change]]()
    refs = list[SampleRef]()
    for ref in select(options):
        for change in (GIVEN, *CHANGES.values()):
            refs.append(changed_ref(ref, "scaled", change))
            changed[refs[-1].label] = ref, change
    methods = options.methods or ("guided",)
    cells = experiment.method_cells(refs, methods, options.settings, options.out, save_depth=True)

    def page_tables(records: list[Record]) -> list[Table]:
        """Return a table per method."""
        shown = []
        for method, group in tables.grouped(records, "method").items():
            pairs: dict[str, dict[Change, Record]] = {}
            for record in group:
                ref, change = changed[label_of(record)]
                pairs.setdefault(ref.label, {})[change] = record
            title = f"Depth by baseline, {find_method(method).title}, {tables.count_of_pairs(len(pairs))}"
            shown.append(ratio_table(title, pairs, options.out))
        return shown

    text = (
        f"Prior {options.prior}, seed {options.seed}. All pixels with ground truth; metres without alignment."
    )
    by_scale = Experiment("Depth by baseline", cells, page_tables, lambda _: [text], experiment.RECORDS_NAME)
    return run_experiment(name, options, by_scale)
