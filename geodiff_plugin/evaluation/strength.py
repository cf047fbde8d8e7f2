"""Guidance of priors from exact to weak: ``geodiff eval strength``.

Data flow: dense pairs + ``STRENGTHS`` -> emulated prior -> plain, fitted and guided -> tables.
Paper: none; S5 measures one prior.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value, check_choice, check_number
from geodiff_plugin.evaluation.alignment import align
from geodiff_plugin.evaluation.baselines import NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.edges import edge_error, surface_error
from geodiff_plugin.evaluation.emulated import DENSE, SPACES, STRENGTHS, EmulatedPrior, EmulatedPriors
from geodiff_plugin.evaluation.figures.strength import draw_strength, shaded
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.records import append_record, clean_records, read_records, record_key
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.strength_tables import strength_tables

__all__ = ["METHODS", "StrengthOptions", "run_strength"]

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
METHODS = (ORACLE, "prior-fit", "guided", "search-only", "guided:inner_steps=5")
#: Strength whose surfaces the figure shows.
SHOWN = "5%"


@dataclass(frozen=True)
class StrengthOptions:
    """What to measure.

    Attributes:
        data: folders of data sets, or ``synthetic:N``; samples without dense truth are left out.
        command: as typed, for the page.
        strengths: keys of ``STRENGTHS``.
        space: what the emulated prior is affine in.
        follow: how far its later answers follow their input, [0, 1].
        methods: of ``METHODS``, or any method that uses a prior.
        steps: denoising steps of the plain call.
        resolution: ``processing_resolution`` of every call.
        seed: of noise and of the prior's error.
        limit: samples of each folder at most.
        out: folder of the records; a run goes on where it was stopped.
        results: where the Markdown page is written as well.
        figure: where the figure is drawn.
        quiet: no progress bar.
    """

    data: tuple[Path, ...]
    command: str
    strengths: tuple[str, ...] = tuple(STRENGTHS)
    space: str = "disparity"
    follow: float = 0.3
    methods: tuple[str, ...] = METHODS
    steps: int = 4
    resolution: int = 384
    seed: int = 0
    limit: int | None = None
    out: Path = Path("geodiff-eval")
    results: Path | None = None
    figure: Path | None = None
    quiet: bool = False

    def __post_init__(self) -> None:
        for strength in self.strengths:
            check_choice(strength, "strengths", STRENGTHS)
        check_choice(self.space, "space", SPACES)
        check_number(self.follow, "follow", 0.0, 1.0)
        for name in self.methods:
            method = find_method(name)
            if not method.uses_prior or method.prior is not None:
                bad_value("methods", "methods that use a prior, none named after an @", repr(name))
        if self.figure is not None and ORACLE not in self.methods:
            bad_value("methods", f"with {ORACLE}, the abscissa of the figure", repr(",".join(self.methods)))


def run_strength(options: StrengthOptions) -> Page:
    """Measure every method at every strength, and write the page.

    Raises:
        InputError: bad options, or no sample with dense truth.
        OSError: missing or unreadable files.
    """
    refs = [ref for root in options.data for ref in find_pairs(root)[: options.limit]]
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "strength.jsonl"
    clean_records(path)
    found = {record["key"]: record for record in read_records(path)}
    prior = EmulatedPrior(options.space, options.follow)
    cache, records = EmulatedPriors(prior), []
    for ref in tqdm(refs, disable=options.quiet, desc="pairs"):
        keys = {(s, m): _key(ref, s, m, options) for s in options.strengths for m in options.methods}
        if not all(key in found for key in keys.values()):
            sample = load(ref)
            if sample.valid.mean() < DENSE:
                continue
            for record in _measure(sample, prior, cache, keys, found, options):
                found[record["key"]] = record
                append_record(path, record)
        records += [found[key] for key in keys.values() if key in found]
    if not records:
        bad_value("data", f"with dense truth (on {DENSE:.0%} of the pixels) for some pair", "none")
    remarks = (
        f"Emulated priors, affine in {options.space}, following their input by {options.follow:g}; processed "
        f"at {options.resolution} px, {options.steps} steps, seed {options.seed}.",
    )
    if options.figure is not None and options.results is not None:
        picture = Path(os.path.relpath(options.figure, options.results.parent)).as_posix()
        remarks += (f"![What guidance gains by the prior's error; surfaces, lit]({picture})",)
    tables = strength_tables(records)
    page = Page("Priors from exact to weak", run_facts(options.command), tables, remarks, PURPOSE)
    write_page(page, options.out, "strength", options.results)
    if options.figure is not None:
        labels = {record["pair"] for record in records}
        sample = load(next(ref for ref in refs if ref.label in labels))
        draw_strength(records, ORACLE, _pictures(sample, prior, cache, options), options.figure)
    return page


def _pictures(
    sample: StereoSample, prior: EmulatedPrior, cache: PriorCache, options: StrengthOptions
) -> dict[str, np.ndarray]:
    """The middle of one pair, lit, at the strength of the figure: truth, prior, fitted once, guided."""
    strength = SHOWN if SHOWN in options.strengths else options.strengths[0]
    height, width = sample.depth_m.shape
    window = np.s_[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
    maps = {"truth": sample.depth_m}
    for method in (ORACLE, "prior-fit", "guided"):
        title = f"{find_method(method).title}, {strength}"
        maps[title] = _depth(sample, prior, cache, strength, method, options)
    return {title: shaded(depth_m[window], float(sample.K_left[0, 0])) for title, depth_m in maps.items()}


def _key(ref: SampleRef, strength: str, name: str, options: StrengthOptions) -> str:
    method = find_method(name)
    configuration = method.configuration(method.own_settings(_settings(options)))
    prior = f"emulated {options.space} {options.follow} {strength} {options.seed}"
    return record_key(ref, name, configuration, prior, __version__)


def _settings(options: StrengthOptions) -> Settings:
    return Settings(steps=options.steps, resolution=options.resolution, seed=options.seed)


def _measure(
    sample: StereoSample,
    prior: EmulatedPrior,
    cache: PriorCache,
    keys: dict[tuple[str, str], str],
    found: dict[str, Any],
    options: StrengthOptions,
) -> list[dict[str, Any]]:
    """A record of every method and strength that has none yet."""
    truth, records = (sample.depth_m, sample.valid), []
    for (strength, method), key in keys.items():
        if key in found:
            continue
        depth_m = _depth(sample, prior, cache, strength, method, options)
        scores = evaluate_depth(depth_m, sample.depth_m, sample.valid, None)
        records.append(
            {
                "key": key,
                "pair": sample.label,
                "rectified": bool(sample.rectified),
                "rendered": sample.dataset == "synthetic",
                "strength": strength,
                "method": method,
                "abs_rel": scores["abs_rel"],
                "delta1": scores["delta1"],
                "edges": edge_error(depth_m, *truth),
                "surfaces": surface_error(depth_m, *truth),
            }
        )
    return records


def _depth(
    sample: StereoSample,
    prior: EmulatedPrior,
    cache: PriorCache,
    strength: str,
    name: str,
    options: StrengthOptions,
) -> np.ndarray:
    """``(H, W)`` metres of one method with a prior of one strength; relative depth aligned to the truth."""
    prior.answer(sample, STRENGTHS[strength], options.resolution, options.seed)
    method = find_method(name)
    try:
        found = method.run(sample, method.own_settings(_settings(options)), cache)
    except NotApplicable as reason:
        bad_value("methods", "methods that work on every pair", f"{name}, not on {sample.label}: {reason}")
    if found.depth_m is not None:
        return found.depth_m
    return align(found.relative, sample.depth_m, sample.valid, found.space)
