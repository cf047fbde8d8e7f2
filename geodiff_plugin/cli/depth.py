"""``geodiff depth``: two images and their cameras to a folder of metric depth.

Data flow: ``DepthArguments``, ``OutFolder`` held -> prior -> guided call -> files, report, one line.
Paper: Algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.estimate import StopWatch, guided_call, load_guided_prior
from geodiff_plugin.cli.exports import (
    Scene,
    check_exports,
    check_image_names,
    make_scene,
    show_scene,
    write_exports,
)
from geodiff_plugin.cli.inputs import Inputs, read_inputs
from geodiff_plugin.cli.messages import collected_warnings, in_options, say
from geodiff_plugin.cli.outputs import write_maps, write_report, write_undistorted
from geodiff_plugin.cli.photographs import read_photographs
from geodiff_plugin.cli.report import build_report, summary_line
from geodiff_plugin.cli.settings import Settings, read_settings
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["DepthRun", "estimate_and_write", "run_depth", "write_result"]


@dataclass(frozen=True)
class DepthRun:
    """What a run leaves in memory, for commands that go on with it.

    Attributes:
        inputs: views and cameras.
        output: of the guided call.
        pipe: the prior, guidance enabled.
        settings: device, dtype, range.
        report: as in ``report.json``.
        report_text: the same as JSON.
    """

    inputs: Inputs
    output: MetricDepthOutput
    pipe: Any
    settings: Settings
    report: dict[str, Any]
    report_text: str


def estimate_and_write(arguments: DepthArguments, out: OutFolder) -> DepthRun:
    """Everything of ``geodiff depth`` but its answer on stdout.

    Args:
        arguments: checked by ``start.start_run``.
        out: the folder that it gave, held.

    Raises:
        OSError, TypeError, ValueError: bad input; before any weights load where it can be seen that early.
    """
    watch = StopWatch()
    warnings: list[str] = []
    with collected_warnings(warnings):
        settings = read_settings(arguments)
        check_exports(arguments.export, arguments.show)
        with watch.stage("calibration"):
            read = read_photographs if arguments.estimate_pose else read_inputs
            inputs = read(arguments, settings)
            check_image_names(arguments, inputs)
        with watch.stage("load"):
            pipe = load_guided_prior(arguments, settings)
        with watch.stage("guided call"):
            output = guided_call(pipe, inputs, arguments, settings)
        for sentence in map(in_options, output.warnings):
            if sentence not in warnings:
                warnings.append(sentence)
                say(f"warning: {sentence}")
        report = build_report(inputs, output, pipe, arguments, settings, warnings)
        report_text = write_result(arguments, out, inputs, output, report, watch)
    return DepthRun(inputs, output, pipe, settings, report, report_text)


def write_result(
    arguments: DepthArguments,
    out: OutFolder,
    inputs: Inputs,
    output: MetricDepthOutput,
    report: dict[str, Any],
    watch: StopWatch,
) -> str:
    """Fill the folder: every map, what ``--export`` asks for, and the report.

    Args:
        arguments: of this pair.
        out: its folder, held.
        inputs: views and cameras.
        output: of the guided call.
        report: of ``build_report``; files and seconds are added to it.
        watch: of the stages so far.

    Returns:
        The report as JSON.
    """

    def fill(folder: Path) -> str:
        with watch.stage("write"):
            report["files"] = write_maps(folder, output, inputs.left, arguments.min_confidence)
            if inputs.undistorted:
                write_undistorted(folder, inputs.left)
            if arguments.export:
                write_exports(folder, arguments.export, _scene(output, inputs, arguments))
        report["files"]["names"] = [*sorted(path.name for path in folder.iterdir()), "report.json"]
        report["seconds"] = {stage: round(seconds, 3) for stage, seconds in watch.seconds.items()}
        return write_report(folder, report)

    return out.write(fill)


def _scene(output: MetricDepthOutput, inputs: Inputs, arguments: DepthArguments) -> Scene:
    return make_scene(output, inputs, arguments.photographs(), arguments.min_confidence)


def run_depth(arguments: DepthArguments, out: OutFolder) -> None:
    """Run the command and answer on stdout: the summary, or the report with ``--json``.

    Args:
        arguments: checked by ``start.start_run``.
        out: the folder that it gave, held.
    """
    run = estimate_and_write(arguments, out)
    if arguments.json:
        print(run.report_text)
    elif not arguments.quiet:
        print(summary_line(run.report, f"{out.path}/"))
    viewer = check_exports((), arguments.show)
    if viewer is not None:
        show_scene(viewer, _scene(run.output, run.inputs, arguments))
