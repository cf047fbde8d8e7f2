"""``geodiff depth`` and ``geodiff capture``: the jobs, with what they tell and answer in a terminal."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.text import Text

from geodiff_plugin.cli.terminal import EXIT_SOME_FAILED, new_table, show
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.jobs.bag import depth_bag
from geodiff_plugin.jobs.capture import depth_capture
from geodiff_plugin.jobs.finished import Row
from geodiff_plugin.jobs.lengths import measured_words
from geodiff_plugin.jobs.many import depth_pairs
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions
from geodiff_plugin.jobs.pair import depth_pair
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.records import JobLog
from geodiff_plugin.jobs.report import report_text, summary_line
from geodiff_plugin.jobs.telling import Tell, collected_warnings, say, silent
from geodiff_plugin.options import on_ray
from geodiff_plugin.types import UNTESTED

#: What to open first of a finished result.
FIRST_FILES = ("overview.png", "depth.npy", "cloud.ply")
#: A table of more pairs than this shows only failed and untrusted ones.
MOST_ROWS = 20
#: How a capture without a unit gets one.
GIVE_LENGTH = "a length gives the unit: --known-length or --distance"
#: Frames that are not trusted, of which the summary gives the names.
MOST_NAMES = 9


def _tell(options: DepthOptions | CaptureOptions) -> Tell:
    return silent if options.quiet else say


def run_depth(options: DepthOptions, folder: OutFolder, started: float) -> None:
    """One pair; the answer on stdout is the summary, or the report with ``--json``.

    ``folder`` is held already; ``started`` is when this module began to be imported, by ``perf_counter``.
    """
    log, progress = JobLog(seconds={"start": time.perf_counter() - started}), not options.quiet
    with collected_warnings():
        result = depth_pair(options, folder=folder, log=log, tell=_tell(options), progress=progress)
    report = result.report
    if options.json:
        print(report_text(report))
    elif not options.quiet:
        print(summary_line(report, f"{folder.path}/: {', '.join(FIRST_FILES)}"))


def run_many(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Many pairs; the answer is a table and what it comes to, or the rows as JSON."""
    assert options.out is not None
    with collected_warnings():
        rows = depth_pairs(options, refs, tell=_tell(options), progress=not options.quiet)
    answer_rows(rows, options.out, options.json, options.quiet)


def run_parquet(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Many pairs into Parquet files, by Ray; the answer is what it comes to."""
    with collected_warnings():
        to_parquet = on_ray("pairs_to_parquet")
        result = to_parquet(options, refs, progress=not options.quiet)
    if options.json:
        print(json.dumps(asdict(result), indent=2))
    elif not options.quiet:
        totals = f"{result.done} done, {result.there} there already, {len(result.failed)} failed"
        print(f"{len(refs)} pairs: {totals}, {result.not_trusted} not trusted -> {result.uri}")
    if result.failed:
        sys.exit(EXIT_SOME_FAILED)


def run_bag(options: DepthOptions) -> None:
    """The pairs of a bag, as a bag; the answer is that of ``run_many``."""
    with collected_warnings():
        result = depth_bag(options, tell=_tell(options), progress=not options.quiet)
    if not options.quiet:
        say(f"{result.path}: {result.images} depth images ({options.encoding}) of {len(result.rows)} pairs")
    answer_rows(result.rows, result.frames, options.json, options.quiet)


def answer_rows(rows: Sequence[Row], out: Path, as_json: bool, quiet: bool = False) -> None:
    """Print what became of pairs, and end with ``EXIT_SOME_FAILED`` where one failed."""
    if as_json:
        print(json.dumps(rows, indent=2))
    elif not quiet:
        _show_rows(rows, out)
    if any(row["result"] == "failed" for row in rows):
        sys.exit(EXIT_SOME_FAILED)


def _show_rows(rows: Sequence[Row], out: Path) -> None:
    doubtful = [row for row in rows if row["verdict"] not in (None, "trusted")]
    failed = [row for row in rows if row["result"] == "failed"]
    table = new_table(("pair", "result", "near m", "median m", "far m", "confidence", "s"))
    for row in rows if len(rows) <= MOST_ROWS else [*failed, *doubtful]:
        numbers = [row[name] for name in ("near_m", "median_m", "far_m", "confidence", "seconds")]
        result = row["verdict"] if row in doubtful else row["result"]
        table.add_row(row["pair"], result, *("-" if v is None else f"{v:.2f}" for v in numbers))
    done, there = (sum(row["result"] == kind for row in rows) for kind in ("done", "there"))
    doubted = sum(row["verdict"] == "not trusted" for row in doubtful)
    number = "1 pair" if len(rows) == 1 else f"{len(rows)} pairs"
    totals = f"{done} done, {there} there already, {len(failed)} failed, {doubted} not trusted"
    totals += f", {len(doubtful) - doubted} not judged" * (doubted < len(doubtful))
    messages = [Text(f"{row['pair']}: {row['message']}") for row in failed]
    files = ", ".join(f"NAME/{file}" for file in FIRST_FILES)
    show(table, Text(f"{number}: {totals} -> {out}/: {files}"), *messages)


def run_capture(options: CaptureOptions) -> None:
    """Depth of every frame; the answer is a summary, or the report with ``--json``.

    Ends with ``EXIT_SOME_FAILED`` where a frame failed, or with ``--strict`` is not trusted.
    """
    with collected_warnings():
        report = depth_capture(options, tell=_tell(options), progress=not options.quiet)
    if options.json:
        print(json.dumps(report, indent=2))
    elif options.poses_only:
        print(f"poses {report['poses']['status']} -> {options.out}/")
    else:
        files = ": sheet.jpg, cloud.ply, NAME/depth.npy" if options.shard is None else ""
        print(f"{summary(report, options.out)}{files}")
        for record in report.get("measured", ()):
            print(measured_words(record))
    if report["failed"] or (options.strict and report["not_trusted"]):
        sys.exit(EXIT_SOME_FAILED)


def summary(report: dict[str, Any], out: Path) -> str:
    """One line for people."""
    depths = sorted(frame["depth"]["median"] for frame in report["frames"] if "error" not in frame)
    line = f"{len(depths)} of {len(report['frames'])} frames"
    if depths:
        unit = "m" if report["unit"] else f"units of the poses ({GIVE_LENGTH})"
        line += f", median depth {depths[len(depths) // 2]:.2f} {unit}"
    if doubted := report["not_trusted"]:
        line += f"; NOT TRUSTED: {', '.join(doubted[:MOST_NAMES])}{' ...' if doubted[MOST_NAMES:] else ''}"
        judged = (frame for frame in report["frames"] if "verdict" in frame)  # those that failed are not
        reasons = next(frame["verdict"]["reasons"] for frame in judged if frame["frame"] == doubted[0])
        line += f" ({doubted[0]}: {' '.join(reasons[:1]) or UNTESTED})"
    return f"{line} -> {out}/"
