"""Guidance of priors from exact to weak: ``geodiff eval strength``."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.edges import edge_error, surface_error
from geodiff_plugin.evaluation.emulated import DENSE, STRENGTHS, EmulatedPrior, EmulatedPriors
from geodiff_plugin.evaluation.experiment import Experiment, cell_key, last_of
from geodiff_plugin.evaluation.figures.curves import draw_strength, shaded
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.evaluation.options import StrengthOptions, command_line, data_of
from geodiff_plugin.evaluation.report import Page
from geodiff_plugin.evaluation.table import Table, count_of_pairs
from geodiff_plugin.runner import Item, Record

__all__ = ["run_strength", "strength_tables"]

#: First paragraph of the page.
PURPOSE = (
    "What guidance gains with better priors. An emulated prior answers with the true depth plus a known "
    "error. *2%* to *20%* is the mean absolute error of its log depth, half of it smooth and half constant "
    "over segments of the image; *blur* is 1 % and a blurred map; *gamma* is a map raised to the power 1.6, "
    "which no scale and shift makes up for. Its later answers are in part what its noisy input says "
    "(*following by 0.3*: 30 %), so it sees corrections as a network does. *Surfaces* is the error of the "
    "slope of log depth away from edges: the lower, the smoother."
)

#: The plain call whose scale and shift the truth decides.
ORACLE = "prior-aligned"
#: Strength whose surfaces the figure shows.
SHOWN = "5%"
#: Field of a record -> heading of its column.
_VALUES = {"abs_rel": "AbsRel", "delta1": "δ1", "edges": "at edges", "surfaces": "surfaces"}


def strength_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """One table a group of pairs (all, rendered rectified, rendered posed, real), strengths by methods.

    Args:
        records: of ``run_strength``.
    """
    groups: dict[str, Callable[[Record], bool]] = {
        "All pairs": lambda r: True,
        "Rendered, rectified": lambda r: r["rendered"] and r["rectified"],
        "Rendered, any pose": lambda r: r["rendered"] and not r["rectified"],
        "Real": lambda r: not r["rendered"],
    }
    tables = []
    for title, belongs in groups.items():
        own = [record for record in records if belongs(record)]
        if own:
            tables.append(_table(title, own))
    return tuple(tables)


def _table(title: str, records: Sequence[Record]) -> Table:
    strengths = list(dict.fromkeys(record["strength"] for record in records))
    methods = list(dict.fromkeys(record["method"] for record in records))
    rows: list[tuple[str, ...]] = []
    rules: list[int] = []
    for strength in strengths:
        rules.append(len(rows))
        for method in methods:
            own = [r for r in records if r["strength"] == strength and r["method"] == method]
            if not own:
                continue
            means = {name: _mean([r[name] for r in own]) for name in _VALUES}
            worst = max(r["abs_rel"] for r in own)
            shown = [f"{means[n]:.2f}" if n == "surfaces" else f"{means[n]:.4f}" for n in _VALUES]
            rows.append((strength, find_method(method).title, *shown, f"{worst:.3f}"))
    # Not by label: pairs of one name in two folders are two.
    pairs = count_of_pairs(max(Counter((r["strength"], r["method"]) for r in records).values()))
    note = (
        f"{pairs}. AbsRel and δ1 in metres, without alignment but for the prior with oracle; AbsRel within "
        f"3 px of the truth's edges; error of the slope of log depth away from them, per mille a pixel."
    )
    header = ("prior's error", "method", *_VALUES.values(), "worst AbsRel")
    return Table(title, header, tuple(rows), note, rules=tuple(rules[1:]))


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else float("nan")


def run_strength(name: str, options: StrengthOptions) -> Page | None:
    """Measure every method at every strength, and write the page.

    Raises:
        InputError: bad options, or no sample with dense truth.
        OSError: missing or unreadable files.
    """
    _check_methods(options)
    refs = [ref for root in options.data or (data_of(options),) for ref in find_pairs(root)[: options.limit]]
    bench = _Bench(options)
    cells = [cell for ref in refs for cell in bench.cells(ref)]

    def dense(records: Sequence[Record]) -> list[Record]:
        kept = [record for record in records if record.get("status") != "sparse"]
        if not kept:
            bad_value("--data", f"with dense truth (on {DENSE:.0%} of the pixels) for some pair", "none")
        return kept

    def remarks(records: list[Record]) -> list[str]:
        sentences = [
            f"Emulated priors, affine in {options.space}, following their input by {options.follow:g}; "
            f"processed at {options.resolution} px, {options.steps} steps, seed {options.seed}."
        ]
        if options.figure is not None:
            labels = {record["pair"] for record in dense(records)}
            sample = load(next(ref for ref in refs if ref.label in labels))
            draw_strength(dense(records), ORACLE, bench.pictures(sample), options.figure)
            if options.results is not None:
                picture = Path(os.path.relpath(options.figure, options.results.parent)).as_posix()
                sentences.append(f"![What guidance gains by the prior's error; surfaces, lit]({picture})")
        return sentences

    title = "Priors from exact to weak"
    experiment = Experiment(
        name, title, cells, lambda records: strength_tables(dense(records)), remarks, PURPOSE
    )
    return experiment.run(options, command_line(name, options))


def _check_methods(options: StrengthOptions) -> None:
    for name in options.methods:
        method = find_method(name)
        if not method.uses_prior or method.prior is not None:
            bad_value("--methods", "methods that use a prior, none named after an @", repr(name))
    if options.figure is not None and ORACLE not in options.methods:
        got = repr(",".join(options.methods))
        bad_value("--methods", f"with {ORACLE}, the abscissa of the figure", got)


class _Bench:
    """One emulated prior, which answers for one sample and strength after the other."""

    def __init__(self, options: StrengthOptions) -> None:
        self._options, self._read = options, last_of(load)
        self._settings = Settings(steps=options.steps, resolution=options.resolution, seed=options.seed)
        self._prior = EmulatedPrior(options.space, options.follow)
        self._cache: PriorCache = EmulatedPriors(self._prior)

    def cells(self, ref: SampleRef) -> list[Item]:
        """A cell for every strength and method."""
        options, cells = self._options, []
        for strength in options.strengths:
            for name in options.methods:
                method = find_method(name)
                configuration = method.configuration(method.own_settings(self._settings))
                prior = f"emulated {options.space} {options.follow} {strength} {options.seed}"
                head = {"pair": ref.label, "strength": strength, "method": name}
                work = partial(self._measure, ref, strength, name)
                key = cell_key(ref, name, configuration, prior)
                cells.append(Item(key, work, name=f"{ref.label}, {strength}, {name}", head=head))
        return cells

    def _measure(self, ref: SampleRef, strength: str, name: str) -> Record:
        sample = self._read(ref)
        if sample.valid.mean() < DENSE:
            return {"status": "sparse"}
        depth_m, truth = self.depth_m(sample, strength, name), (sample.depth_m, sample.valid)
        scores = evaluate_depth(depth_m, *truth)
        return {
            "rectified": bool(sample.rectified),
            "rendered": sample.dataset == "synthetic",
            "abs_rel": scores["abs_rel"],
            "delta1": scores["delta1"],
            "edges": edge_error(depth_m, *truth),
            "surfaces": surface_error(depth_m, *truth),
        }

    def depth_m(self, sample: StereoSample, strength: str, name: str) -> np.ndarray:
        """``(H, W)`` metres of a method with a prior of some strength, aligned where it is relative."""
        self._prior.answer(sample, STRENGTHS[strength], self._options.resolution, self._options.seed)
        method = find_method(name)
        try:
            prediction = method.run(sample, method.own_settings(self._settings), self._cache)
        except NotApplicable as reason:
            got = f"{name}, not on {sample.label}: {reason}"
            bad_value("--methods", "methods that work on every pair", got)
        if prediction.depth_m is not None:
            return prediction.depth_m
        assert prediction.relative is not None
        return align(prediction.relative, sample.depth_m, sample.valid, prediction.space)

    def pictures(self, sample: StereoSample) -> dict[str, np.ndarray]:
        """The middle of one pair, lit, at the strength of the figure: truth, prior, fitted once, guided."""
        strengths = self._options.strengths
        strength = SHOWN if SHOWN in strengths else strengths[0]
        height, width = sample.depth_m.shape
        window = np.s_[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
        maps = {"truth": sample.depth_m}
        for name in (ORACLE, "prior-fit", "guided"):
            maps[f"{find_method(name).title}, {strength}"] = self.depth_m(sample, strength, name)
        return {title: shaded(depth_m[window], float(sample.K_left[0, 0])) for title, depth_m in maps.items()}
