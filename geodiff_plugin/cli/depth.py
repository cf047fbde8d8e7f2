"""``geodiff depth`` on one pair: two images and their cameras to a folder of metric depth (Algorithm 1)."""

from __future__ import annotations

import json
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.bundled import no_bars
from geodiff_plugin.cli.exports import (
    check_image_names,
    make_scene,
    pick_viewer,
    show_scene,
    write_exports,
    write_maps,
    write_undistorted,
)
from geodiff_plugin.cli.inputs import Inputs, read_inputs
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.cli.report import build_report, summary_line
from geodiff_plugin.cli.terminal import StopWatch, collected_warnings, say
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.types import MetricDepthOutput


def load_guided_prior(options: DepthOptions, device: torch.device) -> Any:
    """The prior of ``--prior``, with guidance enabled and no progress bars but that of a download.

    Which it is and its licence are said on stderr, unless ``--quiet``.

    Raises:
        InputError: no such prior, not cached, of no known kind; an option that it does not take.
    """
    name = options.prior
    on_disk = name == "bundled" or os.path.isdir(name) or os.path.isdir(name.partition(":")[2])
    with no_bars() if on_disk or options.quiet else nullcontext():
        prior = find_prior(name)
        if not options.quiet:
            say(f"prior: {name} ({prior.key}; {prior.licence})")
        pipe = prior.load(device, getattr(torch, options.dtype), options.space)
    taken = pipe.call_options() if isinstance(pipe, DepthDiffusionPipeline) else []
    for entry in options.option:
        if (option := entry.partition("=")[0]) not in taken:
            expected = f"one that {prior.key} takes ({', '.join(taken) or 'none'})"
            bad_value("--option", expected, repr(option))
    pipe.set_progress_bar_config(disable=True)
    enable_geometry_guidance(pipe)
    return pipe


def guided_call(pipe: Any, inputs: Inputs, options: DepthOptions, **further: Any) -> MetricDepthOutput:
    """Call the pipeline as the options say; unless ``--quiet``, with the loss in a progress bar on stderr.

    Args:
        pipe: of ``load_guided_prior``.
        inputs: views and cameras.
        options: of this pair.
        **further: what else the call takes.

    Raises:
        InputError: what only both views together show, such as no overlap; with ``--strict`` a depth that is
            not to be trusted.
    """
    call = options.call() | {"generator": torch.Generator("cpu").manual_seed(options.seed)} | further
    if inputs.prior_map is not None:
        call["depth_map"] = inputs.prior_map
    pipe.set_progress_bar_config(disable=options.quiet, file=sys.stderr, leave=False)
    try:
        return pipe(inputs.left, guidance=inputs.guidance, strict=options.strict, **call)
    finally:
        pipe.set_progress_bar_config(disable=True)


def estimate_and_write(
    options: DepthOptions, out: OutFolder, watch: StopWatch
) -> tuple[Any, Inputs, MetricDepthOutput, dict[str, Any]]:
    """Everything of ``geodiff depth`` but its answer on stdout.

    Args:
        options: that ``start_pair`` has seen.
        out: the folder that it gave, held.
        watch: of the stages so far.

    Returns:
        The pipeline, the inputs, the output and the report.

    Raises:
        InputError: bad input; before any weights load where it can be seen that early.
    """
    warnings: list[str] = []

    def tell(sentence: str) -> None:
        if sentence not in warnings:
            warnings.append(sentence)
            say(f"warning: {sentence}")

    with collected_warnings(tell):
        device, config = pick_device(options.device), options.config()
        pick_viewer(options.show)
        with watch.stage("calibration"):
            inputs = read_inputs(options, config)
            check_image_names(options, inputs)
        for sentence in () if options.quiet else inputs.guidance.assumed:
            say(f"assumed: {sentence}")
        with watch.stage("load"):
            pipe = load_guided_prior(options, device)
        with watch.stage("guided call"):
            output = guided_call(pipe, inputs, options)
        for sentence in output.warnings:
            tell(sentence)
        report = build_report(inputs, output, pipe, options, warnings)
        write_result(options, out, inputs, output, report, watch)
    return pipe, inputs, output, report


def write_result(
    options: DepthOptions,
    out: OutFolder,
    inputs: Inputs,
    output: MetricDepthOutput,
    report: dict[str, Any],
    watch: StopWatch,
) -> None:
    """Fill the folder of a pair: every map, what ``--export`` asks for, and last the report.

    Files and seconds are added to ``report``.
    """

    def fill(folder: Path) -> None:
        with watch.stage("write"):
            report["files"] = write_maps(folder, output, inputs.left, options.min_confidence)
            if inputs.undistorted:
                write_undistorted(folder, inputs.left)
            if options.export:
                write_exports(folder, options.export, make_scene(output, inputs, options))
        report["files"]["names"] = [*sorted(path.name for path in folder.iterdir()), "report.json"]
        report["seconds"] = {stage: round(seconds, 3) for stage, seconds in watch.seconds.items()}
        (folder / "report.json").write_text(_text(report) + "\n", encoding="utf-8")

    out.write(fill)


def _text(report: dict[str, Any]) -> str:
    return json.dumps(report, indent=2, allow_nan=False)


def run_depth(options: DepthOptions, out: OutFolder, watch: StopWatch) -> None:
    """Run the command and answer on stdout: the summary, or the report with ``--json``.

    Args:
        options: that ``start_pair`` has seen.
        out: the folder that it gave, held.
        watch: of the stages so far.
    """
    _, inputs, output, report = estimate_and_write(options, out, watch)
    if options.json:
        print(_text(report))
    elif not options.quiet:
        print(summary_line(report, f"{out.path}/"))
    viewer = pick_viewer(options.show)
    if viewer is not None:
        show_scene(viewer, make_scene(output, inputs, options))
