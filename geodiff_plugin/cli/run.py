"""Run ``geodiff depth`` and ``geodiff capture`` and print their output."""

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
from geodiff_plugin.findings import some_names
from geodiff_plugin.formats import OutFolder
from geodiff_plugin.jobs import (
    CaptureOptions,
    DepthOptions,
    JobLog,
    Notify,
    PairRef,
    Row,
    collected_warnings,
    depth_bag,
    depth_capture,
    depth_pair,
    depth_pairs,
    measured_words,
    on_ray,
    report_text,
    say,
    silent,
    summary_line,
)
from geodiff_plugin.trust import UNTESTED

#: Files of a finished result to open first.
FIRST_FILES = ("overview.png", "depth.npy", "cloud.ply")
#: Maximum number of rows of a full table. Longer tables show only failed and untrusted pairs.
MAX_ROWS = 20
#: Hint for a capture without a metric scale.
GIVE_LENGTH = "for metres pass --known-length or --distance"


def _notify(options: DepthOptions | CaptureOptions) -> Notify:
    return silent if options.quiet else say


def run_depth(options: DepthOptions, folder: OutFolder, started: float) -> None:
    """Process one pair and print the summary, or the report with ``--json``.

    ``folder`` is already held. ``started`` is the ``perf_counter`` time at which the import of this module
    started.
    """
    log = JobLog(seconds={"start": time.perf_counter() - started})
    progress = not options.quiet
    with collected_warnings():
        result = depth_pair(options, folder=folder, log=log, notify=_notify(options), progress=progress)
    report = result.report
    if options.json:
        print(report_text(report))
    elif not options.quiet:
        print(summary_line(report, f"{folder.path}/: {', '.join(FIRST_FILES)}"))


def run_many(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Process many pairs and print a table with totals, or the rows as JSON."""
    assert options.out is not None
    with collected_warnings():
        rows = depth_pairs(options, refs, notify=_notify(options), progress=not options.quiet)
    answer_rows(rows, options.out, options.json, options.quiet)


def run_parquet(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Process many pairs with Ray into Parquet files and print the totals."""
    with collected_warnings():
        to_parquet = on_ray("pairs_to_parquet")
        result = to_parquet(options, refs, progress=not options.quiet)
    if options.json:
        print(json.dumps(asdict(result), indent=2))
    elif not options.quiet:
        totals = f"{result.done} done, {result.kept} already done, {len(result.failed)} failed"
        print(f"{len(refs)} pairs: {totals}, {result.not_trusted} not trusted -> {result.uri}")
    if result.failed:
        sys.exit(EXIT_SOME_FAILED)


def run_bag(options: DepthOptions) -> None:
    """Process the pairs of a bag into a bag and print the output of ``run_many``."""
    with collected_warnings():
        result = depth_bag(options, notify=_notify(options), progress=not options.quiet)
    if not options.quiet:
        say(f"{result.path}: {result.images} depth images ({options.encoding}) from {len(result.rows)} pairs")
    answer_rows(result.rows, result.frames, options.json, options.quiet)


def answer_rows(rows: Sequence[Row], out: Path, as_json: bool, quiet: bool = False) -> None:
    """Print the results of pairs, and exit with ``EXIT_SOME_FAILED`` if one failed."""
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
    for row in rows if len(rows) <= MAX_ROWS else [*failed, *doubtful]:
        numbers = [row[name] for name in ("near_m", "median_m", "far_m", "confidence", "seconds")]
        result = row["verdict"] if row in doubtful else row["result"]
        table.add_row(row["pair"], result, *("-" if v is None else f"{v:.2f}" for v in numbers))
    done, kept = (sum(row["result"] == kind for row in rows) for kind in ("done", "kept"))
    doubted = sum(row["verdict"] == "not trusted" for row in doubtful)
    number = "1 pair" if len(rows) == 1 else f"{len(rows)} pairs"
    totals = f"{done} done, {kept} already done, {len(failed)} failed, {doubted} not trusted"
    totals += f", {len(doubtful) - doubted} not judged" * (doubted < len(doubtful))
    messages = [Text(f"{row['pair']}: {row['message']}") for row in failed]
    files = ", ".join(f"NAME/{file}" for file in FIRST_FILES)
    show(table, Text(f"{number}: {totals} -> {out}/: {files}"), *messages)


def run_capture(options: CaptureOptions) -> None:
    """Process the frames of a capture and print a summary, or the report with ``--json``.

    Exits with ``EXIT_SOME_FAILED`` if a frame failed, or with ``--strict`` if a frame is not trusted.
    """
    with collected_warnings():
        report = depth_capture(options, notify=_notify(options), progress=not options.quiet)
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
    """Summarise a capture report in one line: frames, depth, untrusted frames and the first reason."""
    depths = sorted(frame["depth"]["median"] for frame in report["frames"] if "error" not in frame)
    line = f"{len(depths)} of {len(report['frames'])} frames"
    if depths:
        unit = "m" if report["unit"] else f"pose units ({GIVE_LENGTH})"
        line += f", median depth {depths[len(depths) // 2]:.2f} {unit}"
    if doubted := report["not_trusted"]:
        line += f"; NOT TRUSTED: {some_names(doubted)} ({doubted[0]}: {_first_reason(report, doubted[0])})"
    return f"{line} -> {out}/"


def _first_reason(report: dict[str, Any], name: str) -> str:
    """Return the likeliest reason why a frame of a capture report is not trusted."""
    judged = (frame for frame in report["frames"] if "verdict" in frame)  # failed frames have no verdict
    reasons = next(frame["verdict"]["reasons"] for frame in judged if frame["frame"] == name)
    return reasons[0] if reasons else UNTESTED
