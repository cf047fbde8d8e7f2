"""One pair: read it, run the prior with its guidance (Algorithm 1), write its folder."""

from __future__ import annotations

import sys
from typing import Any

import torch

from geodiff_plugin._checks import warn
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.options import DepthOptions, start_pair, with_folder
from geodiff_plugin.jobs.prior import prior_of_options
from geodiff_plugin.jobs.reading import PairInputs, read_pair
from geodiff_plugin.jobs.records import JobLog, PairResult, PairRun
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.jobs.writing import write_pair
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
    output.history = [step.cpu() for step in output.history]  # a run may be sent to another process
    prior = {
        "name": options.prior,
        "pipeline": type(pipe).__name__,
        "scheduler": type(pipe.scheduler).__name__,
        "device": str(pipe._execution_device),
        "dtype": options.dtype,
    }
    return PairRun(options, inputs, output, prior, log)


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
