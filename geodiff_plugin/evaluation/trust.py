"""How often a wrong calibration is detected, and a right one is not trusted: ``geodiff eval trust``.

The folder keeps the signs of every call, so that other thresholds need no new calls.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, guided_configuration
from geodiff_plugin.evaluation.datasets import load
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.evaluation.experiment import Experiment, cell_key, last_of
from geodiff_plugin.evaluation.mistakes import WRONG, WRONG_POINTS, case_kinds, make_case
from geodiff_plugin.evaluation.options import TrustOptions, command_line, first_pairs, rendered_refs
from geodiff_plugin.evaluation.report import Page
from geodiff_plugin.evaluation.table import Table, count_of_pairs
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runner import Item, Record
from geodiff_plugin.runtime.verdict import Indicators, judge

__all__ = ["TEN", "run_trust"]

#: First line of the page.
PURPOSE = "How many wrong calibrations a run detects, and how many correct ones it does not trust."

#: The ten kinds of wrong calibration that every pair is given with.
TEN = (
    "swapped", "inverse", "axis", "tilted", "mirrored",
    "millimetres", "thousandth", "K-1.5", "K-2", "K-0.67",
)  # fmt: skip
#: A depth further off than this, as a share of the truth at the median pixel, is wrong enough to be told.
OFF = 0.2
NOTE = (
    "Median error of the depth as a share of the truth; left and right exchanged, there is no truth. A wrong "
    "focal length of a rectified pair scales the depth and changes nothing else: two views cannot show it."
)


def _measure(
    ref: SampleRef,
    other: SampleRef,
    kind: str,
    read: Callable[[SampleRef], StereoSample],
    pipe: Any,
    settings: Settings,
) -> Record:
    """One guided call, what was said of it, and how far it is off."""
    original = read(ref)
    if not original.valid.any():
        bad_value(f"the truth of {ref.label}", "known for at least one pixel", "none")
    sample, points, has_truth = make_case(kind, original, partial(load, other))
    head = {"rectified": original.rectified}
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            cameras = (sample.K_left, sample.K_right), sample.E
            guidance = GeometryGuidance(sample.right, *cameras, points=points)
            out = pipe(Image.fromarray(sample.left), guidance=guidance, **call_arguments(settings))
        except InputError as error:
            return head | {"status": "refused", "said": [str(error)], "off": None}
        said += [str(warning.message) for warning in caught if warning.category is UserWarning]
    verdict, depth_m = out.verdicts[0], out.prediction[0, ..., 0]
    of_verdict = {verdict.sentence, *verdict.remarks}
    said += [sentence for sentence in out.warnings if sentence not in of_verdict]
    off = None
    if has_truth:
        off = float(np.median(np.abs(depth_m[sample.valid] / sample.depth_m[sample.valid] - 1.0)))
    signs = {name: None if value != value else value for name, value in asdict(verdict.indicators).items()}
    return head | {"status": "finished", "said": said, "off": off, "signs": signs}


def _judged(record: Record) -> Record:
    """The record with what today's verdict makes of its signs."""
    if record["status"] == "refused":
        return record
    signs: dict[str, Any] = {n: math.nan if value is None else value for n, value in record["signs"].items()}
    sentences = {name: tuple(signs.get(name, ())) for name in ("doubts", "mistakes")}
    verdict = judge(Indicators(**signs | sentences))
    return record | {"status": verdict.status, "said": [*record["said"], *verdict.reasons, *verdict.remarks]}


def _beyond_views(record: dict[str, Any]) -> bool:
    """Whether nothing in two views shows the mistake: rectified rows stay rows under any focal length."""
    return record["rectified"] and record["kind"].startswith("K-")


def _share(part: int, whole: int) -> str:
    return "-" if whole == 0 else f"{part} of {whole} ({100 * part // whole} %)"


def _table(group: str, records: Sequence[dict[str, Any]], kinds: Sequence[str]) -> Table:
    names = {kind: WRONG[kind][0] for kind in kinds if kind in WRONG}
    names |= {kind: f"points {WRONG_POINTS[kind]:g} times too far" for kind in kinds if kind in WRONG_POINTS}
    rows: list[list[str]] = []
    counted = {"all wrong ones": [0, 0], "without focal lengths of rectified pairs": [0, 0]}
    for kind in ("right", "right, points", *kinds):
        own = [record for record in records if record["kind"] == kind]
        if not own:
            continue
        right = kind.startswith("right")
        off = [r for r in own if r["off"] is None or r["off"] > OFF]
        told = [r for r in off if r["status"] != "trusted" or r["said"]]
        for count, some in zip(
            counted.values(), (lambda r: True, lambda r: not _beyond_views(r)), strict=True
        ):
            count[0] += 0 if right else sum(map(some, told))
            count[1] += 0 if right else sum(map(some, off))
        distrusted = sum(r["status"] != "trusted" for r in own)
        median = np.median([r["off"] for r in own if r["off"] is not None] or [math.nan])
        warned = sum(r["status"] != "trusted" or bool(r["said"]) for r in own)
        rows.append(
            [
                names.get(kind, kind),
                "-" if math.isnan(median) else f"{median:.2f}",
                _share(distrusted, len(own)),
                _share(warned, len(own)),
                _share(len(told), len(off)),
            ]
        )
    rows += [[name, "", "", "", _share(*count)] for name, count in counted.items()]
    head = ["given as", "median error", "not trusted", "anything said", f"said, of those > {OFF:.0%} off"]
    pairs = count_of_pairs(len({record["sample"] for record in records}), f"{group} ")
    title = f"Wrong calibrations detected, right ones not trusted: {pairs}"
    return Table(title, tuple(head), tuple(map(tuple, rows)), NOTE)


def run_trust(name: str, options: TrustOptions) -> Page | None:
    """Measure, write ``trust.jsonl`` and the table.

    Raises:
        InputError: an unknown kind, no pairs, a pair without truth, or one alone that has no unrelated one.
    """
    kinds = options.kinds or TEN
    for kind in kinds:
        if kind not in WRONG and kind not in WRONG_POINTS:
            bad_value("--kinds", f"some of {', '.join((*WRONG, *WRONG_POINTS))}", repr(kind))
    text = f"synthetic:{{}}@{options.width}x{options.width * 3 // 4}"
    groups = {
        "real": first_pairs(options.data, options.limit),
        "rendered": rendered_refs(text, options.rendered),
    }
    if not any(groups.values()):
        bad_value("--data", "given, or --rendered above 0", "neither")
    if "unrelated" in kinds and any(len(refs) == 1 for refs in groups.values()):
        bad_value("--kinds", "without 'unrelated' where a pair is alone", "it", "Give two pairs or more.")
    settings, priors, read = options.settings, PriorCache(), last_of(load)
    configuration = guided_configuration(GeometryGuidance, settings)
    pipe, prior = priors.get(settings), f"{settings.prior} {priors.fingerprint(settings)}"
    cells = []
    for group, refs in groups.items():
        for i, ref in enumerate(refs):
            other = refs[(i + 1) % len(refs)]
            for kind in case_kinds(kinds):
                beside = {"other": cell_key(other, "", {})} if kind == "unrelated" else {}
                head = {"kind": kind, "group": group, "sample": ref.label}
                work = partial(_measure, ref, other, kind, read, pipe, settings)
                key = cell_key(ref, kind, configuration | beside, prior)
                cells.append(Item(key, work, name=f"{ref.label}, {kind}", head=head))

    def tables(records: list[Record]) -> list[Table]:
        judged = [_judged(record) for record in records]
        there = dict.fromkeys(record["group"] for record in judged)
        return [_table(group, [r for r in judged if r["group"] == group], kinds) for group in there]

    return Experiment(name, "Trust", cells, tables, purpose=PURPOSE).run(options, command_line(name, options))
