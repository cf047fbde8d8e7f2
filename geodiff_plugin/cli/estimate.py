"""The guided call of ``geodiff depth``: progress bar, seconds by stage.

Data flow: ``Inputs`` -> a prior -> ``MetricDepthOutput`` with the seconds of every stage.
Paper: Algorithm 1, run by the pipeline.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from diffusers.utils import logging as diffusers_logging
from transformers.utils import logging as transformers_logging

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.messages import say
from geodiff_plugin.cli.settings import Settings
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.pipelines.base import DepthDiffusionPipeline
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["StopWatch", "guided_call", "load_guided_prior", "loading_bars"]


class StopWatch:
    """Wall-clock seconds by stage, in the order of the stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is inside."""
        started = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - started


@contextmanager
def loading_bars(prior: str, quiet: bool = False) -> Iterator[None]:
    """Switch off the bars of diffusers and transformers, but for a download, which is worth one.

    Args:
        prior: as typed.
        quiet: switch them off for a download too.
    """
    on_disk = prior == "bundled" or os.path.isdir(prior) or os.path.isdir(prior.partition(":")[2])
    libraries = (diffusers_logging, transformers_logging) if on_disk or quiet else ()
    shown = [library for library in libraries if library.is_progress_bar_enabled()]
    for library in shown:
        library.disable_progress_bar()
    try:
        yield
    finally:
        for library in shown:
            library.enable_progress_bar()


def load_guided_prior(arguments: DepthArguments, settings: Settings) -> Any:
    """The prior of ``--prior``, with guidance enabled and its own progress bars off.

    Which it is and its licence are said on stderr, unless ``--quiet``.

    Raises:
        ValueError: no such prior, not cached, of no known kind; an option that it does not take.
    """
    typed = arguments.prior
    with loading_bars(typed, arguments.quiet):
        found = find_prior(typed)
        if not arguments.quiet:
            say(f"prior: {typed} ({found.key}; {found.licence})")
        pipe = found.load(settings.device, settings.dtype, arguments.space)
    taken = pipe.call_options() if isinstance(pipe, DepthDiffusionPipeline) else []
    for name in settings.options:
        if name not in taken:
            bad_value("--option", f"one that {found.key} takes ({', '.join(taken) or 'none'})", repr(name))
    pipe.set_progress_bar_config(disable=True)
    enable_geometry_guidance(pipe)
    return pipe


def guided_call(
    pipe: Any, inputs: Inputs, arguments: DepthArguments, settings: Settings, **further: Any
) -> MetricDepthOutput:
    """Call the pipeline as the options say; unless ``--quiet``, with the loss in a progress bar on stderr.

    Args:
        pipe: of ``load_guided_prior``.
        inputs: views and cameras.
        arguments: the options.
        settings: what was understood of them.
        **further: what else the call takes.

    Raises:
        InputError: what only both views together show, such as no overlap; with ``--strict`` a depth that is
            not to be trusted.
    """
    options = {
        **settings.options,
        "num_inference_steps": arguments.steps,
        "processing_resolution": arguments.resolution,
        "ensemble_size": arguments.ensemble,
        "output_uncertainty": arguments.ensemble > 1,
        "generator": torch.Generator("cpu").manual_seed(arguments.seed),
        **further,
    }
    pipe.set_progress_bar_config(disable=arguments.quiet, file=sys.stderr, leave=False)
    try:
        return pipe(inputs.left, guidance=inputs.guidance, strict=arguments.strict, **options)
    finally:
        pipe.set_progress_bar_config(disable=True)
