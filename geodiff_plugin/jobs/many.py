"""Many pairs: one prior, four stages side by side, a folder and a table row a pair."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import torch

from geodiff_plugin._checks import InputError, refuse
from geodiff_plugin._kernels import without_kernels
from geodiff_plugin._threads import BackgroundTask, WithinCores, available_cores, leaves_cpu_free
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.formats.reading import has_pose_per_image
from geodiff_plugin.jobs.failures import RESUMES, full_disk
from geodiff_plugin.jobs.finished import Row, file_digests, finished_row
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Shard
from geodiff_plugin.jobs.options import DepthOptions, start_pair
from geodiff_plugin.jobs.pair import run_pair
from geodiff_plugin.jobs.pairs import COLUMNS, SUMMARY, PairRef, options_of
from geodiff_plugin.jobs.prior import graphs_for_many, prior_of_options
from geodiff_plugin.jobs.reading import PairInputs, read_pair
from geodiff_plugin.jobs.records import JobLog, PairRun
from geodiff_plugin.jobs.runner import Runner, SideBySide, Stage
from geodiff_plugin.jobs.separate import ProcessEnded, SeparateProcesses
from geodiff_plugin.jobs.steady import write_steady_frames
from geodiff_plugin.jobs.tables import write_table
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.jobs.views import Views
from geodiff_plugin.jobs.writing import write_row
from geodiff_plugin.options import on_ray
from geodiff_plugin.runtime.machine import pick_device

#: What became of every pair.
JOURNAL = ".pairs.jsonl"
#: Processes that write, at most: to write a pair takes up to twice as long as to guide it on a GPU, and one
#: more makes up for pairs that take longer. Each has Python, torch and a pair in memory.
MOST_WRITERS = 3
#: Cores that they leave to the threads that read, make evidence and guide.
CORES_OF_STAGES = 3


class _EndsRun(BaseException):
    """Ends the whole run: no prior, a full disk, or no process that writes; its cause says which."""


@contextmanager
def _ends_run_if_all_would_fail() -> Iterator[None]:
    try:
        yield
    except ProcessEnded as error:
        raise _EndsRun from ProcessEnded(f"{error} {RESUMES}")
    except Exception as error:
        if (full := full_disk(error)) is not None:
            raise _EndsRun from full
        raise


@dataclass(eq=False)
class _OnItsWay:
    """A pair between two stages; ``entries`` of its report are those that only a run over many knows."""

    options: DepthOptions
    folder: OutFolder
    log: JobLog
    entries: dict[str, Any]
    inputs: PairInputs
    run: PairRun | None = None


class Stages:
    """The stages of a pair, each called in a thread of its own.

    A ``pipe`` that is not given is loaded when the first pair has been read; ``among`` stages compute at the
    same time and share the cores; ``tell`` hears which prior it is, and what was assumed. Beside a GPU the
    pairs are written by ``writers`` separate processes: a thread that writes would keep the threads that
    launch kernels from Python's lock. They start at once, while the prior is loaded. If ``writers`` is 0, as
    on a CPU, a thread writes.
    """

    def __init__(
        self,
        options: DepthOptions,
        device: torch.device,
        pipe: Any = None,
        *,
        among: int = 2,
        tell: Tell = silent,
        writers: int = 0,
    ) -> None:
        self._options, self._device, self._pipe = options, device, pipe
        self._among, self._tell = among, tell
        self._views, self._folders = Views(options), dict[str, ExitStack]()
        self._writers = SeparateProcesses(write_row.__module__, writers) if writers else None
        #: The stages in their order.
        self.all: tuple[Stage, ...] = (
            self.read,
            self.evidence,
            self.guide,
            SideBySide(self.write, max(1, writers)),
        )

    def close(self) -> None:
        """Close the videos and end the processes that write, when the threads are done."""
        self._views.close()
        if self._writers is not None:
            self._writers.close()

    def read(self, item: Item) -> _OnItsWay:
        """Look at the files, take the folder, decode the views."""
        ref: PairRef = item.payload
        options = options_of(ref, self._options)
        folder = start_pair(options, photographs=ref.frame is None)
        held = self._folders[item.key] = ExitStack()
        with _ends_run_if_all_would_fail():
            held.enter_context(folder)
        digests = file_digests(options)  # before: what changes later is another version
        entries = {"pair": {"name": ref.name, "frame": ref.frame, "sha256": digests}}
        log = JobLog()
        with log.stage("calibration"):
            inputs = read_pair(options, self._views.of(ref))
        for note in inputs.notes:
            self._tell(note)
        return _OnItsWay(options, folder, log, entries, inputs)

    def evidence(self, pair: _OnItsWay) -> _OnItsWay:
        """What the views say by themselves, into a store of the pair's own, where the call finds it."""
        if self._pipe is None:
            try:
                tell = None if self._tell is silent else self._tell
                graphs = graphs_for_many(self._options, self._device)
                self._pipe = prior_of_options(replace(self._options, graphs=graphs), self._device, tell)
            except Exception as error:
                raise _EndsRun from error
        device, guidance, left = self._device_of_pipe, pair.inputs.guidance, pair.inputs.left
        plain, kernels = torch.autocast(device.type, enabled=False), without_kernels(self._options.no_kernels)
        with pair.log.stage("evidence"), WithinCores(self._among), torch.no_grad(), plain, kernels:
            guidance.evidence_store = EvidenceStore(1, copies=False)
            # Threads share a stream by default, and the network of the pair before still runs on it. The
            # evidence has a stream of its own, which does not wait for that network.
            work = functools.partial(_prepare, guidance, left, device)
            BackgroundTask(work, device, own_stream=True, follows=False).result()
        return pair

    @functools.cached_property
    def _device_of_pipe(self) -> torch.device:
        """Found once, as the pipeline looks through all of its layers for it."""
        device: torch.device = self._pipe._execution_device
        return device

    def guide(self, pair: _OnItsWay) -> _OnItsWay:
        """The guided call."""
        with WithinCores(self._among):
            pair.run = run_pair(self._pipe, pair.options, pair.inputs, pair.log)
        pair.inputs.guidance.evidence_store = None
        return pair

    def write(self, pair: _OnItsWay) -> Row:
        """The files, the report last, and the row of the table."""
        assert pair.run is not None
        with _ends_run_if_all_would_fail():
            if self._writers is None:
                return write_row(pair.folder, pair.run, pair.entries)
            return self._writers.call(write_row, pair.folder.place, pair.run, pair.entries)

    def release(self, item: Item) -> None:
        """Give back the folder of a pair."""
        self._folders.pop(item.key, ExitStack()).close()


def count_writers(device: torch.device, pairs: int, processes: int) -> int:
    """How many processes write so many pairs; none where the stages before need all cores.

    ``processes`` like this one share the cores of the machine.
    """
    if not leaves_cpu_free(device):
        return 0
    return min(pairs, MOST_WRITERS, max(1, available_cores() // processes - CORES_OF_STAGES))


def _prepare(guidance: GeometryGuidance, left: Any, device: torch.device) -> None:
    """Work the evidence of a left image out on a device; the guidance keeps it in its store."""
    guidance.prepare(left_images(left).to(device))


def _refuse_one_length(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Refuse one baseline for all pairs of a model, because its pairs have different ones."""
    given = [] if options.baseline is None or len(refs) < 2 else [options_of(ref, options) for ref in refs]
    for calib in dict.fromkeys(each.calib for each in given if each.calib):
        if has_pose_per_image(calib if len(calib) > 1 else calib[0]):
            each = f"every pair of {calib[0]} has a baseline of its own"
            refuse(f"--baseline cannot be used here: {each}. Try geodiff capture MODEL --known-length.")


def depth_pairs(
    options: DepthOptions,
    refs: Sequence[PairRef],
    *,
    tell: Tell = silent,
    progress: bool = False,
    pipe: Any = None,
) -> list[Row]:
    """What ``geodiff depth`` does with many pairs: a folder each below ``options.out``, and ``pairs.csv``.

    Finished pairs of an earlier run are kept; a pair that fails is a row, and the others go on. A shard
    (``options.shard``) works on its part alone, and has a table of its own, ``pairs.I-of-N.csv``.

    Args:
        options: of the command, with ``out``.
        refs: of ``start_many`` with the same options.
        tell: takes the lines for the user.
        progress: whether a bar on stderr counts the pairs.
        pipe: a guided pipeline, in place of the prior that the options name.

    Returns:
        A row a pair, in order, with ``COLUMNS``; ``result`` is ``"done"``, ``"there"`` or ``"failed"``.

    Raises:
        InputError: all pairs fail for one reason; results of other options; a full disk.
    """
    assert options.out is not None
    _refuse_one_length(options, refs)
    shard = Shard.of(options.shard)
    device = _device_of(options, shard)
    options.config()  # refuses options that contradict each other before anything is written
    if options.steady and not shard.whole:
        refuse("--steady needs all frames: run the shards without it, then the whole with it.")
    refs = shard.part(refs)
    with Journal(options.out / JOURNAL, shard) as journal:
        items = [Item(r.name, r, words=(str(r.left), str(r.right), str(options.out / r.name))) for r in refs]
        there = _rows_there(items, options, journal)
        with _nothing_left_if_all_fail(journal):
            if options.engine == "ray":
                pairs_to_folders = on_ray("pairs_to_folders")
                records = pairs_to_folders(options, items, journal, progress=progress)
            else:
                left = sum(journal.get(item) is None for item in items)
                writers = count_writers(device, left, shard.processes_here(torch.cuda.device_count()))
                runner = Runner(items, journal, noun="pair", survives=(Exception,), progress=progress)
                records = _through(Stages(options, device, pipe, tell=tell, writers=writers), runner)
        rows = [_final(record, there.get(record["key"]), options, tell) for record in records]
        write_table(shard.path(options.out / SUMMARY), rows, tell)
        if options.steady:
            failed = {row["pair"] for row in rows if row["result"] == "failed"}
            with closing(Views(options)) as views:
                whole = [ref for ref in refs if ref.name not in failed]
                write_steady_frames(options, whole, views.of, tell)
    return rows


def _device_of(options: DepthOptions, shard: Shard) -> torch.device:
    """The device that the options name; of several GPUs that of the shard."""
    device = pick_device(options.device)
    if device.type == "cuda" and device.index is None:
        return torch.device("cuda", shard.local % torch.cuda.device_count())
    return device


def _rows_there(items: Sequence[Item], options: DepthOptions, journal: Journal) -> dict[str, Row]:
    """Rows of the pairs that an earlier run has finished, by name; records of all others do not count."""
    there = dict[str, Row]()
    for item in items:
        row = None if options.overwrite else finished_row(options_of(item.payload, options))
        if row is None:
            journal.forget(item)
            continue
        there[item.key] = row
        if journal.get(item) is None:
            journal.put(item, row)
    return there


def _through(stages: Stages, runner: Runner) -> list[Row]:
    """The records of all pairs, once they are through the stages."""
    try:
        with _ends_run_if_all_would_fail():
            return runner.run(*stages.all, release=stages.release)
    except _EndsRun as ended:
        assert ended.__cause__ is not None
        raise ended.__cause__ from None
    finally:
        stages.close()


@contextmanager
def _nothing_left_if_all_fail(journal: Journal) -> Iterator[None]:
    """Remove the journal, and the folder that holds nothing else, where the run itself ends with an error."""
    try:
        yield
    except InputError:
        with suppress(OSError):
            journal.close()  # Windows removes no open file
            if not any(path for path in journal.path.parent.iterdir() if path != journal.path):
                journal.path.unlink()
                journal.path.parent.rmdir()
        raise


def _final(record: Row, there: Row | None, options: DepthOptions, tell: Tell) -> Row:
    """A row of the table from a record of the journal, or from the report that an earlier run left."""
    record = record | (there or {})
    row = {name: record.get(name) for name in COLUMNS} | {"pair": record["key"]}
    if record.get("status") == BROKEN:
        return row | {"result": "failed", "message": record["error"]}
    if not options.strict or record["verdict"] == "trusted":
        return row | {"result": "there" if there else "done"}
    assert options.out is not None
    reason = f"The depth in {options.out / record['key']} is {record['verdict']}: {record['reasons']}"
    tell(f"geodiff: {record['key']}: {reason}")  # --strict: it has failed
    told = {"pair": record["key"], "result": "failed", "message": reason, "codes": record.get("codes")}
    return dict.fromkeys(COLUMNS) | told
