"""Processes one pair: reads it, runs the prior with guidance (Algorithm 1), writes its folder."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import torch

from geodiff_plugin._internal.checks import warn
from geodiff_plugin.findings import Severity
from geodiff_plugin.formats import OutFolder
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import DepthOptions, start_pair, with_folder
from geodiff_plugin.jobs.prior import prior_of_options
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.records import JobLog, PairInputs, PairResult, PairRun, ReadPair
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
    """Run a prior on the inputs of a pair, guided by its second view.

    Args:
        pipe: pipeline from ``load_guided_prior``.
        options: steps, ensemble, seed and the rest of the call.
        inputs: inputs from ``read_pair`` with the same options.
        log: records seconds and warnings; a new log by default.
        progress: whether to show a progress bar of the steps on stderr.
        **call: further arguments of the pipeline's call, which override the options.

    Raises:
        InputError: with ``options.strict``, the depth is not trusted.
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
            for finding in output.findings:
                if finding.severity in (Severity.REMARK, Severity.WARNING):  # reasons were reported together
                    warn(finding)
    finally:
        pipe.set_progress_bar_config(disable=True)
    output.history = [step.cpu() for step in output.history]  # a run may be sent to another process
    return PairRun(options, inputs, output, _description(pipe, options), log)


def _description(pipe: Any, options: DepthOptions) -> dict[str, str]:
    """Describe the prior: name and class of the pipeline, scheduler, device and dtype."""
    return {
        "name": options.prior,
        "pipeline": type(pipe).__name__,
        "scheduler": type(pipe.scheduler).__name__,
        "device": str(pipe._execution_device),
        "dtype": options.dtype,
    }


def run_read_pair(pipe: Any, pair: ReadPair) -> PairRun:
    """Call ``run_pair`` for one of many pairs."""
    return replace(run_pair(pipe, pair.options, pair.inputs, pair.log), origin=pair.origin)


def depth_pair(
    options: DepthOptions,
    pipe: Any = None,
    *,
    folder: OutFolder | None = None,
    log: JobLog | None = None,
    notify: Notify = silent,
    progress: bool = False,
) -> PairResult:
    """Implement ``geodiff depth`` for one pair: read it, run the prior, write the folder.

    Args:
        options: options of the command; without ``out`` the folder is ``geodiff-out``, with a number if it
            exists.
        pipe: pipeline from ``load_guided_prior``; loaded according to the options by default.
        folder: the output folder, already held; created according to the options by default.
        log: records seconds and warnings; a new log by default.
        notify: receives messages for the user, such as assumptions.
        progress: whether to show a progress bar of the steps on stderr.

    Raises:
        InputError: invalid options or files.
    """
    log = log or JobLog()
    if folder is None:
        options = with_folder(options, "geodiff-out")
        with start_pair(options) as held:
            return depth_pair(options, pipe, folder=held, log=log, notify=notify, progress=progress)
    device = pick_device(options.device)
    with log.stage("calibration"):
        inputs = read_pair(options)
    for finding in inputs.guidance.findings:
        if finding.severity is Severity.ASSUMPTION:
            notify(f"assumed: {finding}")
    if pipe is None:
        with log.stage("load"):
            pipe = prior_of_options(options, device, None if notify is silent else notify)
    return write_pair(folder, run_pair(pipe, options, inputs, log, progress=progress))
