"""``geodiff depth`` on one pair: two images and their cameras to a folder of metric depth (Algorithm 1)."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, noted, warn
from geodiff_plugin.bundled import no_bars
from geodiff_plugin.cli import outputs
from geodiff_plugin.cli.inputs import Inputs, read_inputs
from geodiff_plugin.cli.options import DepthOptions, told_apart
from geodiff_plugin.cli.terminal import StopWatch, collected_warnings, say
from geodiff_plugin.formats.out import REPORT, OutFolder
from geodiff_plugin.formats.sfm import check_colmap_names
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.types import MetricDepthOutput


def load_guided_prior(
    name: str,
    device: torch.device,
    space: str | None = None,
    dtype: str = "float32",
    options: Sequence[str] = (),
    quiet: bool = True,
) -> Any:
    """The prior of ``--prior``, with guidance enabled and no progress bars but that of a download.

    Which it is and its licence are said on stderr, unless ``quiet``; ``options`` are those of its call.
    """
    on_disk = name == "bundled" or os.path.isdir(name) or os.path.isdir(name.partition(":")[2])
    with no_bars() if on_disk or quiet else nullcontext():
        prior = find_prior(name)
        if not quiet:
            say(f"prior: {name} ({prior.key}; {prior.licence})")
        pipe = prior.load(device, getattr(torch, dtype), space)
    taken = pipe.call_options() if isinstance(pipe, DepthDiffusionPipeline) else []
    for entry in options:
        if (option := entry.partition("=")[0]) not in taken:
            expected = f"one that {prior.key} takes ({', '.join(taken) or 'none'})"
            bad_value("--option", expected, repr(option))
    pipe.set_progress_bar_config(disable=True)
    return enable_geometry_guidance(pipe)


@dataclass(eq=False)
class Job:
    """A pair on its way to its folder; ``entries`` of its report are those that only the caller knows."""

    options: DepthOptions
    folder: OutFolder
    watch: StopWatch = field(default_factory=StopWatch)
    entries: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    inputs: Inputs = field(init=False)
    output: MetricDepthOutput = field(init=False)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is inside, and note what it warns of."""
        with self.watch.stage(name), noted() as warned:
            yield
        self.warnings += [sentence for sentence in warned if sentence not in self.warnings]

    def read(self, frames: Sequence[np.ndarray] | None = None, names: tuple[str, str] | None = None) -> None:
        """Read the views and the cameras, and see that they fit; arguments as for ``read_inputs``."""
        with self.stage("calibration"):
            self.inputs = read_inputs(self.options, frames, names)
        # Before the work that it would lose.
        if "colmap" in self.options.export and not self.inputs.undistorted:
            check_colmap_names(told_apart(self.options.photographs().values()))

    def guide(self, pipe: Any, progress: bool, **further: Any) -> None:
        """Call the pipeline as the options and ``further`` say, if wanted with a progress bar on stderr."""
        options, inputs = self.options, self.inputs
        call = options.call() | {"generator": torch.Generator("cpu").manual_seed(options.seed)} | further
        if inputs.prior_map is not None:
            call["depth_map"] = inputs.prior_map
        pipe.set_progress_bar_config(disable=not progress, file=sys.stderr, leave=False)
        try:
            with self.stage("guided call"):
                self.output = pipe(inputs.left, guidance=inputs.guidance, strict=options.strict, **call)
                for sentence in self.output.warnings:
                    warn(sentence)
        finally:
            pipe.set_progress_bar_config(disable=True)

    def write(self, pipe: Any) -> dict[str, Any]:
        """Fill the folder: every map, what ``--export`` asks for, and last the report, which is returned."""
        options, inputs, output = self.options, self.inputs, self.output
        report = outputs.build_report(inputs, output, pipe, options, self.warnings) | self.entries

        def fill(folder: Path) -> None:
            with self.watch.stage("write"):
                report["files"] = outputs.write_maps(folder, output, inputs.left, options.min_confidence)
                if inputs.undistorted:
                    outputs.write_undistorted(folder, inputs.left)
                if options.export:
                    outputs.write_exports(folder, output, inputs, options)
            report["files"]["names"] = [*sorted(path.name for path in folder.iterdir()), REPORT]
            report["seconds"] = {stage: round(seconds, 3) for stage, seconds in self.watch.seconds.items()}
            (folder / REPORT).write_text(_text(report) + "\n", encoding="utf-8")

        self.folder.write(fill)
        return report


def _text(report: dict[str, Any]) -> str:
    return json.dumps(report, indent=2, allow_nan=False)


def estimate_and_write(
    options: DepthOptions, folder: OutFolder, watch: StopWatch
) -> tuple[Any, Job, dict[str, Any]]:
    """Run ``geodiff depth`` in the folder of ``start_pair``, without printing; pipeline, job and report."""
    job = Job(options, folder, watch)
    with collected_warnings():
        device = pick_device(options.device)
        job.read()
        for sentence in () if options.quiet else job.inputs.guidance.assumed:
            say(f"assumed: {sentence}")
        with watch.stage("load"):
            how = (options.space, options.dtype, options.option, options.quiet)
            pipe = load_guided_prior(options.prior, device, *how)
        job.guide(pipe, progress=not options.quiet)
        return pipe, job, job.write(pipe)


def run_depth(options: DepthOptions, folder: OutFolder, watch: StopWatch) -> None:
    """Run the command and answer on stdout: the summary, or the report with ``--json``."""
    _, _, report = estimate_and_write(options, folder, watch)
    if options.json:
        print(_text(report))
    elif not options.quiet:
        print(outputs.summary_line(report, f"{folder.path}/"))
