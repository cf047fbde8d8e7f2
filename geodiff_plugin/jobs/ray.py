"""Many pairs on Ray Data (extra ``ray``): read on CPUs, guide on actors that hold the prior, encode on CPUs.

>>> rows = ray.data.from_items([{"key": "a", "left": "a_L.png", "right": "a_R.png", "calib": "calib.txt"}])
>>> depth_dataset(rows, prior="prs-eth/marigold-depth-v1-1").write_parquet("s3://bucket/depth")

A row that cannot be read, guided or encoded becomes a row with an ``error``, and the others go on. Ray does
again what a lost worker had begun.
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
from typing import TYPE_CHECKING, Any, NamedTuple

import pyarrow as pa
import ray
import ray.data

from geodiff_plugin._checks import InputError
from geodiff_plugin._lazy import imported, uncollected
from geodiff_plugin.jobs.failures import full_disk
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef

if TYPE_CHECKING:
    from geodiff_plugin.jobs.finished import Row
    from geodiff_plugin.jobs.rows import ReadPair

#: Share of a CPU for a task that reads or encodes. It differs from ``GUIDE_CPUS``, because Ray fuses stages
#: that ask for the same, and would read inside the actor, while its GPU waits.
TASK_CPUS = 0.25
#: Share of a CPU for an actor: where all CPUs guide, half of one is left for the tasks that feed it.
GUIDE_CPUS = 0.5
#: Most pairs that one task reads: with their images they are some 100 MB.
MOST_ROWS = 8
#: Most blocks of rows, of each of which the driver keeps track.
MOST_BLOCKS = 20_000
#: Column of what one stage hands to the next: pickled, as all objects in Ray are, but as bytes, of which Ray
#: knows the size.
STATE = "geodiff_state"


@dataclass(frozen=True)
class Workers:
    """The actors that hold the prior.

    Attributes:
        count: how many; without it as many as the cluster has room for.
        gpus: GPUs of each, also a fraction, such as 0.5 for two actors on a card. Without it 1 where the
            cluster has any, else 0.
    """

    count: int | None = None
    gpus: float | None = None

    def most(self) -> int:
        """How many there may be, in a cluster that is connected."""
        if self.count is not None:
            return self.count
        resources, gpus = ray.cluster_resources(), self._gpus()
        if gpus:
            return max(1, int(resources.get("GPU", 0.0) / gpus))
        return max(1, int(resources.get("CPU", 1.0) / (GUIDE_CPUS + 2 * TASK_CPUS)))

    def for_rows(self, rows: int) -> Workers:
        """No more of them than there are rows."""
        return self if self.most() <= rows else replace(self, count=max(1, rows))

    def stages_beside(self) -> Row:
        """Arguments of ``Dataset.map`` for a stage of tasks that feed these actors, or take what they give.

        Where CPUs guide, one task of a stage for each actor is enough; every further one would load torch.
        """
        most = None if self._gpus() else self.most()
        return {"num_cpus": TASK_CPUS, "compute": ray.data.TaskPoolStrategy(most)}

    def arguments(self) -> Row:
        """Arguments of ``Dataset.map`` that ask Ray for these actors."""
        size: Row = {"min_size": 1, "max_size": self.most()} if self.count is None else {"size": self.count}
        compute = ray.data.ActorPoolStrategy(**size)
        return {"compute": compute, "num_cpus": GUIDE_CPUS, "num_gpus": self._gpus() or None}

    def _gpus(self) -> float:
        if self.gpus is not None:
            return self.gpus
        return 1.0 if ray.cluster_resources().get("GPU", 0.0) >= 1 else 0.0


def depth_dataset(ds: Any, *, workers: Workers = Workers(), **options: Any) -> Any:
    """Metric depth of every row of a Ray dataset, as a dataset.

    Args:
        ds: rows with ``key`` (text), ``left`` and ``right`` (paths, or the bytes of image files), and the
            cameras in one of three ways: ``calib`` (a path or a list of paths); the numbers ``fx``, ``fy``,
            ``cx``, ``cy`` in pixels and ``baseline`` in metres; or the matrices ``K_left`` (9 numbers), ``E``
            (16, the pose of the right camera in the left one's frame) and, if it differs, ``K_right``. Any
            other option of ``DepthOptions`` may be a column too, and goes before ``options``. Columns with
            other names are kept. Paths must be readable on every machine of the cluster.
        workers: the actors that hold the prior.
        **options: of ``DepthOptions``, the same for all rows, such as ``prior`` and ``steps``.

    Returns:
        A lazy dataset: the columns of ``ds`` without the images, and ``rows.COLUMNS``. ``depth_mm`` is a
        16-bit PNG of millimetres (thousandths of ``unit`` where that is not metres), 0 where depth is beyond
        65.535 m. ``confidence`` is an 8-bit PNG of 255ths, or ``None`` where none is measured. Both are
        ``height`` x ``width``; ``fx`` to ``cy`` are in their pixels; ``codes`` are those of
        ``geodiff_plugin.messages``. ``error`` says why a row has no depth; all other columns of the result
        are ``None`` then.

    Raises:
        InputError: options that do not exist.

    Every call takes one pair, so that the result of a row does not depend on the rows beside it.
    """
    imported("jobs.rows.check_names")(options)
    base = DepthOptions(left=Path(), **options)
    return encoded(_guided(ds, partial(_read_columns, base), base, workers), workers)


def guided_refs(refs: Sequence[PairRef], options: DepthOptions, workers: Workers) -> Any:
    """A dataset with a row for each pair of a command, which holds a ``GuidedPair`` for ``attempt``.

    Args:
        refs: of ``start_many``.
        options: of the command.
        workers: the actors, which the blocks of rows are enough to keep busy.
    """
    workers = workers.for_rows(len(refs))
    each = min(MOST_ROWS, max(1, len(refs) // (4 * workers.most())))
    blocks = min(MOST_BLOCKS, ceil(len(refs) / each))
    rows = [{"key": ref.name, STATE: pickle.dumps(ref)} for ref in refs]
    ds = ray.data.from_items(rows, override_num_blocks=blocks)
    return _guided(ds, partial(_read_ref, options), options, workers)


def _guided(ds: Any, read: Callable[[Row], ReadPair], options: DepthOptions, workers: Workers) -> Any:
    rows = ds.map(partial(_read, read), **workers.stages_beside())
    return rows.map(_Guide, fn_constructor_args=(options,), **workers.arguments())


def encoded(runs: Any, workers: Workers) -> Any:
    """The rows of a dataset of ``GuidedPair`` as those of ``depth_dataset``."""
    beside = workers.stages_beside()
    return runs.map(_encode, **beside).map_batches(_typed, batch_format="pyarrow", **beside)


def attempt(row: Row, work: Callable[[Any], Any]) -> tuple[Row, Any]:
    """Do the work of a stage on what the one before handed over.

    Returns:
        The row without ``STATE``, and the result. Where the row has an error, or gets one here, the result is
        ``None``.

    Raises:
        InputError: the disk is full, which ends the run.
    """
    kept = {name: value for name, value in row.items() if name != STATE}
    if row["error"] is not None:
        return kept, None
    try:
        return kept, work(pickle.loads(row[STATE]))
    except Exception as error:
        return kept | {"error": _message(error)}, None


def _message(error: Exception) -> str:
    """What a row says of its error; that of a full disk is raised."""
    if (full := full_disk(error)) is not None:
        raise full from error
    if isinstance(error, (InputError, OSError, ValueError)):
        return str(error)
    traceback.print_exception(error, file=sys.stderr)  # a defect of ours: it belongs in the log of the worker
    return f"{type(error).__name__}: {error}"


def _hand_over(kept: Row, state: Any) -> Row:
    return kept | {STATE: b"" if state is None else pickle.dumps(state)}


def _in_worker(where: str) -> Any:
    """What a stage needs, by its dotted name, imported when the stage begins.

    This module itself imports little, so that what tasks need is not all that an actor needs.
    """
    with uncollected():
        return imported(where)


def _read_columns(base: DepthOptions, row: Row) -> ReadPair:
    return _in_worker("jobs.rows.read_columns")(base, row)


def _read_ref(options: DepthOptions, row: Row) -> ReadPair:
    return _in_worker("jobs.rows.read_ref")(options, pickle.loads(row[STATE]))


def _read(read: Callable[[Row], ReadPair], row: Row) -> Row:
    inputs = {*_in_worker("jobs.rows.IMAGES"), STATE}
    kept = {name: value for name, value in row.items() if name not in inputs}
    pair, error = None, None
    try:
        pair = read(row)
    except Exception as failure:
        error = _message(failure)
    return _hand_over(kept | {"error": error}, pair)


class _Guide:
    """An actor: it holds the prior, and makes the guided calls."""

    def __init__(self, options: DepthOptions) -> None:
        self._prior = _in_worker("jobs.actor.PriorOfJob")(options)

    def __call__(self, row: Row) -> Row:
        return _hand_over(*attempt(row, self._prior.guide))


def _encode(row: Row) -> Row:
    """The row of a result; of a pair that failed the columns are empty, and the error says why."""
    kept, columns = attempt(row, _in_worker("jobs.rows.result_columns"))
    empty = dict.fromkeys(_in_worker("jobs.rows.COLUMNS"))
    return kept | empty | (columns or {"error": kept["error"]})


def _typed(table: pa.Table) -> pa.Table:
    """The columns of a result in their types, also where all rows of a batch have failed."""
    for name, alias in _in_worker("jobs.rows.COLUMNS").items():
        values = table[name].cast(pa.type_for_alias(alias))
        table = table.set_column(table.schema.get_field_index(name), name, values)
    return table


class Done(NamedTuple):
    """A piece of work that has been done: its record, or the error that it ended with."""

    key: str
    record: Row | None
    error: str | None


class _Worker:
    """An actor that does by key what ``make`` gives it."""

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
    """Do the work of every key on actors, and give what became of it, in the order in which it is done.

    Each actor calls ``make`` once, which returns the function from a key to its record.
    """
    blocks = min(len(keys), MOST_BLOCKS)
    rows: Any = ray.data.from_items([{"key": key} for key in keys], override_num_blocks=blocks)
    arguments = workers.for_rows(len(keys)).arguments()
    for row in rows.map(_Worker, fn_constructor_args=(make,), **arguments).iter_rows():
        record = pickle.loads(row[STATE]) if row["error"] is None else None
        yield Done(row["key"], record, row["error"])
