"""``geodiff depth`` on many pairs: one prior, four stages side by side, a folder and a table row a pair."""

from __future__ import annotations

import csv
import errno
import json
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.text import Text

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin._threads import WithinCores
from geodiff_plugin.cli.depth import guided_call, load_guided_prior, write_result
from geodiff_plugin.cli.exports import check_image_names
from geodiff_plugin.cli.inputs import Inputs, read_inputs
from geodiff_plugin.cli.options import DepthOptions, check_files, out_folder_of
from geodiff_plugin.cli.pairs import COLUMNS, SUMMARY, PairRef, assumption, options_of
from geodiff_plugin.cli.report import build_report
from geodiff_plugin.cli.terminal import (
    EXIT_SOME_FAILED,
    StopWatch,
    collected_warnings,
    new_table,
    say,
    show,
)
from geodiff_plugin.formats.bags import BagReader, is_bag
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import OutFolder, atomic_path, reason_of
from geodiff_plugin.formats.reading import has_pose_per_image
from geodiff_plugin.formats.video import VideoReader, both_halves
from geodiff_plugin.guidance.evidence import EvidenceStore
from geodiff_plugin.options import flag_of
from geodiff_plugin.runner import BROKEN, Item, Journal, Runner
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import native_images
from geodiff_plugin.types import MetricDepthOutput

#: What became of every pair, as it is known to all processes of a run.
JOURNAL = ".pairs.jsonl"
#: A table of more pairs than this has only those that want to be looked at.
MOST_ROWS = 20
#: Options that a result does not depend on.
NOT_OF_THE_RESULT = {"out", "overwrite", "quiet", "json", "show", "strict", "device", "encoding"}
#: The next pair cannot be written either.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
RESUMES = "Finished pairs stay; the same command goes on with the rest."

Row = dict[str, Any]


class _EndsRun(BaseException):
    """What no pair can be spared: the prior does not load, the disk is full; its cause says which."""


@dataclass(eq=False)
class _Job:
    """A pair on its way through the stages, and what they have made of it so far."""

    ref: PairRef
    options: DepthOptions
    warnings: list[str] = field(default_factory=list)
    watch: StopWatch = field(default_factory=StopWatch)
    held: ExitStack = field(default_factory=ExitStack)
    inputs: Inputs | None = None
    output: MetricDepthOutput | None = None
    out: OutFolder | None = None
    digests: dict[str, str] = field(default_factory=dict)
    began_from: str | None = None


class Stages:
    """The stages of a pair, each called in a thread of its own.

    Args:
        options: of the run.
        refs: its pairs, in order.
        device: where the prior runs.
        pipe: the prior where it is loaded; otherwise it is loaded when the first pair has been read.
        among: stages that compute at the same time and share the cores.
    """

    def __init__(
        self,
        options: DepthOptions,
        refs: Sequence[PairRef],
        device: torch.device,
        pipe: Any = None,
        among: int = 2,
    ) -> None:
        self._options, self._device, self._pipe, self._among = options, device, pipe, among
        self._number = {ref.name: number for number, ref in enumerate(refs)}
        self._jobs: dict[str, _Job] = {}
        self._videos, self._held = dict[Path, VideoReader | BagReader](), ExitStack()
        self._before: tuple[PairRef, tuple[int, ...], MetricDepthOutput] | None = None
        self._thread, self._told = threading.local(), set[str]()

    def close(self) -> None:
        """Close the videos, when the threads are done."""
        self._held.close()

    def tell(self, sentence: str) -> None:
        """Note a warning with the pair that this thread is at, and say it the first time."""
        noted = getattr(self._thread, "warnings", [])
        if sentence not in noted:
            noted.append(sentence)
        if sentence not in self._told:
            self._told.add(sentence)
            say(f"warning: {sentence}")

    def read(self, item: Item) -> _Job:
        """Look at the files, take the folder, decode the views."""
        ref: PairRef = item.payload
        job = self._jobs[item.key] = _Job(ref, options_of(ref, self._options))
        self._thread.warnings = job.warnings
        with job.watch.stage("calibration"):
            views_of_one = ref.frame is not None and ref.right is None
            (replace(job.options, right=ref.left) if views_of_one else job.options).check_all()
            check_files(job.options, photographs=ref.frame is None)
            try:
                job.out = job.held.enter_context(out_folder_of(job.options))
            except InputError as error:
                _end_if_full(error)
                raise
            job.digests = _digests(job.options)  # before: what changes later is another version
            frames = None if ref.frame is None else self._frames(ref, ref.frame)
            job.inputs = read_inputs(job.options, job.options.config(), frames)
            check_image_names(job.options, job.inputs)
        return job

    def _frames(self, ref: PairRef, frame: int) -> Sequence[np.ndarray]:
        for path in {ref.left, ref.right or ref.left} - set(self._videos):
            if is_bag(path):
                reader: Any = BagReader(path, self._options.bag_topics(), self._options.tolerance)
            else:
                reader = VideoReader(path)
            self._videos[path] = self._held.enter_context(reader)
        left = self._videos[ref.left].read(frame)
        return both_halves(left, "LEFT") if ref.right is None else (left, self._videos[ref.right].read(frame))

    def evidence(self, job: _Job) -> _Job:
        """What the views say by themselves, into a store of the pair's own, where the call finds it."""
        self._thread.warnings = job.warnings
        assert job.inputs is not None
        if self._pipe is None:
            try:
                self._pipe = load_guided_prior(self._options, self._device)
            except Exception as error:
                raise _EndsRun from error
        device = self._pipe._execution_device
        with (
            job.watch.stage("evidence"),
            WithinCores(self._among),
            torch.no_grad(),
            torch.autocast(device.type, enabled=False),
        ):
            job.inputs.guidance.evidence_store = EvidenceStore(1, copies=False)
            job.inputs.guidance.prepare(native_images(job.inputs.left, device))
        return job

    def guide(self, job: _Job) -> _Job:
        """The guided call, from the pair before where that is wanted."""
        self._thread.warnings = job.warnings
        assert job.inputs is not None
        guidance, size, before = job.inputs.guidance, job.inputs.left.shape, self._before
        self._before = None  # whatever happens now: a sequence with a hole begins anew
        # A pair between that failed before this stage, or that was there already, has left no trace here.
        follows = before is not None and self._number[before[0].name] == self._number[job.ref.name] - 1
        if before is not None and before[1] == size and follows:
            job.began_from, guidance.previous = before[0].name, before[2]
        warm = self._options.warm_start
        with job.watch.stage("guided call"), WithinCores(self._among):
            quiet = replace(job.options, quiet=True)
            job.output = guided_call(self._pipe, job.inputs, quiet, output_latent=warm)
        guidance.evidence_store = guidance.previous = None
        if warm:  # without its maps
            needed = ("latent", "space", "scale", "shift", "global_scale", "rescaled")
            kept = {name: getattr(job.output, name) for name in needed}
            small = MetricDepthOutput(prediction=job.output.prediction[:0], **kept)
            self._before = job.ref, size, small
        return job

    def write(self, job: _Job) -> Row:
        """The files, the report last, and the row of the table."""
        self._thread.warnings = job.warnings
        assert job.inputs is not None and job.output is not None and job.out is not None
        job.warnings += [w for w in job.output.warnings if w not in job.warnings]
        report = build_report(job.inputs, job.output, self._pipe, job.options, job.warnings)
        pair = {"name": job.ref.name, "frame": job.ref.frame, "began_from": job.began_from}
        report["pair"] = pair | {"sha256": job.digests}
        try:
            write_result(job.options, job.out, job.inputs, job.output, report, job.watch)
        except OSError as error:
            _end_if_full(error)
            raise
        return _row(report)

    def release(self, item: Item) -> None:
        """Give back the folder and the memory of a pair."""
        job = self._jobs.pop(item.key, None)
        if job is not None:
            job.held.close()


def _end_if_full(error: Exception) -> None:
    """End the run where a full disk is behind an error."""
    cause: BaseException | None = error
    while cause is not None and getattr(cause, "errno", None) not in DISK_FULL:
        cause = cause.__cause__ or cause.__context__
    if isinstance(cause, OSError):
        raise _EndsRun from InputError(f"The disk of --out is full ({reason_of(cause)}). {RESUMES}")


def _digests(options: DepthOptions) -> dict[str, str]:
    """SHA-256 by path of the readable files that a pair is made from."""
    digests = {}
    for path in options.read_files():
        with suppress(OSError):  # its reader says why
            digests[str(path)] = file_digest(path)
    return digests


def finished_row(options: DepthOptions) -> Row | None:
    """The row of a pair that an earlier run has finished; ``None`` where it is still to be done.

    The report is written last and names every file, so a folder that holds all of them is whole.

    Args:
        options: of this pair alone.

    Raises:
        InputError: it was made with other options, or from files whose content has changed since.
    """
    assert options.out is not None
    try:
        report = json.loads((options.out / "report.json").read_text(encoding="utf-8"))
        names, made, _ = report["files"]["names"], report["arguments"], report["verdict"]
        whole = all((options.out / name).stat().st_size > 0 for name in names)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not whole:
        return None
    wanted, of_fields = options.as_json(), DepthOptions.__dataclass_fields__
    others = [n for n in wanted if n not in NOT_OF_THE_RESULT and wanted[n] != made.get(n, wanted[n])]
    if others:
        changes = ", ".join(f"{flag_of(of_fields[n])} {made[n]} instead of {wanted[n]}" for n in others)
        cure = "Name another --out, or add --overwrite."
        expected, got = "a folder of results of the same options", f"{options.out}, made with {changes}"
        bad_value("--out", expected, got, cure)
    digests = report.get("pair", {}).get("sha256", {})
    changed = [path for path, digest in _digests(options).items() if digests.get(path, digest) != digest]
    if changed:
        got = f"{options.out}, made before {' and '.join(changed)} changed"
        cure = "Name another --out, add --overwrite to repeat all pairs, or remove this folder to repeat one."
        bad_value("--out", "a folder of results of the same files", got, cure)
    return _row(report)


def _row(report: dict[str, Any]) -> Row:
    """What the table says of a pair, and why it is not to be trusted."""
    depth, verdict = report["depth"], report["verdict"]
    return {
        "near_m": depth["min_m"],
        "median_m": depth["median_m"],
        "far_m": depth["max_m"],
        "verdict": verdict["status"],
        "confidence": verdict["signs"]["confidence"] if verdict["status"] == "trusted" else None,
        "seconds": round(sum(report["seconds"].values()), 3),
        "message": " ".join(report["warnings"]) or None,
        "reasons": " ".join(verdict["reasons"]),
    }


def _refuse_one_length(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Refuse one distance for all pairs of a model, whose cameras are differently far from each other.

    Raises:
        InputError: ``--baseline`` with a calibration that has a pose for each image.
    """
    if options.baseline is None or len(refs) < 2:
        return
    for calib in dict.fromkeys(options_of(ref, options).calib for ref in refs):
        if calib and has_pose_per_image(calib if len(calib) > 1 else calib[0]):
            cure = (
                "Every pair of such a model has another distance. Give the model's scale: geodiff capture "
                "MODEL with --distance, --known-length or --metres-per-unit."
            )
            bad_value("--baseline", "left out with many pairs of one model", str(calib[0]), cure)


def _items(refs: Sequence[PairRef], out: Path, journal: Journal, there: Mapping[str, Row]) -> list[Item]:
    """An item a pair; what is there already, in folders of its own, has its record."""
    items = [Item(r.name, r, words=(str(r.left), str(r.right), str(out / r.name))) for r in refs]
    for item in items:
        if item.key in there and journal.get(item) is None:
            journal.put(item, there[item.key])
    return items


def run_many(options: DepthOptions, refs: Sequence[PairRef]) -> None:
    """Run the command on all pairs, answer on stdout, and leave with a code if one of them failed.

    Args:
        options: that ``start_many`` has seen.
        refs: the pairs, in order.

    Raises:
        InputError: ``--out`` has results of other options, or of files that have changed since: then nothing
            is computed, and nothing written; all pairs fail for one reason; the disk is full.
    """
    assert options.out is not None
    _refuse_one_length(options, refs)
    device, _ = pick_device(options.device), options.config()
    rows = {} if options.overwrite else {ref.name: finished_row(options_of(ref, options)) for ref in refs}
    there = {name: row for name, row in rows.items() if row is not None}

    def is_whole(item: Item, _: Row) -> bool:  # looked at again: another process may have finished it
        return not options.overwrite and finished_row(options_of(item.payload, options)) is not None

    journal = Journal(options.out / JOURNAL)
    items = _items(refs, options.out, journal, there)
    runner = Runner(
        items,
        journal,
        noun="pair",
        survives=(Exception,),
        whole=is_whole,
        progress=not options.quiet,
    )
    process = runner.process
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", process.local % torch.cuda.device_count())
    assumed = assumption(refs, options)
    if assumed and process.index == 0 and not options.quiet:
        say(assumed)
    stages = Stages(options if process.index == 0 else replace(options, quiet=True), refs, device)
    try:
        with collected_warnings(stages.tell):
            records = runner.run(
                stages.read, stages.evidence, stages.guide, stages.write, release=stages.release
            )
    except _EndsRun as ended:
        assert ended.__cause__ is not None
        raise ended.__cause__ from None
    except InputError:  # all of them, for one reason: no folder is left behind
        with suppress(OSError):
            journal.path.unlink()
            journal.path.parent.rmdir()
        raise
    finally:
        stages.close()
    answers = [_final(record, there.get(record["key"]), options) for record in records]
    if process.index == 0:
        _answer(answers, options)
    if any(row["result"] == "failed" for row in answers):
        sys.exit(EXIT_SOME_FAILED)


def _final(record: Row, there: Row | None, options: DepthOptions) -> Row:
    """A row of the table from a record of the journal, or from the report that an earlier run left.

    With ``--strict`` what is not trusted has failed.
    """
    record = record | (there or {})
    row = dict.fromkeys(COLUMNS) | {name: record[name] for name in COLUMNS if name in record}
    row |= {"pair": record["key"], "result": "there" if there else "done"}
    if record.get("status") == BROKEN:
        row |= {"result": "failed", "message": record["error"]}
    elif options.strict and record["verdict"] != "trusted":
        assert options.out is not None
        reason = f"The depth in {options.out / record['key']} is {record['verdict']}: {record['reasons']}"
        say(f"geodiff: {row['pair']}: {reason}")
        row = dict.fromkeys(COLUMNS) | {"pair": row["pair"], "result": "failed", "message": reason}
    return row


def _answer(rows: Sequence[Row], options: DepthOptions) -> None:
    """Print the table, or the rows as JSON, and write ``pairs.csv``."""
    assert options.out is not None
    if options.json:
        print(json.dumps(rows, indent=2))
    elif not options.quiet:
        _print(rows, options.out)
    path = options.out / SUMMARY
    try:
        with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:  # what became of the pairs is on the screen, and each result in its folder
        say(f"geodiff: {path} could not be written ({reason_of(error)}).")


def _print(rows: Sequence[Row], out: Path) -> None:
    """The table and what it comes to."""
    doubtful = [row for row in rows if row["verdict"] not in (None, "trusted")]
    shown = [r for r in rows if len(rows) <= MOST_ROWS or r["result"] == "failed" or r in doubtful]
    if shown:
        table = new_table(("pair", "result", "near m", "median m", "far m", "confidence", "s"))
        for row in shown:
            numbers = [row[name] for name in ("near_m", "median_m", "far_m", "confidence", "seconds")]
            result = row["verdict"] if row in doubtful else row["result"]
            table.add_row(row["pair"], result, *("-" if v is None else f"{v:.2f}" for v in numbers))
        show(table)
    done, there, failed = (sum(row["result"] == kind for row in rows) for kind in ("done", "there", "failed"))
    number = "1 pair" if len(rows) == 1 else f"{len(rows)} pairs"
    totals = f"{number}: {done} done, {there} there already, {failed} failed, {len(doubtful)} not trusted"
    show(Text(f"{totals} -> {out}/"))
    for row in shown:
        if row["result"] == "failed":
            show(Text(f"{row['pair']}: {row['message']}"))
