"""Ablations of a preset, one change at a time, and the flatness of its optimum.

Paper: S5.3, which it extends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.config import DEFAULT, value_of
from geodiff_plugin.evaluation.experiment import RECORDS_NAME, Experiment
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, command_line, select
from geodiff_plugin.evaluation.pairs import pair_cells, remarks_on
from geodiff_plugin.evaluation.report import Page
from geodiff_plugin.evaluation.table import (
    Table,
    by_method,
    cell,
    count_of_pairs,
    interval_cell,
    label_of,
    mean_with_interval,
    metric_values,
    paired_difference,
)
from geodiff_plugin.evaluation.tables import regions_table, summary_table
from geodiff_plugin.runner import Record

__all__ = ["CHANGES", "NUMBERS", "changes_table", "flatness_methods", "flatness_table", "run_changes"]

CHANGES: dict[str, tuple[tuple[str, str], ...]] = {
    "guided": (
        ("as it is", "guided"),
        ("scale and shift only", "scale-shift-only"),
        ("reprojection only", "reprojection-only"),
        ("no diffusion", "no-diffusion"),
        ("gradient to z_t (full)", "guided:gradient=full"),
        *((f"rule {name}", f"guided:rule={name}") for name in RULES if name != "adam"),
        *((f"without {name}", f"guided:weights.{name}=0") for name in DEFAULT.weights if name != "points"),
    ),
    "paper": (
        ("as it is", "paper"),
        ("scale and shift only", "paper:optimize_latents=false"),
        ("γ = 0", "paper:weights.prior_pull=0"),
        # One number that is searched within a thousandth of 1 is 1.
        ("g_s = 1", "paper:g_s_range=[0.999,1.001]"),
        ("gradient to the clean latent (denoised)", "paper:gradient=denoised"),
        *((f"rule {name}", f"paper:rule={name}") for name in RULES if name != "plain"),
    ),
    "parts": (
        ("as it is", "guided"),
        ("search only", "search-only"),
        ("photometric only", "photometric-only"),
        ("matches only", "matches-only"),
        ("no diffusion", "no-diffusion"),
        ("without correction in the loop", "guided:correct=false"),
        ("with a correction in every step", "guided:corrections=1000"),
        ("with gradient updates", "guided:inner_steps=5"),
        ("without refinement of the result", "guided:refine=false"),
        ("without sharpening of depth edges", "guided:sharpen=false"),
        ("without votes at depth edges", "guided:crisp=false"),
        ("without rejection of reflections", "guided:reject_reflections=false"),
        ("without cleaning of photographs", "guided:clean_photographs=false"),
        ("without exposure", "guided:exposure=false"),
        ("without z-test", "guided:z_test=false"),
    ),
}
"""What is changed, by table: ``(row, method)``, the unchanged preset first.

``guided`` and ``paper`` stand below the paper's Table 4, every rule and every term with its row (no sample
has known points, so their term has none); ``parts`` is what the default has beyond the paper.
"""

_NAMES = {"guided": "The default preset", "paper": "Algorithm 1 as printed", "parts": "The default's parts"}

NUMBERS = (
    *("min_steps", "corrections", "outlier_width", "match_noise", "smoothness"),
    *("weights.photometric", "weights.matches", "weights.anchor", "loss_resolution"),
)
"""The numbers that decide the default's result, by knob."""


def changes_table(records: Sequence[dict[str, Any]], name: str) -> Table:
    """Every row of ``CHANGES[name]`` that ran, with its paired difference to the unchanged preset.

    Args:
        records: of the run.
        name: key of ``CHANGES``.
    """
    abs_rel, delta1 = metric_values(records, "raw", "abs_rel"), metric_values(records, "raw", "delta1")
    seconds = by_method(records, lambda record: record["seconds"])
    unchanged = CHANGES[name][0][1]
    reference, rows = abs_rel.get(unchanged, {}), []
    for title, method in CHANGES[name]:
        own = abs_rel.get(method)
        if not own:
            continue
        difference = (
            "-" if method == unchanged else interval_cell(paired_difference(own, reference), signed=True)
        )
        rows.append(
            (
                title,
                str(len(own)),
                interval_cell(mean_with_interval(list(own.values()))),
                cell(max(own.values())),
                interval_cell(mean_with_interval(list(delta1[method].values()))),
                difference,
                cell(mean_with_interval(list(seconds[method].values())).value, 1),
            )
        )
    count = count_of_pairs(len({label_of(record) for record in records}))
    header = ("change", "pairs", "AbsRel ↓ [95 %]", "worst", "δ1 ↑ [95 %]", "AbsRel more", "seconds")
    note = "Metres as they come out; each change alone, and what the knobs leave open follows it."
    return Table(f"{_NAMES[name]}, one thing changed, {count}", header, tuple(rows), note)


def _at(number: str, factor: float) -> str:
    """The method with a number of the default at a multiple of itself; integers stay integers."""
    value = value_of(number, DEFAULT)
    changed = max(1, round(value * factor)) if isinstance(value, int) else float(f"{value * factor:.6g}")
    return f"guided:{number}={changed:g}"


def flatness_methods() -> tuple[str, ...]:
    """The default, and every one of ``NUMBERS`` at half and at twice its value."""
    return ("guided", *(_at(number, factor) for number in NUMBERS for factor in (0.5, 2.0)))


def flatness_table(records: Sequence[dict[str, Any]]) -> Table:
    """Mean AbsRel with every number at half and at twice its value, and the pair that it changes most."""
    values = metric_values(records, "raw", "abs_rel")
    unchanged, rows = values.get("guided", {}), []
    for number in NUMBERS:
        cells, most = [], (0.0, "-")
        for factor in (0.5, 2.0):
            own = values.get(_at(number, factor), {})
            shared = [label for label in own if label in unchanged]
            cells.append(cell(mean_with_interval([own[x] for x in shared]).value if shared else None, 4))
            most = max([most, *((abs(own[x] - unchanged[x]), x) for x in shared)])
        moved = f"{cell(most[0])} ({most[1]})" if most[0] else cell(0.0)
        rows.append((f"`{number}`", f"{value_of(number, DEFAULT):g}", *cells, moved))
    mean = mean_with_interval(list(unchanged.values())).value
    title = f"Every number of the default at half and at twice its value, {count_of_pairs(len(unchanged))}"
    note = f"Mean AbsRel; {cell(mean, 4)} as they are."
    return Table(
        title, ("number", "value", "at half", "at twice", "largest change of a pair"), tuple(rows), note
    )


def run_changes(name: str, options: PairsOptions) -> Page | None:
    """Change one thing of the default at a time: its parts, or its numbers.

    Args:
        name: ``"parts"`` or ``"flatness"``.
        options: as of ``geodiff eval pairs``; ``methods`` are run beside the table's own.

    Raises:
        ValueError, OSError: as ``Experiment.run``.
    """
    refs = select(all_refs(options), options)
    rows = flatness_methods() if name == "flatness" else tuple(method for _, method in CHANGES[name])

    def tables(records: list[Record]) -> list[Table]:
        whole = [flatness_table(records)] if name == "flatness" else [changes_table(records, name)]
        added = [record for record in records if record["method"] not in rows]
        if added:
            labels = {label_of(record) for record in added}
            whole.append(
                summary_table(added, labels, f"Further methods and priors, {count_of_pairs(len(labels))}")
            )
        return whole if name == "flatness" else [*whole, regions_table(records)]

    title = "Flatness" if name == "flatness" else "Parts of the default"
    cells = pair_cells(refs, tuple(dict.fromkeys((*rows, *options.methods))), options)
    experiment = Experiment(
        name, title, cells, tables, lambda records: remarks_on(records, options), journal=RECORDS_NAME
    )
    return experiment.run(options, command_line(name, options))
