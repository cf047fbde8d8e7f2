"""Ablations of a preset, one change at a time, and the flatness of its optimum.

Paper: S5.3, which it extends.
"""

from __future__ import annotations

from collections.abc import Sequence

from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.config import DEFAULT, value_of
from geodiff_plugin.evaluation.experiment import Page
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, select
from geodiff_plugin.evaluation.pairs import pairs_experiment
from geodiff_plugin.evaluation.tables import (
    Table,
    by_method,
    cell,
    count_of_pairs,
    label_of,
    mean_with_interval,
    metric_values,
    paired_difference,
    regions_table,
    seconds_of,
    summary_table,
)
from geodiff_plugin.runner import Record

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
        *((f"rule {name}", f"paper:rule={name}") for name in RULES if name != "summed"),
    ),
    "parts": (
        ("as it is", "guided"),
        ("search only", "search-only"),
        ("photometric only", "guided:weights.matches=0"),
        ("matches only", "guided:weights.photometric=0"),
        ("no diffusion", "no-diffusion"),
        ("without correction in the loop", "guided:correct=false"),
        ("with a correction in every step", "guided:corrections=1000"),
        ("with gradient updates", "guided:inner_steps=5"),
        ("without the last fit and crisp edges", "guided:crisp=false"),
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
    *("weights.photometric", "weights.matches", "weights.anchor", "sweep_pixels"),
)
"""The numbers that decide the default's result, by knob."""


def changes_table(records: Sequence[Record], name: str) -> Table:
    """Every row of ``CHANGES[name]`` that ran, with its paired difference to the unchanged preset."""
    abs_rel, delta1 = (metric_values(records, "raw", metric) for metric in ("abs_rel", "delta1"))
    seconds, unchanged, rows = by_method(records, seconds_of), CHANGES[name][0][1], []
    for title, method in CHANGES[name]:
        own = abs_rel.get(method)
        if not own:
            continue
        difference = paired_difference(own, abs_rel.get(unchanged, {})).cell(sign="+")
        cells = [mean_with_interval(list(own.values())).cell(), cell(max(own.values()))]
        cells.append(mean_with_interval(list(delta1[method].values())).cell())
        cells.append("-" if method == unchanged else difference)
        cells.append(cell(mean_with_interval(list(seconds[method].values())).value, 1))
        rows.append((title, str(len(own)), *cells))
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


def flatness_table(records: Sequence[Record]) -> Table:
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
    header = ("number", "value", "at half", "at twice", "largest change of a pair")
    return Table(title, header, tuple(rows), f"Mean AbsRel; {cell(mean, 4)} as they are.")


def run_changes(name: str, options: PairsOptions) -> Page | None:
    """Change one thing of the default at a time: its ``parts``, or the numbers of ``flatness``.

    ``options.methods`` are run beside the table's own; errors as ``Experiment.run``.
    """
    flat, refs = name == "flatness", select(all_refs(options), options)
    rows = flatness_methods() if flat else tuple(method for _, method in CHANGES[name])

    def tables(records: list[Record]) -> list[Table]:
        added = [record for record in records if record["method"] not in rows]
        labels = {label_of(record) for record in added}
        return [
            flatness_table(records) if flat else changes_table(records, name),
            summary_table(added, labels, f"Further methods and priors, {count_of_pairs(len(labels))}"),
            *([] if flat else [regions_table(records)]),
        ]

    title = "Flatness" if flat else "Parts of the default"
    experiment = pairs_experiment(name, title, refs, (*rows, *options.methods), options, tables)
    return experiment.run(name, options)
