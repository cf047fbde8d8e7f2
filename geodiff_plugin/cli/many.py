"""``geodiff depth`` on many pairs: one prior, four stages side by side, a folder and a table row a pair."""

from __future__ import annotations

import csv
import errno
import json
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.text import Text

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin._threads import WithinCores
from geodiff_plugin.capture.results import AGREED, ALONE, write_steady
from geodiff_plugin.cli.depth import Job, load_guided_prior
from geodiff_plugin.cli.inputs import read_inputs
from geodiff_plugin.cli.options import PARAMETERS, DepthOptions, start_pair
from geodiff_plugin.cli.outputs import read_report
from geodiff_plugin.cli.pairs import COLUMNS, SUMMARY, PairRef, options_of, start_many
from geodiff_plugin.cli.terminal import collected_warnings, new_table, say, show
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.evidence.prepare import EvidenceStore
from geodiff_plugin.formats import recordings
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import REPORT, atomic_path, check_new_file, reason_of, write_text
from geodiff_plugin.formats.reading import has_pose_per_image
from geodiff_plugin.options import flag_of
from geodiff_plugin.runner import BROKEN, Item, Journal, Runner
from geodiff_plugin.runtime.machine import pick_device

#: What became of every pair, as it is known to all processes of a run.
JOURNAL = ".pairs.jsonl"
#: A table of more pairs than this shows only failed and untrusted ones.
MOST_ROWS = 20
#: Options that a result does not depend on.
NOT_OF_THE_RESULT = {"out", "overwrite", "quiet", "json", "strict", "steady", "device", "encoding"}
#: With one of these causes the next pair cannot be written either.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
Row = dict[str, Any]


class _EndsRun(BaseException):
    """Ends the whole run: the prior does not load or the disk is full; its cause says which."""


@contextmanager
def _ends_run_on_full_disk() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and getattr(cause, "errno", None) not in DISK_FULL:
            cause = cause.__cause__ or cause.__context__
        if isinstance(cause, OSError):
            resumes = "Finished pairs stay; the same command goes on with the rest."
            full = InputError(f"The disk of --out is full ({reason_of(cause)}). {resumes}")
            raise _EndsRun from full
        raise


class Stages:
    """The stages of a pair, each called in a thread of its own.

    A ``pipe`` that is not given is loaded when the first pair has been read; ``among`` stages compute at the
    same time and share the cores.
    """

    def __init__(self, options: DepthOptions, device: torch.device, pipe: Any = None, among: int = 2) -> None:
        self._options, self._device, self._pipe, self._among = options, device, pipe, among
        self._videos, self._open = dict[Path, recordings.VideoReader | recordings.BagReader](), ExitStack()
        self._folders: dict[str, ExitStack] = {}

    def close(self) -> None:
        """Close the videos, when the threads are done."""
        self._open.close()

    def read(self, item: Item) -> Job:
        """Look at the files, take the folder, decode the views."""
        ref: PairRef = item.payload
        options = options_of(ref, self._options)
        folder = start_pair(options, photographs=ref.frame is None)
        held = self._folders[item.key] = ExitStack()
        with _ends_run_on_full_disk():
            job = Job(options, held.enter_context(folder))
        digests = _digests(options)  # before: what changes later is another version
        job.entries = {"pair": {"name": ref.name, "frame": ref.frame, "sha256": digests}}
        job.read(self.views(ref))
        return job

    def views(self, ref: PairRef) -> Sequence[np.ndarray] | None:
        """Left and right view of a pair of frames; ``None`` for one of files."""
        if (frame := ref.frame) is None:
            return None
        for path in {ref.left, ref.right or ref.left} - set(self._videos):
            bag = (self._options.bag_topics(), self._options.tolerance) if recordings.is_bag(path) else None
            reader: Any = recordings.VideoReader(path) if bag is None else recordings.BagReader(path, *bag)
            self._videos[path] = self._open.enter_context(reader)
        left = self._videos[ref.left].read(frame)
        if ref.right is None:
            return recordings.both_halves(left, "LEFT")
        return left, self._videos[ref.right].read(frame)

    def evidence(self, job: Job) -> Job:
        """What the views say by themselves, into a store of the pair's own, where the call finds it."""
        if self._pipe is None:
            options = self._options
            how = (options.space, options.dtype, options.option, options.quiet)
            try:
                self._pipe = load_guided_prior(options.prior, self._device, *how)
            except Exception as error:
                raise _EndsRun from error
        device, guidance = self._pipe._execution_device, job.inputs.guidance
        plain = torch.autocast(device.type, enabled=False)
        with job.stage("evidence"), WithinCores(self._among), torch.no_grad(), plain:
            guidance.evidence_store = EvidenceStore(1, copies=False)
            guidance.prepare(left_images(job.inputs.left).to(device))
        return job

    def guide(self, job: Job) -> Job:
        """The guided call."""
        with WithinCores(self._among):
            job.guide(self._pipe, progress=False)
        job.inputs.guidance.evidence_store = None
        return job

    def write(self, job: Job) -> Row:
        """The files, the report last, and the row of the table."""
        with _ends_run_on_full_disk():
            return _row(job.write(self._pipe))

    def release(self, item: Item) -> None:
        """Give back the folder of a pair."""
        self._folders.pop(item.key, ExitStack()).close()


def _digests(options: DepthOptions) -> dict[str, str]:
    """SHA-256 by path of the readable files that a pair is made from."""
    digests = {}
    for path in options.read_files():
        with suppress(OSError):  # its reader says why
            digests[str(path)] = file_digest(path)
    return digests


def finished_row(options: DepthOptions) -> Row | None:
    """The row of a pair that an earlier run has finished; ``None`` where it is still to be done.

    A result of other options, or of files whose content has changed since, is an error.
    """
    assert options.out is not None
    report = read_report(options.out)
    try:
        made, row = report["arguments"], _row(report)
        # The report is written last and names every file, so a folder that holds all of them is whole.
        if not all((options.out / name).stat().st_size > 0 for name in report["files"]["names"]):
            return None
    except (OSError, KeyError, TypeError):
        return None
    wanted, of_fields = options.as_json(), DepthOptions.__dataclass_fields__
    others = [n for n in wanted if n not in NOT_OF_THE_RESULT and wanted[n] != made.get(n, wanted[n])]
    changes = [f"made with {flag_of(of_fields[n])} {made[n]} instead of {wanted[n]}" for n in others]
    digests = report.get("pair", {}).get("sha256", {})
    changed = [path for path, digest in _digests(options).items() if digests.get(path, digest) != digest]
    changes += [f"made before {path} changed" for path in changed]
    if changes:
        cure = "Name another --out, add --overwrite to repeat all pairs, or remove this folder to repeat one."
        got = f"{options.out}, {', '.join(changes)}"
        bad_value("--out", "a folder of results of the same options and files", got, cure)
    return row


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
    """Refuse one baseline for all pairs of a model, because its pairs have different ones."""
    given = [] if options.baseline is None or len(refs) < 2 else [options_of(ref, options) for ref in refs]
    for calib in dict.fromkeys(each.calib for each in given if each.calib):
        if has_pose_per_image(calib if len(calib) > 1 else calib[0]):
            cure = "Every pair has its own. Give the model's scale: geodiff capture MODEL --known-length."
            bad_value("--baseline", "left out with many pairs of one model", str(calib[0]), cure)


def run_many(options: DepthOptions, refs: Sequence[PairRef]) -> bool:
    """Run the command on all pairs, and answer on stdout; whether one of them failed."""
    assert options.out is not None
    _refuse_one_length(options, refs)
    device, _ = pick_device(options.device), options.config()
    journal, there = Journal(options.out / JOURNAL), dict[str, Row]()
    items = [Item(r.name, r, words=(str(r.left), str(r.right), str(options.out / r.name))) for r in refs]
    for item in items:
        row = None if options.overwrite else finished_row(options_of(item.payload, options))
        if row is None:
            journal.forget(item)
            continue
        there[item.key] = row
        if journal.get(item) is None:
            journal.put(item, row)
    runner = Runner(items, journal, noun="pair", survives=(Exception,), progress=not options.quiet)
    process = runner.process
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", process.local % torch.cuda.device_count())
    stages = Stages(options if process.index == 0 else replace(options, quiet=True), device)
    steps = (stages.read, stages.evidence, stages.guide, stages.write)
    try:
        with collected_warnings(), _ends_run_on_full_disk():
            records = runner.run(*steps, release=stages.release)
    except _EndsRun as ended:
        assert ended.__cause__ is not None
        raise ended.__cause__ from None
    except InputError:  # all of them, for one reason: no folder is left behind
        with suppress(OSError):
            journal.close()  # Windows removes no open file
            journal.path.unlink()
            journal.path.parent.rmdir()
        raise
    finally:
        stages.close()
    answers = [_final(record, there.get(record["key"]), options) for record in records]
    if process.index == 0:
        _answer(answers, options, options.out)
        if options.steady:
            failed = {row["pair"] for row in answers if row["result"] == "failed"}
            with closing(Stages(options, device)) as stages:
                _make_steady(options, [ref for ref in refs if ref.name not in failed], stages)
    return any(row["result"] == "failed" for row in answers)


def _make_steady(options: DepthOptions, refs: Sequence[PairRef], stages: Stages) -> None:
    """Average the depth of every frame with its neighbours' where they agree, and note it in the reports."""
    assert options.out is not None
    folders = [options.out / ref.name for ref in refs]
    reports = [read_report(folder) for folder in folders]

    def note(i: int, files: Iterable[str], **entries: Any) -> None:
        """List the files, which a later run with --overwrite then replaces."""
        reports[i]["files"]["names"] = sorted({*reports[i]["files"]["names"], *files})
        write_text(folders[i] / REPORT, json.dumps(reports[i] | entries, indent=2) + "\n")

    def picture(i: int) -> np.ndarray:
        note(i, [f"{name}.npy" for name in ALONE])
        return read_inputs(options_of(refs[i], options), stages.views(refs[i])).left

    try:
        known = [(f, np.reshape(r["K"], (3, 3)), r["unit"]) for f, r in zip(folders, reports, strict=True)]
        with warnings.catch_warnings(action="ignore"):  # the run of the pair has warned
            scenes = write_steady(known, picture)
        for i, scene in enumerate(scenes):
            note(i, [f"{name}.npy" for name in AGREED], steady={"scene": scene})
    except OSError as error:
        raise InputError(f"--steady ended ({reason_of(error)}); the same command resumes.") from error
    begins = [ref.name for k, ref in enumerate(refs) if k and scenes[k] != scenes[k - 1]]
    if begins and not options.quiet:
        say(f"--steady: scenes begin at {', '.join(begins[:9])}; depth is not averaged across them.")


def _final(record: Row, there: Row | None, options: DepthOptions) -> Row:
    """A row of the table from a record of the journal, or from the report that an earlier run left."""
    record = record | (there or {})
    row = {name: record.get(name) for name in COLUMNS} | {"pair": record["key"]}
    if record.get("status") == BROKEN:
        return row | {"result": "failed", "message": record["error"]}
    if not options.strict or record["verdict"] == "trusted":
        return row | {"result": "there" if there else "done"}
    assert options.out is not None
    reason = f"The depth in {options.out / record['key']} is {record['verdict']}: {record['reasons']}"
    say(f"geodiff: {record['key']}: {reason}")  # --strict: it has failed
    return dict.fromkeys(COLUMNS) | {"pair": record["key"], "result": "failed", "message": reason}


def _answer(rows: Sequence[Row], options: DepthOptions, out: Path) -> None:
    """Print the table and what it comes to, or the rows as JSON, and write ``pairs.csv``."""
    doubtful = [row for row in rows if row["verdict"] not in (None, "trusted")]
    failed = [row for row in rows if row["result"] == "failed"]
    doubted = sum(row["verdict"] == "not trusted" for row in doubtful)
    if options.json:
        print(json.dumps(rows, indent=2))
    elif not options.quiet:
        table = new_table(("pair", "result", "near m", "median m", "far m", "confidence", "s"))
        for row in rows if len(rows) <= MOST_ROWS else [*failed, *doubtful]:
            numbers = [row[name] for name in ("near_m", "median_m", "far_m", "confidence", "seconds")]
            result = row["verdict"] if row in doubtful else row["result"]
            table.add_row(row["pair"], result, *("-" if v is None else f"{v:.2f}" for v in numbers))
        done, there = (sum(row["result"] == kind for row in rows) for kind in ("done", "there"))
        number = "1 pair" if len(rows) == 1 else f"{len(rows)} pairs"
        totals = f"{done} done, {there} there already, {len(failed)} failed, {doubted} not trusted"
        totals += f", {len(doubtful) - doubted} not judged" * (doubted < len(doubtful))
        messages = [Text(f"{row['pair']}: {row['message']}") for row in failed]
        show(table, Text(f"{number}: {totals} -> {out}/"), *messages)
    try:
        with atomic_path(out / SUMMARY) as path, open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    except OSError as error:  # what became of the pairs is on the screen, and each result in its folder
        say(f"geodiff: {out / SUMMARY} could not be written ({reason_of(error)}).")


def run_bag(options: DepthOptions) -> bool:
    """Depth of every pair of a bag as a bag, by way of the folder ``NAME-frames``; whether one failed."""
    out, topics = options.out or Path("depth.mcap"), options.bag_topics()
    if out.suffix not in recordings.BAG_SUFFIXES or out.is_dir():
        bad_value(
            "--out", f"a file that ends in {' or '.join(recordings.BAG_SUFFIXES)}, as LEFT is a bag", out
        )
    check_new_file(out, options.overwrite)
    pairs = recordings.list_pairs(options.left, topics, options.tolerance)
    frames = out.with_name(f"{out.stem}-frames")
    options, frame_id = _with_its_cameras(replace(options, out=frames), frames)
    refs = start_many(options)
    failed = run_many(options, refs)

    def results() -> Iterator[tuple[recordings.Stamp, np.ndarray, np.ndarray]]:
        for ref, (stamp, _) in zip(refs, pairs, strict=True):
            if report := read_report(frames / ref.name):
                depth_m = np.load(frames / ref.name / "depth.npy", allow_pickle=False)
                yield stamp, depth_m, np.reshape(report["K"], (3, 3))

    count = recordings.write_depth_bag(out, results(), frame_id, options.encoding)
    if not options.quiet:
        say(f"{out}: {count} depth images ({options.encoding}) of {len(pairs)} pairs")
    return failed


def _with_its_cameras(options: DepthOptions, folder: Path) -> tuple[DepthOptions, str]:
    """The calibration of a bag in files of a folder unless cameras are given, and its frame's name."""
    if options.calib or any(getattr(options, name) is not None for name in (*PARAMETERS, "k", "e")):
        return options, "left"
    texts, frame_id = recordings.stereo_calibration(options.left, options.bag_topics())
    files = tuple(folder / f"camera_info_{number}.yaml" for number in range(len(texts)))
    for file, text in zip(files, texts, strict=True):
        if not file.is_file() or file.read_text(encoding="utf-8") != text:  # else results were made by it
            write_text(file, text)
    return replace(options, calib=files), frame_id
