"""What inexact poses cost, and what refined and estimated ones are worth: ``geodiff eval poses``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import with_poses
from geodiff_plugin.evaluation.datasets import load
from geodiff_plugin.evaluation.datasets.changed import drift_of, drifted_ref, perturbation, perturbed_ref
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, Experiment, headline, method_cells
from geodiff_plugin.evaluation.options import POSES, PosesOptions, command_line, first_pairs, rendered_refs
from geodiff_plugin.evaluation.report import Page
from geodiff_plugin.evaluation.table import Table, cell, count_of_pairs, label_of, mean_with_interval
from geodiff_plugin.runner import Item, Record

__all__ = ["poses_table", "run_poses"]

#: An error above this is of the kind that a wrong scale makes, and must be said.
BY_A_FACTOR = 0.25
#: Smaller images have too few matches to say anything about poses.
SMALLEST_PX = 64
_HEADINGS = {"given": "given", "refine": "refined", "estimated": "estimated"}

#: Heading and records, one a pair.
Column = tuple[str, Sequence[Record]]


def _residual(record: Record, name: str) -> str:
    values = record.get("notes", {}).get("method", {}).get(name) or []
    return " / ".join(f"{px:.2f}" for px in values) or "-"


def _unwarned(records: Sequence[Record]) -> int:
    """Pairs that are off by more than ``BY_A_FACTOR`` without a warning."""
    return sum(
        (headline(record) or 0.0) > BY_A_FACTOR and not record["notes"]["method"].get("warnings")
        for record in records
    )


def _mean(values: Sequence[float | None]) -> str:
    """The mean of those that have a result, with their number where some have none."""
    there = [value for value in values if value is not None]
    mean = cell(mean_with_interval(there).value) if there else "-"
    return mean if len(there) in (0, len(values)) else f"{mean} of {len(there)}"


def poses_table(title: str, columns: Sequence[Column], note: str) -> Table:
    """AbsRel of the same pairs with their poses given in several ways, and what was said.

    Args:
        title: heading.
        columns: heading and records each, of the same pairs.
        note: below the heading.

    Returns:
        A row a pair, then the means of all, of rectified and of posed pairs (of those with a result), then
        how many have none, and how many are off by more than ``BY_A_FACTOR`` without a warning.
    """
    first = columns[0][1]
    values = [[headline(record) for record in records] for _, records in columns]
    rows = [(label_of(record), *(cell(each[i]) for each in values)) for i, record in enumerate(first)]
    groups: dict[str, Callable[[Record], bool]] = {"": lambda record: True}
    if len({record.get("rectified") for record in first}) > 1:
        groups["rectified "] = lambda record: bool(record.get("rectified"))
        groups["posed "] = lambda record: not record.get("rectified")
    for kind, belongs in groups.items():
        members = [i for i, record in enumerate(first) if belongs(record)]
        means = (_mean([each[i] for i in members]) for each in values)
        rows.append((f"mean of {count_of_pairs(len(members), kind)}", *means))
    rows.append(("without a result", *(str(sum(v is None for v in each)) for each in values)))
    off = f"off by more than {BY_A_FACTOR:g}, no warning"
    rows.append((off, *(str(_unwarned(records)) for _, records in columns)))
    return Table(title, ("pair", *(heading for heading, _ in columns)), tuple(rows), note)


def _residual_table(columns: Sequence[Column]) -> Table:
    """Residuals of the matches as given and as used, a row a pair."""
    names = ("residual_px_given", "residual_px")
    rows = [
        (label_of(record), *(_residual(records[i], name) for _, records in columns for name in names))
        for i, record in enumerate(columns[0][1])
    ]
    header = [f"{heading}, {what}" for heading, _ in columns for what in ("as given", "as used")]
    note = "Median distance of the matches from their epipolar lines, pixels; one number a right view."
    return Table("Residuals", ("pair", *header), tuple(rows), note)


class _Part(NamedTuple):
    """A table: its columns are ``(heading before the pose's, references, poses)``."""

    title: str
    note: str
    columns: Sequence[tuple[str, Sequence[SampleRef], Sequence[str]]]
    views: int = 2
    residuals: bool = False


def _parts(options: PosesOptions) -> list[_Part]:
    real, size = first_pairs(options.data, options.limit), _size(options.rendered_size)
    rendered = rendered_refs(f"synthetic-posed:{{}}{size}", options.rendered)
    change, drift = perturbation(options.perturb), drift_of(options.drift)
    if not real and not rendered:
        bad_value("--data", "given, or --rendered above 0", "neither")
    parts = []
    if real:
        title = f"AbsRel of {count_of_pairs(len(real), 'real ')}, two views"
        note = "'estimated' has the poses withheld but for the length of the first baseline."
        parts.append(_Part(title, note, [("", real, POSES)], residuals=True))
        samples = {ref.label: load(ref) for ref in real}
        several = [ref for ref in real if samples[ref.label].extra_views]
        if several:
            title = f"AbsRel of {count_of_pairs(len(several), 'real ')}, three views"
            parts.append(_Part(title, "", [("", several, POSES)], views=3))
    if rendered:
        wrong = [perturbed_ref(ref, change) for ref in rendered]
        title = f"AbsRel of {count_of_pairs(len(rendered), 'rendered ')}, poses perturbed"
        degrees, share = change
        note = f"Turned by up to {degrees:g} degrees and shifted by up to {100 * share:g} % of the baseline."
        columns = [
            ("true, ", rendered, ("given",)),
            ("perturbed, ", wrong, ("given", "refine")),
            ("", rendered, ("estimated",)),
        ]
        parts.append(_Part(title, note, columns))
    rectified = [ref for ref in real if samples[ref.label].rectified] if real and any(drift) else []
    if rectified:
        wrong = [drifted_ref(ref, drift) for ref in rectified]
        title = f"AbsRel of {count_of_pairs(len(rectified), 'rectified ')}, the rig drifted"
        turn = f"The right camera has turned by {drift[0]:g} degrees"
        note = f"{turn} and its image has moved by {drift[1]:g} px up or down."
        columns = [("true, ", rectified, ("given",)), ("drifted, ", wrong, ("given", "refine"))]
        parts.append(_Part(title, note, columns))
    return parts


def _size(text: str | None) -> str:
    """``@WIDTHxHEIGHT`` of a size as typed, or nothing."""
    if text is None:
        return ""
    match = re.fullmatch(r"\s*(\d{1,5})\s*x\s*(\d{1,5})\s*", text)
    if match is None or min(map(int, match.groups())) < SMALLEST_PX:
        expected = f"WIDTHxHEIGHT in pixels, each at least {SMALLEST_PX}"
        bad_value("--rendered-size", expected, repr(text), "256x192 has a quarter of the usual pixels.")
    return "@{}x{}".format(*match.groups())


def run_poses(name: str, options: PosesOptions) -> Page | None:
    """Measure, and write the tables.

    Raises:
        InputError: neither real nor rendered pairs; a folder without pairs.
        OSError: missing or unreadable files.
    """
    parts, settings = _parts(options), options.settings

    def cells(part: _Part) -> Iterator[tuple[str, list[Item]]]:
        chosen = replace(settings, views=part.views)
        for before, refs, poses in part.columns:
            for pose, method in zip(poses, with_poses(("guided",), poses), strict=True):
                yield before + _HEADINGS[pose], method_cells(refs, (method,), chosen, options.out)

    planned = [(part, list(cells(part))) for part in parts]

    def tables(records: list[Record]) -> list[Table]:
        shown, left = [], iter(records)
        for part, columns in planned:
            filled = [(heading, [next(left) for _ in of_column]) for heading, of_column in columns]
            shown.append(poses_table(part.title, filled, part.note))
            if part.residuals:
                shown.append(_residual_table([column for column in filled if column[0] == "refined"]))
        return shown

    remark = f"Prior {settings.prior}, seed {settings.seed}. All pixels with truth, metres as they come out."
    purpose = "How accurate depth is if poses are exact, perturbed, refined or withheld."
    every = [item for _, columns in planned for _, of_column in columns for item in of_column]
    experiment = Experiment(
        name, "Results by pose", every, tables, lambda _: (remark,), purpose, RECORDS_NAME
    )
    return experiment.run(options, command_line(name, options))
