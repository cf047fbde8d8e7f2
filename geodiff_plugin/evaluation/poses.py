"""What inexact poses cost, what refining them gains, what estimated ones are worth: ``geodiff eval poses``.

Data flow: real and rendered pairs, poses given, perturbed, withheld, rigs drifted -> records -> one page.
Paper: none; it takes exact poses for granted (S3.3).
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import POSES, Settings, with_poses
from geodiff_plugin.evaluation.cells import cell, count_of_pairs, label_of
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.perturbed import drifted_ref, perturbed_ref
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.options import first_pairs, settings_words
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.runner import headline, run
from geodiff_plugin.evaluation.statistics import mean_with_interval
from geodiff_plugin.formats.out import OutFolder

__all__ = ["Column", "PosesOptions", "poses_table", "run_poses"]

#: First line of the page.
PURPOSE = "How accurate depth is if poses are exact, perturbed, refined or withheld."

#: An error above this is of the kind that a wrong scale makes, and must be said.
BY_A_FACTOR = 0.25
_HEADINGS = {"given": "given", "refine": "refined", "estimated": "estimated"}


@dataclass(frozen=True)
class PosesOptions:
    """Options of ``geodiff eval poses``.

    Attributes:
        data: folder of real pairs, or ``None``.
        rendered: so many rendered pairs in a general pose.
        perturb: largest turn in degrees and shift as a share of the baseline that poses are given wrong by.
        drift: turn in degrees and shift of the image in pixels of the right camera of a rectified rig; 0 and
            0 for none of it.
        limit: at most so many real pairs.
        settings: prior, device, seed.
        out: folder of records and tables; resumed.
        results: Markdown page to write beside; ``None`` for none.
        quiet: no bar.
        rendered_size: width and height of the rendered pairs, pixels; ``None`` for the data set's own.
    """

    data: Path | None
    rendered: int
    perturb: tuple[float, float]
    drift: tuple[float, float]
    limit: int | None
    settings: Settings
    out: Path
    results: Path | None
    quiet: bool
    rendered_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Column:
    """One way to give the poses of the same pairs.

    Attributes:
        heading: of the column.
        records: one a pair, in the order of the pairs.
    """

    heading: str
    records: Sequence[dict[str, Any]]


def _residual(record: dict[str, Any], name: str) -> str:
    values = record.get("notes", {}).get("method", {}).get(name) or []
    return " / ".join(f"{px:.2f}" for px in values) or "-"


def _unwarned(column: Column) -> int:
    """Pairs of a column that are off by more than ``BY_A_FACTOR`` without a warning."""
    return sum(
        1
        for record in column.records
        if (value := headline(record)) is not None
        and value > BY_A_FACTOR
        and not record["notes"]["method"].get("warnings")
    )


def _mean(values: Sequence[float | None]) -> str:
    """The mean of those that have a result, with their number where some have none."""
    found = [value for value in values if value is not None]
    mean = cell(mean_with_interval(found).value) if found else "-"
    return mean if len(found) in (0, len(values)) else f"{mean} of {len(found)}"


def poses_table(title: str, columns: Sequence[Column], note: str) -> Table:
    """AbsRel of the same pairs with their poses given in several ways, and what was said.

    Args:
        title: heading.
        columns: of as many records each; the first one names the pairs, the last but one and the last have
            the residuals that are shown.
        note: below the heading.

    Returns:
        A row a pair, then the means of all, of rectified and of posed pairs (of those with a result), then
        how many have none, and how many are off by more than ``BY_A_FACTOR`` without a warning.
    """
    first = columns[0].records
    rows = [
        (label_of(record), *(cell(headline(column.records[i])) for column in columns))
        for i, record in enumerate(first)
    ]
    groups: dict[str, Callable[[dict[str, Any]], bool]] = {"": lambda record: True}
    if len({record.get("rectified") for record in first}) > 1:
        groups |= {
            "rectified ": lambda r: bool(r.get("rectified")),
            "posed ": lambda r: not r.get("rectified"),
        }
    for kind, belongs in groups.items():
        own = [i for i, record in enumerate(first) if belongs(record)]
        values = [[headline(column.records[i]) for i in own] for column in columns]
        rows.append((f"mean of {count_of_pairs(len(own), kind)}", *(_mean(each) for each in values)))
    missing = [sum(headline(record) is None for record in column.records) for column in columns]
    rows.append(("without a result", *(str(count) for count in missing)))
    off = f"off by more than {BY_A_FACTOR:g}, no warning"
    rows.append((off, *(str(_unwarned(column)) for column in columns)))
    return Table(title, ("pair", *(column.heading for column in columns)), tuple(rows), note)


def _residual_table(columns: Sequence[Column]) -> Table:
    """Residuals of the matches as given and as used, a row a pair."""
    rows = [
        (
            label_of(record),
            *(
                _residual(column.records[i], key)
                for column in columns
                for key in ("residual_px_given", "residual_px")
            ),
        )
        for i, record in enumerate(columns[0].records)
    ]
    header = [f"{column.heading}, {what}" for column in columns for what in ("as given", "as used")]
    note = "Median distance of the matches from their epipolar lines, pixels; one number a right view."
    return Table("Residuals", ("pair", *header), tuple(rows), note)


class _Bench:
    """Runs methods on pairs, each record once for all tables."""

    def __init__(self, options: PosesOptions) -> None:
        self.options = options

    def columns(
        self, refs: Sequence[SampleRef], poses: Sequence[str], kind: str = "", views: int = 2
    ) -> list[Column]:
        """A column for each of the named ways to give poses; ``kind`` is said before their names."""
        options, methods = self.options, with_poses(("guided",), poses)
        settings = replace(options.settings, views=views)
        records = run(refs, methods, settings, options.out, progress=not options.quiet)
        return [
            Column(f"{kind}{_HEADINGS[pose]}", [r for r in records if r["method"] == method])
            for pose, method in zip(poses, methods, strict=True)
        ]


def _real(bench: _Bench, refs: Sequence[SampleRef]) -> list[Table]:
    columns = bench.columns(refs, POSES)
    tables = [
        poses_table(
            f"AbsRel of {count_of_pairs(len(refs), 'real ')}, two views",
            columns,
            "'estimated' has the poses withheld but for the length of the first baseline.",
        ),
        _residual_table([column for column in columns if column.heading == "refined"]),
    ]
    several = [ref for ref in refs if load(ref).extra_views]
    if several:
        three = bench.columns(several, POSES, views=3)
        title = f"AbsRel of {count_of_pairs(len(several), 'real ')}, three views"
        tables.insert(1, poses_table(title, three, ""))
    return tables


def _rendered(bench: _Bench, refs: Sequence[SampleRef]) -> list[Table]:
    options = bench.options
    wrong = [perturbed_ref(ref, options.perturb) for ref in refs]
    columns = [
        *bench.columns(refs, ("given",), "true, "),
        *bench.columns(wrong, ("given", "refine"), "perturbed, "),
        *bench.columns(refs, ("estimated",)),
    ]
    degrees, share = options.perturb
    title = f"AbsRel of {count_of_pairs(len(refs), 'rendered ')}, poses perturbed"
    note = f"Turned by up to {degrees:g} degrees and shifted by up to {100 * share:g} % of the baseline."
    return [poses_table(title, columns, note)]


def _drifted(bench: _Bench, refs: Sequence[SampleRef]) -> list[Table]:
    options = bench.options
    wrong = [drifted_ref(ref, options.drift) for ref in refs]
    columns = [
        *bench.columns(refs, ("given",), "true, "),
        *bench.columns(wrong, ("given", "refine"), "drifted, "),
    ]
    degrees, px = options.drift
    title = f"AbsRel of {count_of_pairs(len(refs), 'rectified ')}, the rig drifted"
    note = (
        f"The right camera has turned by {degrees:g} degrees and its image has moved by {px:g} px up or down."
    )
    return [poses_table(title, columns, note)]


def run_poses(options: PosesOptions) -> Page:
    """Measure, and write the tables.

    Raises:
        InputError: neither real nor rendered pairs; a folder without pairs; a limit below 1.
        OSError: missing or unreadable files.
    """
    real = first_pairs(options.data, options.limit)
    size = "" if options.rendered_size is None else "{}x{}".format(*options.rendered_size)
    asked = f"synthetic-posed:{options.rendered}" + (f"@{size}" if size else "")
    rendered = find_pairs(asked) if options.rendered else []
    if not real and not rendered:
        bad_value("--data", "given, or --rendered above 0", "neither")
    rectified = [ref for ref in real if load(ref).rectified] if any(options.drift) else []
    with OutFolder(options.out, resume=True):
        bench, tables = _Bench(options), []
        for part, refs in ((_real, real), (_rendered, rendered), (_drifted, rectified)):
            tables += part(bench, refs) if refs else []
    words = ["geodiff", "eval", "poses", "--rendered", str(options.rendered)]
    words += ["--rendered-size", size] if size else []
    words += [] if options.data is None else ["--data", options.data.name]
    words += [] if options.limit is None else ["--limit", str(options.limit)]
    words += ["--perturb", "{:g},{:g}".format(*options.perturb)]
    words += ["--drift", "{:g},{:g}".format(*options.drift), *settings_words(options.settings)]
    settings = options.settings
    remark = f"Prior {settings.prior}, seed {settings.seed}. All pixels with truth, metres as they come out."
    page = Page("Results by pose", run_facts(shlex.join(words)), tuple(tables), (remark,), PURPOSE)
    write_page(page, options.out, "poses", options.results)
    return page
