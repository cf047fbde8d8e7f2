"""Processes many pairs: one prior, four concurrent stages, and a folder and a table row for each pair."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin._internal.checks import InputError, raise_input_error
from geodiff_plugin._internal.threads import WithinCores, available_cores, leaves_cpu_free
from geodiff_plugin.findings import Severity
from geodiff_plugin.formats import OutFolder, has_pose_per_image
from geodiff_plugin.jobs.failures import RESUMES, full_disk
from geodiff_plugin.jobs.finished import Row, depth_columns, finished_row
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Shard
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import DepthOptions, start_pair
from geodiff_plugin.jobs.pair import run_read_pair
from geodiff_plugin.jobs.pairs import COLUMNS, SUMMARY, PairRef, options_of
from geodiff_plugin.jobs.prior import graphs_for_many, prior_of_options
from geodiff_plugin.jobs.processes import ProcessEnded, WorkerProcesses, can_have_workers
from geodiff_plugin.jobs.reading import PairReader
from geodiff_plugin.jobs.records import PairRun, ReadPair
from geodiff_plugin.jobs.runner import ParallelStage, Runner, Stage, on_ray
from geodiff_plugin.jobs.smoothing import write_smoothed_frames
from geodiff_plugin.jobs.tables import write_table
from geodiff_plugin.jobs.writing import write_row
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.prefetch import prefetch_evidence

#: Name of the journal with the outcome of every pair.
JOURNAL = ".pairs.jsonl"
#: Maximum number of writer processes. Writing a pair takes up to twice as long as guiding it on a GPU; a
#: third process covers slower pairs. Each process holds Python, torch and a pair in memory.
MAX_WRITERS = 3
#: Cores reserved for the threads that read, prepare evidence and guide.
RESERVED_CORES = 3


class _EndsRun(BaseException):
    """Ends the whole run: no prior, a full disk, or no writer process. Its cause states which."""


@contextmanager
def _ends_run_on_fatal_error() -> Iterator[None]:
    try:
        yield
    except ProcessEnded as error:
        raise _EndsRun from ProcessEnded(f"{error} {RESUMES}")
    except Exception as error:
        if (full := full_disk(error)) is not None:
            raise _EndsRun from full
        raise


@dataclass(eq=False)
class _PairState:
    """State of a pair between two stages: its held folder, the inputs, and the run after the guided call."""

    folder: OutFolder
    pair: ReadPair
    run: PairRun | None = None


class Stages:
    """Implements the stages of a pair, each called in its own thread.

    Next to a GPU, worker processes write the pairs. They start at once, while the prior loads. A writer
    thread would take the GIL from the threads that launch kernels.

    Args:
        options: options of the run.
        device: device of the prior.
        pipe: a guided pipeline; by default the prior of the options is loaded after the first pair was read.
        among: number of stages that compute at the same time and share the cores.
        notify: receives messages about the prior and about assumptions.
        writers: number of writer processes; 0 writes in a thread, as on a CPU.
    """

    def __init__(
        self,
        options: DepthOptions,
        device: torch.device,
        pipe: Any = None,
        *,
        among: int = 2,
        notify: Notify = silent,
        writers: int = 0,
    ) -> None:
        self._options, self._device, self._pipe = options, device, pipe
        self._among, self._notify = among, notify
        self._reader = PairReader(options)
        self._folders = dict[str, ExitStack]()
        self._writers = WorkerProcesses(write_row.__module__, writers) if writers else None
        #: The stages in order.
        self.all: tuple[Stage, ...] = (
            self.read,
            self.evidence,
            self.guide,
            ParallelStage(self.write, max(1, writers)),
        )

    def close(self) -> None:
        """Close the videos, and end the writer processes after the threads have finished."""
        self._reader.close()
        if self._writers is not None:
            self._writers.close()

    def read(self, item: Item) -> _PairState:
        """Check the files, hold the output folder, and decode the views."""
        ref: PairRef = item.payload
        options = options_of(ref, self._options)
        folder = start_pair(options, images=ref.frame is None)
        held = self._folders[item.key] = ExitStack()
        with _ends_run_on_fatal_error():
            held.enter_context(folder)
        pair = self._reader.read(ref, options)
        for finding in pair.inputs.guidance.findings:
            if finding.severity is Severity.ASSUMPTION:
                self._notify(finding)
        return _PairState(folder, pair)

    def evidence(self, state: _PairState) -> _PairState:
        """Compute the evidence of the views into the pair's own store, which the guided call reads."""
        self._load_prior()
        device = self._device_of_pipe
        inputs = state.pair.inputs
        sharing: Any = {"among": self._among, "kernels": not self._options.no_triton}
        with state.pair.log.stage("evidence"):
            prefetch_evidence(inputs.guidance, inputs.left, device, **sharing)
        return state

    def _load_prior(self) -> None:
        """Load the prior if it is not loaded; no pair can be guided without it."""
        if self._pipe is not None:
            return
        try:
            notify = None if self._notify is silent else self._notify
            graphs = graphs_for_many(self._options, self._device)
            self._pipe = prior_of_options(replace(self._options, cuda_graphs=graphs), self._device, notify)
        except Exception as error:
            raise _EndsRun from error

    @cached_property
    def _device_of_pipe(self) -> torch.device:
        """Return the pipeline's device, cached because the pipeline searches all of its layers for it."""
        device: torch.device = self._pipe._execution_device
        return device

    def guide(self, state: _PairState) -> _PairState:
        """Make the guided call."""
        with WithinCores(self._among):
            state.run = run_read_pair(self._pipe, state.pair)
        state.pair.inputs.guidance.evidence_store = None
        return state

    def write(self, state: _PairState) -> Row:
        """Write the files, the report last, and return the table row."""
        assert state.run is not None
        with _ends_run_on_fatal_error():
            if self._writers is None:
                return write_row(state.folder, state.run)
            return self._writers.call(write_row, state.folder.place, state.run)

    def release(self, item: Item) -> None:
        """Release the folder of a pair."""
        self._folders.pop(item.key, ExitStack()).close()


def count_writers(device: torch.device, pairs: int, processes: int) -> int:
    """Return the number of writer processes for this number of pairs; 0 if the other stages need all cores.

    ``processes`` is the number of processes like this one that share the machine's cores.
    """
    if not (leaves_cpu_free(device) and can_have_workers()):
        return 0
    return min(pairs, MAX_WRITERS, max(1, available_cores() // processes - RESERVED_CORES))


def _raise_one_length(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Reject one baseline for all pairs of a model, because its pairs have different baselines."""
    given = [] if options.baseline is None or len(refs) < 2 else [options_of(ref, options) for ref in refs]
    for calib in dict.fromkeys(each.calib for each in given if each.calib):
        if has_pose_per_image(calib if len(calib) > 1 else calib[0]):
            each = f"every pair of {calib[0]} has its own baseline"
            raise_input_error(f"--baseline cannot be used: {each}. Use geodiff capture MODEL --known-length.")


def depth_pairs(
    options: DepthOptions,
    refs: Sequence[PairRef],
    *,
    notify: Notify = silent,
    progress: bool = False,
    pipe: Any = None,
) -> list[Row]:
    """Implement ``geodiff depth`` for many pairs: a folder each in ``options.out``, and ``pairs.csv``.

    Keeps finished pairs of an earlier run. A failed pair becomes a row, and the run continues. A shard
    (``options.shard``) processes its part only, and writes its own table, ``pairs.I-of-N.csv``.

    Args:
        options: options of the command, with ``out``.
        refs: pairs from ``start_many`` with the same options.
        notify: receives messages for the user.
        progress: whether to count the pairs with a progress bar on stderr.
        pipe: a guided pipeline, used in place of the prior of the options.

    Returns:
        One row per pair, in order, with ``COLUMNS``; ``result`` is ``"done"``, ``"kept"`` or ``"failed"``.

    Raises:
        InputError: all pairs fail for one reason, the folder has results of other options, or the disk is
            full.
    """
    assert options.out is not None
    _raise_one_length(options, refs)
    shard = Shard.of(options.shard)
    device = _device_of(options, shard)
    options.config()  # raises if options contradict each other, before anything is written
    if options.temporal_smoothing and not shard.whole:
        raise_input_error(
            "--temporal-smoothing needs all frames. Run the shards without it, then the whole job with it."
        )
    with Journal(options.out / JOURNAL, shard) as journal:
        items = [_item(ref, options.out) for ref in shard.part(refs)]
        finished = _finished_rows(items, options, journal)
        with _cleaned_up_on_error(journal):
            runner = Runner(items, journal, noun="pair", is_recoverable=(Exception,), progress=progress)
            if options.engine == "ray":
                records = runner.run_elsewhere(partial(on_ray("pairs_to_folders"), options))
            else:
                processes = shard.processes_here(torch.cuda.device_count())
                writers = count_writers(device, len(runner.left), processes)
                records = _through(Stages(options, device, pipe, notify=notify, writers=writers), runner)
        rows = [_final(record, finished.get(record["key"]), options, notify) for record in records]
        write_table(shard.path(options.out / SUMMARY), rows, notify)
        if options.temporal_smoothing:
            rows = _with_smoothed_depth(options, items, rows, notify)
            write_table(options.out / SUMMARY, rows, notify)
    return rows


def _item(ref: PairRef, out: Path) -> Item:
    return Item(ref.name, ref, words=(str(ref.left), str(ref.right), str(out / ref.name)))


def _with_smoothed_depth(
    options: DepthOptions, items: Sequence[Item], rows: Sequence[Row], notify: Notify
) -> list[Row]:
    """Apply ``--temporal-smoothing`` to the frames that did not fail; return the rows with the new depth."""
    failed = {row["pair"] for row in rows if row["result"] == "failed"}
    with PairReader(options) as reader:
        refs = [item.payload for item in items if item.key not in failed]
        reports = write_smoothed_frames(options, refs, reader.frames_of, notify)
    smoothed = {ref.name: depth_columns(report) for ref, report in zip(refs, reports, strict=True)}
    return [row | smoothed.get(row["pair"], {}) for row in rows]


def _device_of(options: DepthOptions, shard: Shard) -> torch.device:
    """Return the device of the options; if there are several GPUs, the shard's."""
    device = pick_device(options.device)
    if device.type == "cuda" and device.index is None:
        return torch.device("cuda", shard.local % torch.cuda.device_count())
    return device


def _finished_rows(items: Sequence[Item], options: DepthOptions, journal: Journal) -> dict[str, Row]:
    """Return the rows of pairs finished by an earlier run, by name; drop the records of all other pairs."""
    finished = dict[str, Row]()
    for item in items:
        row = None if options.overwrite else finished_row(options_of(item.payload, options))
        if row is None:
            journal.forget(item)
            continue
        finished[item.key] = row
        if journal.get(item) is None:
            journal.put(item, row)
    return finished


def _through(stages: Stages, runner: Runner) -> list[Row]:
    """Take all pairs through the stages and return their records."""
    try:
        with _ends_run_on_fatal_error():
            return runner.run(*stages.all, release=stages.release)
    except _EndsRun as ended:
        assert ended.__cause__ is not None
        raise ended.__cause__ from None
    finally:
        stages.close()


@contextmanager
def _cleaned_up_on_error(journal: Journal) -> Iterator[None]:
    """Remove the journal, and the folder if it is empty otherwise, if the run itself ends with an error."""
    try:
        yield
    except InputError:
        with suppress(OSError):
            journal.close()  # Windows does not remove open files
            if not any(path for path in journal.path.parent.iterdir() if path != journal.path):
                journal.path.unlink()
                journal.path.parent.rmdir()
        raise


def _final(record: Row, finished: Row | None, options: DepthOptions, notify: Notify) -> Row:
    """Return a table row from a record of the journal, or from the report of an earlier run."""
    record = record | (finished or {})
    row = {name: record.get(name) for name in COLUMNS} | {"pair": record["key"]}
    if record.get("status") == BROKEN:
        return row | {"result": "failed", "message": record["error"]}
    if not options.strict or record["verdict"] == "trusted":
        return row | {"result": "kept" if finished else "done"}
    assert options.out is not None
    reason = f"The depth in {options.out / record['key']} is {record['verdict']}: {record['reasons']}"
    notify(f"geodiff: {record['key']}: {reason}")  # with --strict an untrusted pair counts as failed
    reported = {"pair": record["key"], "result": "failed", "message": reason, "codes": record.get("codes")}
    return dict.fromkeys(COLUMNS) | reported
