"""``--engine ray``: many pairs, the frames of a capture or the cells of an evaluation on a cluster of Ray."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any

import pyarrow as pa
import ray
import ray.data
from tqdm import tqdm

from geodiff_plugin._checks import InputError, refuse
from geodiff_plugin._lazy import imported
from geodiff_plugin._threads import available_cores
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.jobs.failures import Failures, full_disk
from geodiff_plugin.jobs.finished import Row, finished_row
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Record, Shard
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.parquet import Store
from geodiff_plugin.jobs.ray import Done, Workers, attempt, encoded, guided_refs, on_actors
from geodiff_plugin.jobs.rows import GuidedPair
from geodiff_plugin.jobs.telling import say
from geodiff_plugin.jobs.writing import write_row

#: Rows of a Parquet file at most: many small files are slow to list and to read.
MOST_ROWS_PER_FILE = 64
#: And at least, in a job of few pairs: rows that are in no file yet are lost with the driver.
LEAST_ROWS_PER_FILE = 4
#: Settings of Ray Data for a command: no bars and lines of its own, and errors as they were raised.
SETTINGS = {
    "enable_progress_bars": False,
    "print_on_execution_start": False,
    "raise_original_map_exception": True,
}
#: Says how much Ray's own processes write on the screen.
BACKEND_LOG_LEVEL = "RAY_BACKEND_LOG_LEVEL"


@contextmanager
def connected() -> Iterator[None]:
    """A cluster: that of ``RAY_ADDRESS``, or a new one on this machine, which ends with the block.

    Raises:
        InputError: what ended the run, of a task or of Ray; or the process is one of several of a job.
    """
    if not Shard.of(None).whole:
        refuse("--engine ray divides the work by itself: start it once, without RANK and WORLD_SIZE.")
    with ExitStack() as undo:
        undo.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", module=r"ray\.")  # such as that there are fewer blocks than tasks
        if not ray.is_initialized():
            _start_ray(undo)
        logging.getLogger("ray.data").setLevel(logging.CRITICAL)
        context = ray.data.DataContext.get_current()
        for name, value in SETTINGS.items():
            undo.callback(setattr, context, name, getattr(context, name))
            setattr(context, name, value)
        try:
            yield
        except ray.exceptions.RayError as error:
            raise _as_told(error) from error


def _start_ray(undo: ExitStack) -> None:
    if BACKEND_LOG_LEVEL not in os.environ:
        os.environ[BACKEND_LOG_LEVEL] = "fatal"
        undo.callback(os.environ.pop, BACKEND_LOG_LEVEL)
    quiet: Row = {"log_to_driver": False, "logging_level": logging.ERROR, "include_dashboard": False}
    here: Row = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": available_cores()}
    ray.init(**quiet, **here)
    undo.callback(ray.shutdown)


def _as_told(error: Exception) -> InputError:
    """What the user is told of an error that ended the run."""
    cause = getattr(error, "cause", None) or error.__cause__ or error
    if isinstance(cause, InputError):
        return cause
    if (full := full_disk(cause)) is not None:
        return full
    reason = str(cause).strip().splitlines()[-1]
    return InputError(f"Ray ended the run ({reason}). What is finished stays; the same command resumes.")


def _workers(options: Any) -> Workers:
    return Workers(options.workers, options.gpus)


def _check_prior(options: DepthOptions) -> None:
    """Refuse an unknown prior before a cluster starts. A worker that writes does not import the priors."""
    imported("priors.find_prior")(options.prior)


def _alone(options: DepthOptions) -> DepthOptions:
    """The options of a pair by itself, so that its report is that of a run without Ray."""
    return replace(options, engine="local", layout=None, workers=None, gpus=None)


def _recorded(
    items: Sequence[Item],
    journal: Journal,
    work: Callable[[list[Item]], Iterable[Done]],
    failures: Failures,
    progress: bool,
) -> list[Record]:
    """Let ``work`` do the items without a record, and note what it gives in the journal; all records."""
    of_key = {item.key: item for item in items}
    left = [item for item in items if journal.get(item) is None]
    with _bar(len(items), len(items) - len(left), progress) as bar:
        for key, record, error in work(left) if left else ():
            if record is None:
                record = {"status": BROKEN, "error": failures.add(of_key[key], InputError(error))}
            else:
                failures.passed()
            journal.put(of_key[key], record)
            bar.update()
    failures.report()
    return [record for item in items if (record := journal.get(item)) is not None]


def _bar(total: int, there: int, progress: bool) -> tqdm:
    return tqdm(total=total, initial=there, file=sys.stderr, disable=not progress)


def items_on_actors(
    items: Sequence[Item],
    journal: Journal,
    make: Callable[[], Callable[[str], Record]],
    options: Any,
    failures: Failures,
    progress: bool,
) -> list[Record]:
    """The records of items; those that are missing are made by actors.

    Args:
        items: of which the actors know the keys only.
        journal: of the job.
        make: called once by each actor; gives the function from a key to its record.
        options: with ``workers`` and ``gpus``.
        failures: takes what failed.
        progress: whether a bar on stderr counts the items.

    Raises:
        InputError: all items fail for one reason; a full disk.
    """

    def work(left: list[Item]) -> Iterator[Done]:
        return on_actors([item.key for item in left], make, _workers(options))

    with connected():
        return _recorded(items, journal, work, failures, progress)


def pairs_to_folders(
    options: DepthOptions, items: Sequence[Item], journal: Journal, *, progress: bool = False
) -> list[Record]:
    """The records of pairs, each in a folder of its own, as one process makes them.

    Args:
        options: of the command, with ``engine="ray"``.
        items: whose payload is a ``PairRef``.
        journal: of the job.
        progress: whether a bar on stderr counts the pairs.

    Raises:
        InputError: all pairs fail for one reason; no such prior; a full disk.
    """
    _check_prior(options)

    def work(left: list[Item]) -> Iterator[Done]:
        workers = _workers(options)
        runs = guided_refs([item.payload for item in left], _alone(options), workers)
        for row in runs.map(_write_folder, **workers.stages_beside()).iter_rows():
            key, error = row.pop("key"), row.pop("error")
            yield Done(key, row if error is None else None, error)

    with connected():
        return _recorded(items, journal, work, Failures(len(items), "pair", say), progress)


def _write_folder(row: Row) -> Row:
    kept, told = attempt(row, _folder_of)
    return kept | (told or {})


def _folder_of(pair: GuidedPair) -> Row:
    """Write the folder of a pair, unless an attempt that was lost afterwards has; its row of the table."""
    options = pair.run.options
    assert options.out is not None
    there = None if options.overwrite else finished_row(options)
    if there is not None:
        return there
    with OutFolder(options.out, inputs=options.read_files(), overwrite=options.overwrite) as folder:
        return write_row(folder, pair.run, pair.entries)


@dataclass
class ParquetResult:
    """What became of pairs whose results are Parquet files.

    Attributes:
        uri: of the folder.
        there: how many pairs an earlier run had done.
        done: how many this run has done.
        not_trusted: how many of these have another verdict than trusted.
        failed: the errors of all others, by their keys.
    """

    uri: str
    there: int
    done: int = 0
    not_trusted: int = 0
    failed: dict[str, str] = field(default_factory=dict)


def pairs_to_parquet(
    options: DepthOptions, refs: Sequence[PairRef], *, progress: bool = False
) -> ParquetResult:
    """Metric depth of many pairs into the Parquet files of ``options.out``, a folder or a URI.

    Args:
        options: of the command, with ``engine="ray"``.
        refs: of ``start_many``.
        progress: whether a bar on stderr counts the pairs.

    Raises:
        InputError: all pairs fail for one reason; no such prior; results of other options; a full disk.
    """
    _check_prior(options)
    store, failures = Store.of(options), Failures(len(refs), "pair", say)
    with connected():
        keys = store.begin(_alone(options))
        left = [ref for ref in refs if ref.name not in keys]
        result = ParquetResult(store.uri, there=len(refs) - len(left))
        with _bar(len(refs), result.there, progress) as bar:
            for row in _stored(left, options, store) if left else ():
                _count(row, result, failures)
                bar.update()
    failures.report()
    return result


def _count(row: Row, result: ParquetResult, failures: Failures) -> None:
    if row["error"] is not None:
        result.failed[row["key"]] = failures.add(Item(row["key"]), InputError(row["error"]))
        return
    failures.passed()
    result.done += 1
    result.not_trusted += row["verdict"] != "trusted"


def _stored(refs: Sequence[PairRef], options: DepthOptions, store: Store) -> Iterator[Row]:
    """Keys, verdicts and errors of pairs, as soon as they are in a file."""
    workers = _workers(options)
    rows = encoded(guided_refs(refs, _alone(options), workers), workers)
    size = min(MOST_ROWS_PER_FILE, max(LEAST_ROWS_PER_FILE, ceil(len(refs) / (4 * workers.most()))))

    def put(table: pa.Table) -> pa.Table:
        return store.put(table)

    stored = rows.map_batches(put, batch_size=size, batch_format="pyarrow", **workers.stages_beside())
    return stored.iter_rows()
