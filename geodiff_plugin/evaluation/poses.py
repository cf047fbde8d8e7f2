"""What inexact poses cost, and what refined and estimated ones are worth: ``geodiff eval poses``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import with_poses
from geodiff_plugin.evaluation.datasets import SampleRef, load
from geodiff_plugin.evaluation.datasets.changed import changed_ref, drift_of, perturbation
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, Experiment, Page, method_cells
from geodiff_plugin.evaluation.options import POSES, PosesOptions, real_and_rendered
from geodiff_plugin.evaluation.tables import (
    Table,
    cell,
    count_of_pairs,
    groups_of,
    headline,
    label_of,
    mean_with_interval,
)
from geodiff_plugin.runner import Item, Record

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

    A row a pair, then the means of all, of rectified and of posed pairs (of those with a result), then how
    many have none, and how many are off by more than ``BY_A_FACTOR`` without a warning.
    """
    first = columns[0][1]
    values = [[headline(record) for record in records] for _, records in columns]
    rows = [(label_of(record), *(cell(each[i]) for each in values)) for i, record in enumerate(first)]
    for group, labels in groups_of(first).items():
        members = [i for i, record in enumerate(first) if label_of(record) in labels]
        rows.append((f"mean of {group}", *(_mean([each[i] for i in members]) for each in values)))
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


#: Title, note, number of views, and columns: heading before the pose's, references, poses.
Part = tuple[str, str, int, Sequence[tuple[str, Sequence[SampleRef], Sequence[str]]]]


def _real_parts(real: Sequence[SampleRef], drift: tuple[float, float]) -> list[Part]:
    """Two views, three where there are some, and a drifted rig where there are rectified pairs."""
    pairs, samples = count_of_pairs(len(real), "real "), {ref.label: load(ref) for ref in real}
    note = "'estimated' has the poses withheld but for the length of the first baseline."
    parts: list[Part] = [(f"AbsRel of {pairs}, two views", note, 2, [("", real, POSES)])]
    several = [ref for ref in real if samples[ref.label].extra_views]
    if several:
        title = f"AbsRel of {count_of_pairs(len(several), 'real ')}, three views"
        parts.append((title, "", 3, [("", several, POSES)]))
    rectified = [ref for ref in real if samples[ref.label].rectified] if any(drift) else []
    if rectified:
        wrong = [changed_ref(ref, "drifted", drift) for ref in rectified]
        title = f"AbsRel of {count_of_pairs(len(rectified), 'rectified ')}, the rig drifted"
        turn = f"The right camera has turned by {drift[0]:g} degrees"
        note = f"{turn} and its image has moved by {drift[1]:g} px up or down."
        columns = [("true, ", rectified, ("given",)), ("drifted, ", wrong, ("given", "refine"))]
        parts.append((title, note, 2, columns))
    return parts


def _rendered_part(rendered: Sequence[SampleRef], change: tuple[float, float]) -> Part:
    wrong = [changed_ref(ref, "perturbed", change) for ref in rendered]
    title = f"AbsRel of {count_of_pairs(len(rendered), 'rendered ')}, poses perturbed"
    note = (
        f"Turned by up to {change[0]:g} degrees and shifted by up to {100 * change[1]:g} % of the baseline."
    )
    as_told = ("perturbed, ", wrong, ("given", "refine"))
    return title, note, 2, [("true, ", rendered, ("given",)), as_told, ("", rendered, ("estimated",))]


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
    change, drift, settings = perturbation(options.perturb), drift_of(options.drift), options.settings
    real, rendered = real_and_rendered(options, f"synthetic-posed:{{}}{_size(options.rendered_size)}")
    parts = _real_parts(real, drift) if real else []
    parts += [_rendered_part(rendered, change)] if rendered else []
    planned: list[list[tuple[str, list[Item]]]] = []
    for _, _, views, columns in parts:
        chosen = replace(settings, views=views)
        planned.append(
            [
                (before + _HEADINGS[pose], method_cells(refs, (method,), chosen, options.out))
                for before, refs, poses in columns
                for pose, method in zip(poses, with_poses(("guided",), poses), strict=True)
            ]
        )

    def tables(records: list[Record]) -> list[Table]:
        shown, left = [], iter(records)
        for (title, note, _, _), columns in zip(parts, planned, strict=True):
            filled = [(heading, [next(left) for _ in items]) for heading, items in columns]
            shown.append(poses_table(title, filled, note))
            if real and len(shown) == 1:
                shown.append(_residual_table([column for column in filled if column[0] == "refined"]))
        return shown

    return Experiment(
        name,
        "Results by pose",
        [item for columns in planned for _, items in columns for item in items],
        tables,
        lambda _: [
            f"Prior {settings.prior}, seed {settings.seed}. All pixels with truth, metres as they come out."
        ],
        "How accurate depth is if poses are exact, perturbed, refined or withheld.",
        RECORDS_NAME,
    ).run(name, options)
