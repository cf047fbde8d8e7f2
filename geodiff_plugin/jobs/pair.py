"""One pair: read it, run the prior with its guidance (Algorithm 1), write its folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._checks import warn
from geodiff_plugin.formats.out import REPORT, OutFolder
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.options import DepthOptions, start_pair, with_folder
from geodiff_plugin.jobs.prior import prior_of_options
from geodiff_plugin.jobs.reading import PairInputs, read_pair
from geodiff_plugin.jobs.records import JobLog, PairResult, PairRun
from geodiff_plugin.jobs.report import build_report, report_text, single_map
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.jobs.writing import write_exports, write_into, write_maps, write_undistorted
from geodiff_plugin.runtime.machine import pick_device


def run_pair(
    pipe: Any,
    options: DepthOptions,
    inputs: PairInputs,
    log: JobLog | None = None,
    *,
    progress: bool = False,
    **call: Any,
) -> PairRun:
    """Run a prior on what was read of a pair, guided by its second view.

    Args:
        pipe: of ``load_guided_prior``.
        options: steps, ensemble, seed and the rest of the call.
        inputs: of ``read_pair`` with the same options.
        log: takes the seconds and warnings; a new one by default.
        progress: whether a bar on stderr shows the steps.
        **call: further arguments of the pipeline's call, before those of the options.

    Raises:
        InputError: ``options.strict``, and a depth that is not trusted.
    """
    log = log or JobLog()
    call = options.call() | {"generator": torch.Generator("cpu").manual_seed(options.seed)} | call
    if inputs.prior_map is not None:
        call["depth_map"] = inputs.prior_map
    pipe.set_progress_bar_config(disable=not progress, file=sys.stderr, leave=False)
    try:
        height, width = inputs.left.shape[:2]
        with log.stage("guided call"), fitting_memory("A pair", (width, height)):
            output = pipe(inputs.left, guidance=inputs.guidance, strict=options.strict, **call)
            for message in output.warnings:
                warn(message)
    finally:
        pipe.set_progress_bar_config(disable=True)
    prior = {
        "name": options.prior,
        "pipeline": type(pipe).__name__,
        "scheduler": type(pipe.scheduler).__name__,
        "device": str(pipe._execution_device),
        "dtype": options.dtype,
    }
    return PairRun(options, inputs, output, prior, log)


def write_pair(folder: OutFolder, run: PairRun, **entries: Any) -> PairResult:
    """Fill an output folder: every map, what ``--export`` asks for, and last the report.

    ``entries`` of the report are those that only the caller knows. The folder appears whole or not at all.
    """
    options, inputs, output = run.options, run.inputs, run.output
    height, width = inputs.left.shape[:2]
    with fitting_memory("The result", (width, height)):
        report = build_report(run) | entries

    def fill(place: Path) -> None:
        with run.log.stage("write"):
            report["files"] = write_maps(place, output, inputs.left, options.min_confidence)
            if inputs.undistorted:
                write_undistorted(place, inputs.left)
            if options.into is not None:
                depth_m = single_map(output.prediction * output.valid)
                K = np.asarray(output.K)[0].astype(np.float64)
                report["into"] = write_into(place, depth_m, K, options.into)
            if options.export:
                write_exports(place, output, inputs, options)
        report["files"]["names"] = [*sorted(path.name for path in place.iterdir()), REPORT]
        report["seconds"] = {stage: round(seconds, 3) for stage, seconds in run.log.seconds.items()}
        (place / REPORT).write_text(report_text(report) + "\n", encoding="utf-8")

    with fitting_memory("The result", (width, height)):
        folder.write(fill)
    return PairResult(run, folder.path, report)


def depth_pair(
    options: DepthOptions,
    pipe: Any = None,
    *,
    folder: OutFolder | None = None,
    log: JobLog | None = None,
    tell: Tell = silent,
    progress: bool = False,
) -> PairResult:
    """What ``geodiff depth`` does with one pair: read it, run the prior, write the folder.

    Args:
        options: of the command; without ``out`` the folder is ``geodiff-out``, with a number if taken.
        pipe: of ``load_guided_prior``; loaded as the options say if not given.
        folder: the output folder, already held; made by the options if not given.
        log: takes the seconds and warnings; a new one by default.
        tell: takes the lines for the user, such as what was assumed.
        progress: whether a bar on stderr shows the steps.

    Raises:
        InputError: options or files that cannot be used.
    """
    log = log or JobLog()
    if folder is None:
        options = with_folder(options, "geodiff-out")
        with start_pair(options) as held:
            return depth_pair(options, pipe, folder=held, log=log, tell=tell, progress=progress)
    device = pick_device(options.device)
    with log.stage("calibration"):
        inputs = read_pair(options)
    for line in (*inputs.notes, *(f"assumed: {sentence}" for sentence in inputs.guidance.assumed)):
        tell(line)
    if pipe is None:
        with log.stage("load"):
            pipe = prior_of_options(options, device, None if tell is silent else tell)
    return write_pair(folder, run_pair(pipe, options, inputs, log, progress=progress))
