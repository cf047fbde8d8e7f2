"""``geodiff depth`` on many pairs: one process, one prior, four stages side by side.

Data flow: ``DepthArguments`` -> ``PairRef`` each -> ``Conveyor`` -> a folder a pair, a table, the exit code.
Paper: Algorithm 1, pair after pair.
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.text import Text
from tqdm import tqdm

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.estimate import load_guided_prior
from geodiff_plugin.cli.exports import check_exports
from geodiff_plugin.cli.many.conveyor import Conveyor
from geodiff_plugin.cli.many.finished import distrust, finished_report
from geodiff_plugin.cli.many.job import Job, Reader, Stages, ThreadWarnings
from geodiff_plugin.cli.many.pairs import PairRef, assumption
from geodiff_plugin.cli.many.processes import Processes, join_processes
from geodiff_plugin.cli.many.summary import COLUMNS, SUMMARY, Row, write_summary
from geodiff_plugin.cli.messages import collected_warnings, in_options, say
from geodiff_plugin.cli.settings import Settings, read_settings
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.formats.out import reason_of

__all__ = ["EXIT_SOME_FAILED", "run_many"]

#: Exit code of a run of which some pairs have no result.
EXIT_SOME_FAILED = 4
#: Pairs in memory at a time: one in each of the four stages.
MOST_ON_THE_WAY = 4
#: A table of more pairs than this has only those that want to be looked at.
MOST_ROWS = 20


def run_many(arguments: DepthArguments, refs: Sequence[PairRef]) -> None:
    """Run the command on all pairs, answer on stdout, and leave with a code if one of them failed.

    Args:
        arguments: checked by ``start.start_many``.
        refs: the pairs, in order.

    Raises:
        ValueError: ``--out`` has results of other options, or of files that have changed since; then nothing
            is computed, and nothing written.
    """
    settings = read_settings(arguments)
    check_exports(arguments.export, None)
    processes = join_processes(settings.device)
    assumed = assumption(refs, arguments)
    if assumed and processes.index == 0 and not arguments.quiet:
        say(assumed)
    settings = replace(settings, device=processes.device(settings.device))
    rows = [row for _, row in sorted(_work(arguments, settings, refs, processes))]
    rows = processes.gather(rows)
    if processes.index == 0:
        if arguments.json:
            print(json.dumps(rows, indent=2))
        elif not arguments.quiet:
            _print(rows, arguments.out)
        try:
            write_summary(arguments.out, rows)
        except OSError as error:  # what was found out is on the screen, and each result in its folder
            say(f"geodiff: {arguments.out / SUMMARY} could not be written ({reason_of(error)}).")
    if any(row["result"] == "failed" for row in rows):
        sys.exit(EXIT_SOME_FAILED)


def _work(
    arguments: DepthArguments, settings: Settings, refs: Sequence[PairRef], processes: Processes
) -> Iterator[tuple[int, Row]]:
    """Number and row of every pair of this process's share."""
    jobs = []
    for number, ref in processes.share(list(enumerate(refs))):
        job = Job.of(ref, arguments, number)
        report = None if arguments.overwrite else finished_report(job.arguments)
        if report is None:
            jobs.append(job)
        elif arguments.strict and (reason := distrust(job.arguments, report)):
            say(f"geodiff: {ref.name}: {reason}")
            yield number, _row(ref.name, "failed", None, reason)
        else:
            yield number, _row(ref.name, "there", report)
    if jobs:
        is_whole = len(jobs) == len(refs)
        yield from _run(arguments, settings, jobs, processes, is_whole)


def _refuse_if_all_fail(jobs: Sequence[Job], reader: Reader, quiet: bool) -> None:
    """Read pairs until one can be read, so that what is wrong with all of them is said once, and early.

    Args:
        jobs: all pairs of a run. The one that could be read keeps its views.
        reader: of the pairs.
        quiet: no progress bar.

    Raises:
        ValueError: no pair can be read, and for all it is the same reason, but for their names.
    """
    first = None
    for job in tqdm(jobs, "reading", unit="pair", file=sys.stderr, disable=quiet, leave=False, delay=1.0):
        try:
            reader.read(job)
            return
        except InputError as error:
            job.let_go()
            reason = str(error)
        except Exception:  # a defect: told with its traceback when its turn comes
            job.let_go()
            return
        arguments, cause = job.arguments, reason
        for path in (arguments.left, arguments.right, arguments.out):
            cause = cause if path is None else cause.replace(str(path), "")
        first = first or (reason, cause)
        if cause != first[1]:
            return
    if first is not None:
        raise InputError(f"{first[0]} The same holds for all {len(jobs)} pairs; nothing was computed.")


def _run(
    arguments: DepthArguments,
    settings: Settings,
    jobs: list[Job],
    processes: Processes,
    is_whole: bool,
) -> Iterator[tuple[int, Row]]:
    warned, tell = ThreadWarnings(), _once()
    with ExitStack() as held:
        for job in jobs:  # those on the way when the run is stopped
            held.callback(job.let_go)
        reader = held.enter_context(closing(Reader(settings, warned)))
        if is_whole and len(jobs) > 1:  # the pairs that are left over, or those of one process, are no rule
            with collected_warnings(warned, tell):
                _refuse_if_all_fail(jobs, reader, arguments.quiet)
        pipe = load_guided_prior(replace(arguments, quiet=arguments.quiet or processes.index > 0), settings)
        stages = Stages(pipe, settings, warned, arguments.warm_start, reader=reader)

        def failed(job: Job, error: Exception) -> None:
            job.error = _say_failed(job, error)

        conveyor = Conveyor(
            [stages.read, stages.evidence, stages.guide, stages.write], failed, MOST_ON_THE_WAY
        )
        bar = tqdm(total=len(jobs), desc="pairs", unit="pair", file=sys.stderr, disable=arguments.quiet)
        bar.set_description("pairs" if processes.count == 1 else f"pairs of process {processes.index + 1}")
        held.enter_context(bar)
        held.enter_context(collected_warnings(warned, tell))
        for job in held.enter_context(closing(conveyor.run(jobs))):
            row = _row(job.ref.name, "failed" if job.error else "done", job.report, job.error)
            job.let_go()
            bar.update()
            yield job.number, row


def _once() -> Callable[[str], None]:
    """Says a warning the first time that any pair gives rise to it; ``report.json`` has those of each."""
    seen: set[str] = set()

    def tell(sentence: str) -> None:
        if sentence not in seen:
            seen.add(sentence)
            say(f"warning: {sentence}")

    return tell


def _say_failed(job: Job, error: Exception) -> str:
    """Say why a pair failed, and return that; what is no fault of the input keeps its traceback."""
    reason = in_options(str(error)) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    if not isinstance(error, InputError):
        say("".join(traceback.format_exception(error)).rstrip())
    say(f"geodiff: {job.ref.name}: {reason}")
    return reason


def _row(name: str, result: str, report: dict[str, Any] | None, message: str | None = None) -> Row:
    """What the summary says of one pair."""
    if report is None:
        return dict.fromkeys(COLUMNS) | {"pair": name, "result": result, "message": message}
    depth, judgement = report["depth"], report["judgement"]
    return {
        "pair": name,
        "result": result,
        "near_m": depth["min_m"],
        "median_m": depth["median_m"],
        "far_m": depth["max_m"],
        "trusted": judgement["trusted"],
        "confidence": judgement["signs"]["confidence"],
        "seconds": round(sum(report["seconds"].values()), 3),
        "message": message or " ".join(report["warnings"]) or None,
    }


def _print(rows: Sequence[Row], out: Path) -> None:
    """The table and what it comes to."""
    shown = [row for row in rows if row["result"] == "failed" or row["trusted"] is False]
    shown = list(rows) if len(rows) <= MOST_ROWS else shown
    if shown:
        table = new_table(("pair", "result", "near m", "median m", "far m", "confidence", "s"))
        for row in shown:
            numbers = [row[name] for name in ("near_m", "median_m", "far_m", "confidence", "seconds")]
            result = "not to be trusted" if row["trusted"] is False else row["result"]
            table.add_row(row["pair"], result, *("-" if v is None else f"{v:.2f}" for v in numbers))
        show(table)
    counts = {kind: sum(row["result"] == kind for row in rows) for kind in ("done", "there", "failed")}
    doubtful = sum(row["trusted"] is False for row in rows)
    number = "1 pair" if len(rows) == 1 else f"{len(rows)} pairs"
    totals = [f"{number}: {counts['done']} done, {counts['there']} there already"]
    totals.append(f"{counts['failed']} failed, {doubtful} not to be trusted -> {out}/")
    show(Text(", ".join(totals)))
    for row in shown:
        if row["result"] == "failed":
            show(Text(f"{row['pair']}: {row['message']}"))
