"""How often a wrong calibration is detected, and a right one is not trusted: ``geodiff eval trust``.

Data flow: pairs, right and made wrong -> guided calls -> indicators -> verdicts -> one table.
Paper: none.

The folder keeps the signs of every call, so that other thresholds need no new calls.
"""

from __future__ import annotations

import math
import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from geodiff_plugin import __version__
from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.evaluation.baselines import Settings
from geodiff_plugin.evaluation.baselines._guidance import call_arguments, guided_configuration
from geodiff_plugin.evaluation.baselines.base import PriorCache
from geodiff_plugin.evaluation.cells import count_of_pairs
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.options import first_pairs, settings_words
from geodiff_plugin.evaluation.records import append_record, clean_records, read_records, record_key
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.wrong import WRONG, WRONG_POINTS, Case, case_kinds, cases_of
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runtime.verdict import Indicators, judge

__all__ = ["TEN", "TrustOptions", "run_trust"]

#: First line of the page.
PURPOSE = "How many wrong calibrations a run detects, and how many correct ones it does not trust."

#: The ten kinds of wrong calibration that every pair is given with.
TEN = (
    "swapped", "inverse", "axis", "tilted", "mirrored",
    "millimetres", "thousandth", "K-1.5", "K-2", "K-0.67",
)  # fmt: skip
#: A depth further off than this, as a share of the truth at the median pixel, is wrong enough to be told.
OFF = 0.2
RECORDS = "trust.jsonl"
NOTE = (
    "Median error of the depth as a share of the truth; left and right exchanged, there is no truth. A wrong "
    "focal length of a rectified pair scales the depth and changes nothing else: two views cannot show it."
)


@dataclass(frozen=True)
class TrustOptions:
    """Options of ``geodiff eval trust``.

    Attributes:
        data: folder of real pairs, or ``None``.
        rendered: so many rendered pairs.
        width: of the rendered ones, pixels; 3/4 of it high.
        kinds: keys of ``WRONG`` and ``WRONG_POINTS``.
        limit: at most so many real pairs.
        settings: prior, device, seed.
        out: folder of records and table; resumed.
        quiet: no bar.
        results: Markdown page to write beside; ``None`` for none.
    """

    data: Path | None
    rendered: int
    width: int
    kinds: tuple[str, ...]
    limit: int | None
    settings: Settings
    out: Path
    quiet: bool
    results: Path | None = None


def _measure(case: Case, pipe: Any, settings: Settings) -> dict[str, Any]:
    """One guided call, what was said of it, and how far it is off."""
    sample, said = case.sample, []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            cameras = (sample.K_left, sample.K_right), sample.E
            guidance = GeometryGuidance(sample.right, *cameras, points=case.points)
            out = pipe(Image.fromarray(sample.left), guidance=guidance, **call_arguments(settings))
        except InputError as error:
            return {"status": "refused", "said": [str(error)], "off": None}
        said += [str(warning.message) for warning in caught if warning.category is UserWarning]
    verdict, depth_m = out.verdicts[0], out.prediction[0, ..., 0]
    of_verdict = {verdict.sentence, *verdict.remarks}
    said += [sentence for sentence in out.warnings if sentence not in of_verdict]
    off = None
    if case.truth:
        off = float(np.median(np.abs(depth_m[sample.valid] / sample.depth_m[sample.valid] - 1.0)))
    signs = {name: None if value != value else value for name, value in asdict(verdict.indicators).items()}
    return {"status": "finished", "said": said, "off": off, "signs": signs}


def _judged(record: dict[str, Any]) -> dict[str, Any]:
    """The record with what today's verdict makes of its signs."""
    if record["status"] == "refused":
        return record
    signs = {name: math.nan if value is None else value for name, value in record["signs"].items()}
    verdict = judge(Indicators(**signs | {"mistakes": tuple(signs["mistakes"])}))
    status = "trusted" if verdict.trusted else "not trusted"
    return record | {"status": status, "said": [*record["said"], *verdict.reasons, *verdict.remarks]}


def _refs(options: TrustOptions) -> dict[str, list[SampleRef]]:
    size = f"@{options.width}x{options.width * 3 // 4}"
    rendered = find_pairs(Path(f"synthetic:{options.rendered}{size}"), None) if options.rendered else []
    groups = {"real": first_pairs(options.data, options.limit), "rendered": rendered}
    if "unrelated" in options.kinds and any(len(refs) == 1 for refs in groups.values()):
        bad_value("--kinds", "without 'unrelated' where a pair is alone", "it", "Give two pairs or more.")
    return groups


def _records(options: TrustOptions) -> Iterator[dict[str, Any]]:
    """Every case's record: those that the folder has, and the others as they are measured."""
    path, priors = options.out / RECORDS, PriorCache()
    clean_records(path)
    done = {record["key"]: record for record in read_records(path)}
    groups, configuration = _refs(options), guided_configuration(GeometryGuidance, options.settings)
    prior = f"{options.settings.prior} {priors.fingerprint(options.settings)}"
    for group, refs in groups.items():
        for i, ref in enumerate(tqdm(refs, desc=group, disable=options.quiet, file=sys.stderr)):
            other = refs[(i + 1) % len(refs)]
            keys = {
                kind: record_key(ref, kind, configuration | _other(kind, other), prior, __version__)
                for kind in case_kinds(options.kinds)
            }
            if not done.keys() >= set(keys.values()):
                sample = load(ref)
                if not sample.valid.any():
                    bad_value(f"the truth of {ref.label}", "known for at least one pixel", "none")
                head = {"group": group, "sample": ref.label, "rectified": sample.rectified}
                for case in cases_of(sample, partial(load, other), options.kinds):
                    key = keys[case.kind]
                    if key not in done:
                        found = _measure(case, priors.get(options.settings), options.settings)
                        done[key] = {"key": key, "kind": case.kind} | head | found
                        append_record(path, done[key])
            yield from (_judged(done[key]) for key in keys.values())


def _other(kind: str, ref: SampleRef) -> dict[str, Any]:
    """What beside the pair itself a kind depends on, for the key of its record."""
    return {"other": record_key(ref, "", {}, "", "")} if kind == "unrelated" else {}


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
    count = len({record["sample"] for record in records})
    title = f"Wrong calibrations detected, right ones not trusted: {count_of_pairs(count, f'{group} ')}"
    return Table(title, tuple(head), tuple(map(tuple, rows)), NOTE)


def run_trust(options: TrustOptions) -> Page:
    """Measure, write ``trust.jsonl`` and the table.

    Raises:
        InputError: an unknown kind, no pairs, a pair without truth, or one alone that has no unrelated one.
    """
    for kind in options.kinds:
        if kind not in WRONG and kind not in WRONG_POINTS:
            known = ", ".join((*WRONG, *WRONG_POINTS))
            bad_value("--kinds", f"some of {known}", repr(kind))
    with OutFolder(options.out, resume=True):
        records = list(_records(options))
        words = ["geodiff", "eval", "trust"]
        words += ["--rendered", str(options.rendered), "--width", str(options.width)]
        words += [] if options.data is None else ["--data", options.data.name]
        words += [] if options.limit is None else ["--limit", str(options.limit)]
        words += [] if options.kinds == TEN else ["--kinds", ",".join(options.kinds)]
        words += settings_words(options.settings)
        groups = dict.fromkeys(record["group"] for record in records)
        tables = [_table(g, [r for r in records if r["group"] == g], options.kinds) for g in groups]
        page = Page("Trust", run_facts(shlex.join(words)), tuple(tables), purpose=PURPOSE)
        write_page(page, options.out, "trust", options.results)
    return page
