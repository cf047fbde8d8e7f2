"""Runs pairs, frames of a capture or cells of an evaluation on a Ray cluster (``--engine ray``)."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any

import pyarrow as pa
import ray
import ray.data
from tqdm import tqdm

from geodiff_plugin._internal.checks import InputError, raise_input_error
from geodiff_plugin._internal.lazy import imported
from geodiff_plugin._internal.threads import available_cores
from geodiff_plugin.formats import OutFolder
from geodiff_plugin.jobs.failures import Failures, full_disk
from geodiff_plugin.jobs.finished import Row, finished_row
from geodiff_plugin.jobs.journal import Done, Item, Record, Shard
from geodiff_plugin.jobs.notices import say
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.parquet import Store
from geodiff_plugin.jobs.ray import Workers, attempt, encoded, guided_refs, on_actors
from geodiff_plugin.jobs.records import PairRun
from geodiff_plugin.jobs.writing import write_row

#: Maximum number of rows per Parquet file, for jobs of few files: many small files are slow to list and read.
MAX_ROWS_PER_FILE = 64
#: Minimum number of rows per file in a small job. Rows that are not in a file yet are lost with the driver.
MIN_ROWS_PER_FILE = 4
#: Ray Data settings for a command: no progress bars or logs from Ray, and original exceptions.
SETTINGS = {
    "enable_progress_bars": False,
    "print_on_execution_start": False,
    "raise_original_map_exception": True,
}
#: Environment variable with the log level of Ray's own processes.
BACKEND_LOG_LEVEL = "RAY_BACKEND_LOG_LEVEL"


@contextmanager
def connected() -> Iterator[None]:
    """Connect to the cluster in ``RAY_ADDRESS``, or start one on this machine that ends with the block.

    Raises:
        InputError: an error of a task or of Ray ended the run, or the process is one of several of a job.
    """
    if not Shard.of(None).whole:
        raise_input_error(
            "--engine ray distributes the work itself. Start it once, without RANK and WORLD_SIZE."
        )
    with ExitStack() as undo:
        undo.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", module=r"ray\.")  # e.g. that there are fewer blocks than tasks
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
            raise _user_error(error) from error


def _start_ray(undo: ExitStack) -> None:
    if BACKEND_LOG_LEVEL not in os.environ:
        os.environ[BACKEND_LOG_LEVEL] = "fatal"
        undo.callback(os.environ.pop, BACKEND_LOG_LEVEL)
    quiet: Row = {"log_to_driver": False, "logging_level": logging.ERROR, "include_dashboard": False}
    here: Row = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": available_cores()}
    ray.init(**quiet, **here)
    undo.callback(ray.shutdown)


def _user_error(error: Exception) -> InputError:
    """Return the user's message for an error that ended the run."""
    cause = getattr(error, "cause", None) or error.__cause__ or error
    if isinstance(cause, InputError):
        return cause
    if (full := full_disk(cause)) is not None:
        return full
    reason = str(cause).strip().splitlines()[-1]
    return InputError(
        f"Ray ended the run ({reason}). Finished work is kept; run the same command again to resume."
    )


def _workers(options: Any) -> Workers:
    return Workers(options.workers, options.gpus)


def _check_prior(options: DepthOptions) -> None:
    """Raise an error for an unknown prior before a cluster starts. Writer tasks do not import the priors."""
    imported("priors.find_prior")(options.prior)


def _alone(options: DepthOptions) -> DepthOptions:
    """Return the options of a pair by itself, so that its report equals one made without Ray."""
    return replace(options, engine="local", format=None, workers=None, gpus=None)


def _bar(total: int, finished: int, progress: bool) -> tqdm:
    return tqdm(total=total, initial=finished, file=sys.stderr, disable=not progress)


def items_on_actors(
    make: Callable[[], Callable[[str], Record]], options: Any, items: Sequence[Item]
) -> Iterator[Done]:
    """Compute the records of items with actors; for ``Runner.run_elsewhere``.

    Args:
        make: called once by each actor; returns the function from a key to its record.
        options: options with ``workers`` and ``gpus``.
        items: items, of which the actors get the keys only.

    Raises:
        InputError: a full disk, or an error of Ray.
    """
    with connected():
        yield from on_actors([item.key for item in items], make, _workers(options))


def pairs_to_folders(options: DepthOptions, items: Sequence[Item]) -> Iterator[Done]:
    """Write pairs to folders, exactly as a single process does; for ``Runner.run_elsewhere``.

    Args:
        options: options of the command, with ``engine="ray"``.
        items: items whose payload is a ``PairRef``.

    Raises:
        InputError: unknown prior, a full disk, or an error of Ray.
    """
    _check_prior(options)
    workers = _workers(options)
    with connected():
        runs = guided_refs([item.payload for item in items], _alone(options), workers)
        for row in runs.map(_write_folder, **workers.task_arguments()).iter_rows():
            key, error = row.pop("key"), row.pop("error")
            yield Done(key, row if error is None else None, error)


def _write_folder(row: Row) -> Row:
    kept, reported = attempt(row, _write_once)
    return kept | (reported or {})


def _write_once(run: PairRun) -> Row:
    """Write the folder of a pair unless an earlier attempt, lost afterwards, did; return its table row."""
    options = run.options
    assert options.out is not None
    finished = None if options.overwrite else finished_row(options)
    if finished is not None:
        return finished
    with OutFolder(options.out, inputs=options.read_files(), overwrite=options.overwrite) as folder:
        return write_row(folder, run)


@dataclass
class ParquetResult:
    """Outcome of pairs whose results are Parquet files.

    Attributes:
        uri: URI of the folder.
        kept: number of pairs finished by an earlier run.
        done: number of pairs finished by this run.
        not_trusted: number of these whose verdict is not trusted.
        failed: errors of all others, by key.
    """

    uri: str
    kept: int
    done: int = 0
    not_trusted: int = 0
    failed: dict[str, str] = field(default_factory=dict)


def pairs_to_parquet(
    options: DepthOptions, refs: Sequence[PairRef], *, progress: bool = False
) -> ParquetResult:
    """Write metric depth of many pairs to Parquet files in ``options.out``, a folder or URI.

    Args:
        options: options of the command, with ``engine="ray"``.
        refs: pairs from ``start_many``.
        progress: whether to count the pairs with a progress bar on stderr.

    Raises:
        InputError: all pairs fail for one reason, an unknown prior, results of other options, or a full disk.
    """
    _check_prior(options)
    store = Store.of(options)
    failures = Failures(len(refs), "pair", say)
    with connected():
        keys = store.begin(_alone(options))
        left = [ref for ref in refs if ref.name not in keys]
        result = ParquetResult(store.uri, kept=len(refs) - len(left))
        with _bar(len(refs), result.kept, progress) as bar:
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
    """Yield keys, verdicts and errors of pairs as soon as they are stored in a file."""
    workers = _workers(options)
    rows = encoded(guided_refs(refs, _alone(options), workers), workers)
    size = min(MAX_ROWS_PER_FILE, max(MIN_ROWS_PER_FILE, ceil(len(refs) / (4 * workers.max_count()))))

    def put(table: pa.Table) -> pa.Table:
        return store.put(table)

    stored = rows.map_batches(put, batch_size=size, batch_format="pyarrow", **workers.task_arguments())
    return stored.iter_rows()
