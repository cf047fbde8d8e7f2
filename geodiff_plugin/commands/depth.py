"""``geodiff depth``: two images and their cameras to a folder of metric depth.

Hop: ``DepthArguments`` -> checks -> prior -> guided call -> files, report, one line.
Paper: Algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from geodiff_plugin.commands.arguments import DepthArguments, Settings, check_arguments
from geodiff_plugin.commands.estimate import StopWatch, guided_call, load_guided_prior
from geodiff_plugin.commands.inputs import Inputs, read_inputs
from geodiff_plugin.commands.outputs import OUTPUT_FILES, staged_folder, write_maps, write_report
from geodiff_plugin.commands.report import build_report, summary_line
from geodiff_plugin.commands.voice import collected_warnings, say
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["DepthRun", "estimate_and_write", "run_depth"]


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


def estimate_and_write(arguments: DepthArguments) -> DepthRun:
    """Everything of ``geodiff depth`` but its answer on stdout.

    Raises:
        OSError, TypeError, ValueError: bad input; before any weights load where it can be seen that early.
    """
    watch, warnings = StopWatch(), []
    with collected_warnings(warnings):
        settings = check_arguments(arguments)
        with watch.stage("calibration"):
            inputs = read_inputs(arguments, settings)
        with watch.stage("load"):
            pipe = load_guided_prior(arguments, settings)
        with watch.stage("guided call"):
            output = guided_call(pipe, inputs, arguments, settings)
        for sentence in output.warnings:
            if sentence not in warnings:
                warnings.append(sentence)
                say(f"warning: {sentence}")
        report = build_report(inputs, output, pipe, arguments, settings, warnings)
        with staged_folder(arguments.out) as folder:
            with watch.stage("write"):
                report["files"] = write_maps(folder, output, inputs.left, arguments.min_confidence)
            report["files"]["names"] = [name for name in OUTPUT_FILES if (folder / name).exists()] + [
                "report.json"
            ]
            report["seconds"] = {stage: round(seconds, 3) for stage, seconds in watch.seconds.items()}
            report_text = write_report(folder, report)
    return DepthRun(inputs, output, pipe, settings, report, report_text)


def run_depth(arguments: DepthArguments) -> None:
    """Run the command and answer on stdout: the summary, or the report with ``--json``."""
    run = estimate_and_write(arguments)
    if arguments.json:
        print(run.report_text)
    elif not arguments.quiet:
        print(summary_line(run.report, f"{arguments.out}/"))
