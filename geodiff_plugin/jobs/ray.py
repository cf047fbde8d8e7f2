"""Many pairs on Ray Data (extra ``ray``): read and encode on CPUs, guide on actors that hold the prior.

>>> rows = ray.data.from_items([{"key": "a", "left": "a_L.png", "right": "a_R.png", "calib": "calib.txt"}])
>>> depth_dataset(rows, prior="prs-eth/marigold-depth-v1-1").write_parquet("s3://bucket/depth")

A row that cannot be read, guided or encoded becomes a row with an ``error``, and the others continue. Ray
reschedules the tasks of a lost worker.
"""

from __future__ import annotations

import pickle
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import ray
import ray.data

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin._internal.lazy import gc_frozen, imported
from geodiff_plugin.jobs.failures import full_disk
from geodiff_plugin.jobs.journal import Done
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef

if TYPE_CHECKING:
    from geodiff_plugin.jobs.finished import Row
    from geodiff_plugin.jobs.records import ReadPair

#: CPUs per task that reads or encodes. Must differ from ``GUIDE_CPUS``: Ray fuses stages with equal requests,
#: and would then read inside the actor while its GPU is idle.
TASK_CPUS = 0.25
#: CPUs per actor. If all CPUs guide, half of one remains for the tasks that feed the actor.
GUIDE_CPUS = 0.5
#: Maximum number of pairs that one task reads: with their images they are about 100 MB.
MAX_ROWS = 8
#: Maximum number of blocks of rows, because the driver tracks each of them.
MAX_BLOCKS = 20_000
#: Column with the state passed between stages: pickled like all objects in Ray, but as bytes, whose size Ray
#: knows.
STATE = "geodiff_state"


@dataclass(frozen=True)
class Workers:
    """The actors that hold the prior.

    Attributes:
        count: number of actors (default: as many as fit in the cluster).
        gpus: GPUs per actor, possibly a fraction, such as 0.5 for two actors per GPU. Default: 1 if the
            cluster has any, otherwise 0.
    """

    count: int | None = None
    gpus: float | None = None

    def max_count(self) -> int:
        """Maximum number of actors in the connected cluster."""
        if self.count is not None:
            return self.count
        resources, gpus = ray.cluster_resources(), self._gpus()
        if gpus:
            return max(1, int(resources.get("GPU", 0.0) / gpus))
        return max(1, int(resources.get("CPU", 1.0) / (GUIDE_CPUS + 2 * TASK_CPUS)))

    def for_rows(self, rows: int) -> Workers:
        """Return workers limited to the number of rows."""
        return self if self.max_count() <= rows else replace(self, count=max(1, rows))

    def task_arguments(self) -> Row:
        """Return arguments of ``Dataset.map`` for tasks that read for these actors or encode their results.

        If CPUs guide, one task per stage and actor is enough; each further task would load torch.
        """
        size = None if self._gpus() else self.max_count()
        return {"num_cpus": TASK_CPUS, "compute": ray.data.TaskPoolStrategy(size)}

    def arguments(self) -> Row:
        """Return arguments of ``Dataset.map`` that request these actors."""
        size: Row = (
            {"min_size": 1, "max_size": self.max_count()} if self.count is None else {"size": self.count}
        )
        compute = ray.data.ActorPoolStrategy(**size)
        return {"compute": compute, "num_cpus": GUIDE_CPUS, "num_gpus": self._gpus() or None}

    def _gpus(self) -> float:
        if self.gpus is not None:
            return self.gpus
        return 1.0 if ray.cluster_resources().get("GPU", 0.0) >= 1 else 0.0


def depth_dataset(ds: Any, *, workers: Workers = Workers(), **options: Any) -> Any:
    """Compute metric depth of every row of a Ray dataset.

    Args:
        ds: rows with ``key`` (text), ``left`` and ``right`` (paths, or the bytes of image files), and the
            cameras in one of three forms: ``calib`` (a path or a list of paths); the numbers ``fx``, ``fy``,
            ``cx``, ``cy`` in pixels and ``baseline`` in metres; or the matrices ``K_left`` (9 numbers), ``E``
            (16, the pose of the right camera in the left one's frame) and, if it differs, ``K_right``. Any
            other option of ``DepthOptions`` may be a column too, and overrides ``options``. Columns with
            other names are kept. Paths must be readable on every machine of the cluster.
        workers: the actors that hold the prior.
        **options: options of ``DepthOptions`` for all rows, such as ``prior`` and ``steps``.

    Returns:
        A lazy dataset: the columns of ``ds`` without the images, and ``rows.COLUMNS``. ``depth_mm`` is a
        16-bit PNG of millimetres (thousandths of ``unit`` if that is not metres), 0 for depth beyond
        65.535 m. ``confidence`` is an 8-bit PNG of 255ths, or ``None`` if not measured. Both are
        ``height`` x ``width``; ``fx`` to ``cy`` are in their pixels; ``codes`` are defined in
        ``geodiff_plugin.findings``. ``error`` states why a row has no depth; all other columns of its result
        are ``None``.

    Raises:
        InputError: unknown options.

    Every call processes one pair, so the result of a row does not depend on other rows.
    """
    imported("jobs.rows.check_names")(options)
    base = DepthOptions(left=Path(), **options)
    return encoded(_guided(ds, partial(_read_columns, base), base, workers), workers)


def guided_refs(refs: Sequence[PairRef], options: DepthOptions, workers: Workers) -> Any:
    """Return a dataset with a row for each pair of a command, which holds a ``PairRun`` for ``attempt``.

    Args:
        refs: pairs from ``start_many``.
        options: options of the command.
        workers: the actors, whose number determines the number of blocks.
    """
    workers = workers.for_rows(len(refs))
    each = min(MAX_ROWS, max(1, len(refs) // (4 * workers.max_count())))
    blocks = min(MAX_BLOCKS, ceil(len(refs) / each))
    rows = [{"key": ref.name, STATE: pickle.dumps(ref)} for ref in refs]
    ds = ray.data.from_items(rows, override_num_blocks=blocks)
    return _guided(ds, partial(_read_ref, options), options, workers)


def _guided(ds: Any, read: Callable[[Row], ReadPair], options: DepthOptions, workers: Workers) -> Any:
    rows = ds.map(partial(_read, read), **workers.task_arguments())
    return rows.map(_Guide, fn_constructor_args=(options,), **workers.arguments())


def encoded(runs: Any, workers: Workers) -> Any:
    """Convert a dataset of ``PairRun`` to the rows of ``depth_dataset``."""
    arguments = workers.task_arguments()
    return runs.map(_encode, **arguments).map_batches(_typed, batch_format="pyarrow", **arguments)


def attempt(row: Row, work: Callable[[Any], Any]) -> tuple[Row, Any]:
    """Run a stage on the state passed by the previous one.

    Returns:
        The row without ``STATE``, and the result. If the row has an error, or gets one here, the result is
        ``None``.

    Raises:
        InputError: a full disk, which ends the run.
    """
    kept = {name: value for name, value in row.items() if name != STATE}
    if row["error"] is not None:
        return kept, None
    try:
        return kept, work(pickle.loads(row[STATE]))
    except Exception as error:
        return kept | {"error": _message(error)}, None


def _message(error: Exception) -> str:
    """Return the message of a row's error; raise if the disk is full."""
    if (full := full_disk(error)) is not None:
        raise full from error
    if isinstance(error, (InputError, OSError, ValueError)):
        return str(error)
    traceback.print_exception(error, file=sys.stderr)  # an internal error, for the worker's log
    return f"{type(error).__name__}: {error}"


def _hand_over(kept: Row, state: Any) -> Row:
    return kept | {STATE: b"" if state is None else pickle.dumps(state)}


def _imported_in_worker(where: str) -> Any:
    """Import and return the object of this package with a dotted name, such as ``jobs.rows.read_ref``.

    The stages import what they need in the worker process, so that tasks do not load what only actors need.
    """
    with gc_frozen():
        return imported(where)


def _read_columns(base: DepthOptions, row: Row) -> ReadPair:
    return _imported_in_worker("jobs.rows.read_columns")(base, row)


def _read_ref(options: DepthOptions, row: Row) -> ReadPair:
    return _imported_in_worker("jobs.rows.read_ref")(options, pickle.loads(row[STATE]))


def _read(read: Callable[[Row], ReadPair], row: Row) -> Row:
    inputs = {*_imported_in_worker("jobs.rows.IMAGES"), STATE}
    kept = {name: value for name, value in row.items() if name not in inputs}
    pair, error = None, None
    try:
        pair = read(row)
    except Exception as failure:
        error = _message(failure)
    return _hand_over(kept | {"error": error}, pair)


class _Guide:
    """Actor that holds the prior and makes the guided calls."""

    def __init__(self, options: DepthOptions) -> None:
        self._prior = _imported_in_worker("jobs.actor.PriorOfJob")(options)

    def __call__(self, row: Row) -> Row:
        return _hand_over(*attempt(row, self._prior.guide))


def _encode(row: Row) -> Row:
    """Return the row of a result; for a failed pair the columns are empty, and ``error`` states why."""
    kept, columns = attempt(row, _imported_in_worker("jobs.rows.result_columns"))
    empty = dict.fromkeys(_imported_in_worker("jobs.rows.COLUMNS"))
    return kept | empty | (columns or {"error": kept["error"]})


def _typed(table: pa.Table) -> pa.Table:
    """Cast the columns of a result to their types, also if all rows of a batch failed."""
    for name, alias in _imported_in_worker("jobs.rows.COLUMNS").items():
        values = table[name].cast(pa.type_for_alias(alias))
        table = table.set_column(table.schema.get_field_index(name), name, values)
    return table


class _Worker:
    """Actor that calls the function from ``make`` with keys."""

    def __init__(self, make: Callable[[], Callable[[str], Row]]) -> None:
        self._record_of = make()

    def __call__(self, row: Row) -> Row:
        try:
            return _hand_over(row | {"error": None}, self._record_of(row["key"]))
        except Exception as error:
            return _hand_over(row | {"error": _message(error)}, None)


def on_actors(
    keys: Sequence[str], make: Callable[[], Callable[[str], Row]], workers: Workers
) -> Iterator[Done]:
    """Process every key on actors, and yield the outcomes in order of completion.

    ``make`` is called once per actor and returns the function from a key to its record.
    """
    blocks = min(len(keys), MAX_BLOCKS)
    rows: Any = ray.data.from_items([{"key": key} for key in keys], override_num_blocks=blocks)
    arguments = workers.for_rows(len(keys)).arguments()
    for row in rows.map(_Worker, fn_constructor_args=(make,), **arguments).iter_rows():
        record = pickle.loads(row[STATE]) if row["error"] is None else None
        yield Done(row["key"], record, row["error"])
