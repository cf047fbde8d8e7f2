"""One pair of many, through its stages: read, match, guide, write.

Data flow: ``PairRef`` -> ``Job`` -> four stages, each in a thread of its own
    -> files, and a row of the summary.
Paper: none.
"""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin._threads import WithinCores
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.checks import check_arguments
from geodiff_plugin.cli.depth import write_result
from geodiff_plugin.cli.estimate import StopWatch, guided_call
from geodiff_plugin.cli.exports import check_image_names
from geodiff_plugin.cli.inputs import Inputs, read_inputs
from geodiff_plugin.cli.many.digests import file_digests
from geodiff_plugin.cli.many.pairs import PairRef, arguments_of
from geodiff_plugin.cli.many.rigs import RigStore
from geodiff_plugin.cli.messages import in_options
from geodiff_plugin.cli.photographs import read_photographs
from geodiff_plugin.cli.report import build_report
from geodiff_plugin.cli.settings import Settings
from geodiff_plugin.cli.start import check_files, out_folder_of
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.formats.video import VideoReader, both_halves
from geodiff_plugin.guidance.evidence_store import EvidenceStore
from geodiff_plugin.runtime.guided_call import native_images
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["Job", "Reader", "Stages", "ThreadWarnings"]


@dataclass(eq=False)
class Job:
    """A pair and what is known of it so far; what a stage no longer needs, it lets go of.

    Attributes:
        ref: the pair.
        arguments: of ``geodiff depth`` for this pair alone.
        number: of the pair in the whole run, from 0.
        warnings: sentences about it.
        watch: its stages.
        out: its folder, held from before the work.
        digests: SHA-256 of its files, as they were when it was read.
        inputs: views and cameras.
        output: of the guided call.
        began_from: name of the pair whose result the call went on from, or ``None``.
        report: what ``report.json`` says.
        error: why it failed.
    """

    ref: PairRef
    arguments: DepthArguments
    number: int = 0
    warnings: list[str] = field(default_factory=list)
    watch: StopWatch = field(default_factory=StopWatch)
    out: OutFolder | None = None
    digests: dict[str, str] = field(default_factory=dict)
    inputs: Inputs | None = None
    output: MetricDepthOutput | None = None
    began_from: str | None = None
    report: dict[str, Any] | None = None
    error: str | None = None
    _held: ExitStack = field(default_factory=ExitStack)

    @classmethod
    def of(cls, ref: PairRef, arguments: DepthArguments, number: int = 0) -> Job:
        """The job of one pair of a run, the ``number``-th of all its pairs."""
        return cls(ref, arguments_of(ref, arguments), number)

    def hold(self) -> None:
        """Take the pair's folder, as a run of this pair alone would."""
        self.out = self._held.enter_context(out_folder_of(self.arguments))

    def let_go(self) -> None:
        """Give the folder and the memory back."""
        self._held.close()
        self.inputs = self.output = self.report = None


class ThreadWarnings:
    """Sentences of the pair that a thread is at; each is one of the pair's once."""

    def __init__(self) -> None:
        self._own = threading.local()

    def use(self, sentences: list[str]) -> None:
        """What this thread is warned of from now on belongs here."""
        self._own.sentences = sentences

    def __contains__(self, sentence: object) -> bool:
        return sentence in getattr(self._own, "sentences", ())

    def append(self, sentence: str) -> None:
        """Add a sentence to those of the pair that this thread is at."""
        self._own.__dict__.setdefault("sentences", []).append(sentence)


class Reader:
    """The first stage of every job, which needs no prior.

    Args:
        settings: what was understood of the options.
        warned: where the warnings of a thread go.
    """

    def __init__(self, settings: Settings, warned: ThreadWarnings) -> None:
        self._settings, self._warned = settings, warned
        self._rigs, self._videos, self._held = RigStore(), dict[Path, VideoReader](), ExitStack()

    def close(self) -> None:
        """Close the videos; to be called when the threads are done."""
        self._held.close()

    def read(self, job: Job) -> None:
        """Look at the files, take the folder, decode the views; nothing, if that was done before."""
        if job.inputs is not None:
            return
        self._warned.use(job.warnings)
        with job.watch.stage("calibration"):
            check_arguments(_checkable(job))
            check_files(job.arguments, videos=job.ref.frame is not None)
            job.hold()
            job.digests = file_digests(job.arguments)  # before: what changes later is another version
            if job.arguments.estimate_pose:
                inputs = read_photographs(job.arguments, self._settings)
            else:
                views = None if job.ref.frame is None else self._frames(job.ref, job.ref.frame)
                rig_of = partial(self._rigs.read, sentences=job.warnings)
                inputs = read_inputs(job.arguments, self._settings, views, rig_of)
            check_image_names(job.arguments, inputs)
        job.inputs = inputs

    def _frames(self, ref: PairRef, frame: int) -> Any:
        views = [self._video(path).read(frame) for path in (ref.left, ref.right) if path is not None]
        return both_halves(views[0], "LEFT") if ref.right is None else tuple(views)

    def _video(self, path: Path) -> VideoReader:
        if path not in self._videos:
            self._videos[path] = self._held.enter_context(VideoReader(path))
        return self._videos[path]


class Stages:
    """The four stages of every job.

    Args:
        pipe: of ``load_guided_prior``.
        settings: what was understood of the options.
        warned: where the warnings of a thread go.
        warm_start: go on from the pair before, where it has the same size.
        side_by_side: matching and guiding, which compute, run at the same time: they share the cores.
        reader: of pairs that are read before the prior is loaded; by default one of its own.
    """

    def __init__(
        self,
        pipe: Any,
        settings: Settings,
        warned: ThreadWarnings,
        warm_start: bool,
        side_by_side: bool = True,
        reader: Reader | None = None,
    ) -> None:
        self._pipe, self._settings, self._warned, self._warm_start = pipe, settings, warned, warm_start
        self._among = 2 if side_by_side else 1
        self._reader = Reader(settings, warned) if reader is None else reader
        self._before: tuple[Job, tuple[int, ...], MetricDepthOutput] | None = None

    def close(self) -> None:
        """Close the videos; to be called when the threads are done."""
        self._reader.close()

    def read(self, job: Job) -> None:
        """As ``Reader.read``."""
        self._reader.read(job)

    def evidence(self, job: Job) -> None:
        """What the views say by themselves, into a store of the pair's own, where the call finds it."""
        self._warned.use(job.warnings)
        assert job.inputs is not None
        device = self._pipe._execution_device
        with (
            job.watch.stage("evidence"),
            WithinCores(self._among),
            torch.no_grad(),
            torch.autocast(device.type, enabled=False),
        ):
            job.inputs.guidance.evidence_store = EvidenceStore(1, copies=False)
            job.inputs.guidance.prepare(native_images(job.inputs.left, device))

    def guide(self, job: Job) -> None:
        """The guided call, from the pair before where that is wanted."""
        self._warned.use(job.warnings)
        assert job.inputs is not None
        guidance, size, before = job.inputs.guidance, job.inputs.left.shape, self._before
        self._before = None  # whatever happens now: a sequence with a hole begins anew
        # A pair between that failed before this stage, or that was there already, has left no trace here.
        if before is not None and before[0].number == job.number - 1 and before[1] == size:
            job.began_from, guidance.previous = before[0].ref.name, before[2]
        with job.watch.stage("guided call"), WithinCores(self._among):
            further = {"output_latent": self._warm_start}
            quiet = replace(job.arguments, quiet=True)
            job.output = guided_call(self._pipe, job.inputs, quiet, self._settings, **further)
        guidance.evidence_store = guidance.previous = None
        if self._warm_start:
            self._before = job, size, _small(job.output)

    def write(self, job: Job) -> None:
        """The files, the report last."""
        self._warned.use(job.warnings)
        assert job.inputs is not None and job.output is not None and job.out is not None
        job.warnings += [w for w in map(in_options, job.output.warnings) if w not in job.warnings]
        report = build_report(job.inputs, job.output, self._pipe, job.arguments, self._settings, job.warnings)
        report["pair"] = {
            "name": job.ref.name,
            "frame": job.ref.frame,
            "began_from": job.began_from,
            "sha256": job.digests,
        }
        write_result(job.arguments, job.out, job.inputs, job.output, report, job.watch)
        job.report = report


def _checkable(job: Job) -> DepthArguments:
    """The arguments with a right view where one video has both."""
    if job.ref.frame is not None and job.ref.right is None:
        return replace(job.arguments, right=job.ref.left)
    return job.arguments


def _small(output: MetricDepthOutput) -> MetricDepthOutput:
    """What the next call needs of an output, without its maps."""
    needed = ("latent", "space", "scale", "shift", "global_scale", "rescaled")
    kept = {name: getattr(output, name) for name in needed}
    return MetricDepthOutput(prediction=output.prediction[:0], **kept)
