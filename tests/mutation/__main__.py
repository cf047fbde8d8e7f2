"""The command line of sampled mutation testing; see the package's docstring."""

import argparse
import hashlib
import multiprocessing
import os
import sys
import tempfile
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed

from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkerOutcome, WorkItem, WorkResult

from tests.mutation import __doc__ as DESCRIPTION
from tests.mutation.coverage_map import ROOT, CoverageMap, LineIndex, RecordedTest
from tests.mutation.sampling import (
    EXCLUDED,
    Mutant,
    changed_lines,
    draw,
    equivalents,
    every_line,
    package_files,
)
from tests.mutation.worker import KILLED, SURVIVED, TIMED_OUT, Outcome, prepare, run_tests

FOLDER = ROOT / ".mutation"
EQUIVALENT = "equivalent"
#: Longest name of a file of results, without its suffix.
MAX_NAME = 100


def main(arguments: list[str]) -> int:
    """Draw, run and report; 1 if the rate is below ``--at-least``."""
    options = _parse(arguments)
    keep = changed_lines(options.changed) if options.changed else every_line
    mutants = draw(package_files(options.only), options.sample, options.seed, keep)
    FOLDER.mkdir(exist_ok=True)
    words = [word.rpartition("/")[2] for word in options.only]
    tests = CoverageMap(FOLDER / "coverage", words if options.keep_records else None)
    tests.update(options.processes)
    with use_db(FOLDER / f"{_name(options)}.sqlite", WorkDB.Mode.create) as database:
        _run(database, _to_run(database, mutants, options.retry), tests, options)
        return _report(mutants, _results(database), options.at_least)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "python -m tests.mutation",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--sample", type=int, default=300, help="Number of mutants to draw (default: 300).")
    add("--seed", type=int, default=0, help="Seed of the draw (default: 0).")
    add("--only", nargs="+", default=[], metavar="WORD", help="Draw from files whose path contains a word.")
    add(
        "--changed", nargs="?", const="main", metavar="COMMIT", help="Draw from lines changed since a commit."
    )
    add("--retry", action="store_true", help="Run the survivors again, for example after writing tests.")
    add("--keep-records", action="store_true", help="Record only tests for --only again; without it, none.")
    add("--test-seconds", type=float, default=30.0, help="Tests per mutant, in seconds (default: 30).")
    add(
        "--processes",
        type=int,
        default=os.cpu_count(),
        help="Mutants to run at once (default: one per core).",
    )
    add("--at-least", type=float, default=0.0, metavar="RATE", help="Fail if fewer are killed, such as 0.9.")
    return parser.parse_args(arguments)


def _name(options: argparse.Namespace) -> str:
    """File of the results: one per draw. Many words are abbreviated, as file systems limit names."""
    parts = [f"seed-{options.seed}", *options.only, *(["changed"] if options.changed else [])]
    name = "-".join(parts).replace("/", "_")
    return name if len(name) <= MAX_NAME else f"{name[:40]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _key(mutant: Mutant) -> str:
    """Identifies a mutant by its code, so that another version of the file is another mutant."""
    return f"{mutant.file}:{hashlib.sha256(mutant.code.encode()).hexdigest()[:16]}"


def _to_run(database: WorkDB, mutants: list[Mutant], retry: bool) -> list[Mutant]:
    """The mutants without a result, and with ``retry`` the survivors; all become items of the database."""
    known = {item.job_id for item in database.work_items}
    new = {_key(mutant): mutant for mutant in mutants if _key(mutant) not in known}
    database.add_work_items(WorkItem.single(key, _spec(mutant)) for key, mutant in new.items())
    status = {key: _status(result) for key, result in _results(database).items()}
    again = (None, SURVIVED) if retry else (None,)
    return [mutant for mutant in mutants if status.get(_key(mutant)) in again]


def _spec(mutant: Mutant) -> MutationSpec:
    place = (mutant.line, 0), (mutant.line, 1)
    return MutationSpec(mutant.file, mutant.operator, mutant.occurrence, *place)


def _run(database: WorkDB, todo: list[Mutant], tests: CoverageMap, options: argparse.Namespace) -> None:
    if not todo:
        return
    index, context = LineIndex(ROOT), multiprocessing.get_context("spawn")
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(options.processes, context, prepare, (folder,)) as pool,
    ):
        futures = {}
        for mutant in todo:
            lines = index.lines_executing(mutant.file, mutant.line)
            covering = tests.covering(mutant.file, lines)
            chosen = choose(covering, options.test_seconds)
            if not chosen:
                database.set_result(
                    _key(mutant), _result(mutant, Outcome(SURVIVED, 0.0, "no test executes it"))
                )
                continue
            names, seconds = [test.name for test in chosen], sum(test.seconds for test in chosen)
            futures[pool.submit(run_tests, mutant.file, mutant.code, names, seconds)] = mutant
        for done, future in enumerate(as_completed(futures), 1):
            mutant, outcome = futures[future], future.result()
            database.set_result(_key(mutant), _result(mutant, outcome))
            where, change = f"{mutant.file}:{mutant.line}", "  ->  ".join(mutant.change)
            print(
                f"{done}/{len(futures)} {outcome.status:9} {outcome.seconds:5.1f} s  {where}  {change}",
                flush=True,
            )


def choose(tests: list[RecordedTest], seconds: float) -> list[RecordedTest]:
    """Which tests run, in order, within a time: those that execute little else, then the others that fit."""
    chosen, left = [], seconds
    for test in tests:
        if test.seconds <= left:
            chosen.append(test)
            left -= test.seconds
    return chosen


_OUTCOMES = {
    SURVIVED: (WorkerOutcome.NORMAL, TestOutcome.SURVIVED),
    KILLED: (WorkerOutcome.NORMAL, TestOutcome.KILLED),
    TIMED_OUT: (WorkerOutcome.ABNORMAL, TestOutcome.KILLED),
}


def _result(mutant: Mutant, outcome: Outcome) -> WorkResult:
    worker, test = _OUTCOMES.get(outcome.status, (WorkerOutcome.EXCEPTION, TestOutcome.SURVIVED))
    return WorkResult(worker, outcome.log, test, " -> ".join(mutant.change))


def _status(result: WorkResult) -> str:
    for status, stored in _OUTCOMES.items():
        if stored == (result.worker_outcome, result.test_outcome):
            return status
    return SURVIVED


def _results(database: WorkDB) -> dict[str, WorkResult]:
    return dict(database.results)


def _report(mutants: list[Mutant], results: dict[str, WorkResult], at_least: float) -> int:
    reasons, counts = equivalents(), defaultdict(Counter)
    survivors = []
    for mutant in mutants:
        if _key(mutant) not in results:
            continue
        status = _status(results[_key(mutant)])
        if status == SURVIVED and (mutant.file, *mutant.change) in reasons:
            status = EQUIVALENT
        elif status == SURVIVED:
            survivors.append(mutant)
        counts[mutant.package][status] += 1
    _print_table(counts)
    for mutant in survivors:
        before, after = mutant.change
        print(f"\n{mutant.file}:{mutant.line}  {mutant.operator}\n  - {before}\n  + {after}")
    return int(_rate(_total(counts)) < at_least)


def _print_table(counts: dict[str, Counter]) -> None:
    print("\nLeft out:", *(f"{pattern} ({why})" for pattern, why in EXCLUDED.items()), sep="\n  ")
    columns = (KILLED, TIMED_OUT, SURVIVED, EQUIVALENT)
    print(f"\n| package | {' | '.join(columns)} | rate |\n| --- |{' ---: |' * (len(columns) + 1)}")
    for package, count in [*sorted(counts.items()), ("all", _total(counts))]:
        cells = [str(count[status]) for status in columns]
        print(f"| {package} | {' | '.join(cells)} | {_rate(count):.0%} |")


def _total(counts: dict[str, Counter]) -> Counter:
    return sum(counts.values(), Counter())


def _rate(count: Counter) -> float:
    noticed = count[KILLED] + count[TIMED_OUT]
    return noticed / max(noticed + count[SURVIVED], 1)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
