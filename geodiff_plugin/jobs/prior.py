"""Loads the prior of a job by the name in ``--prior``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import torch

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin._internal.compilation import compile_kernels
from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions
from geodiff_plugin.options import SpeedOptions
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.loading import no_bars
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.machine import pick_device


def load_guided_prior(
    name: str,
    device: torch.device,
    space: str | None = None,
    dtype: str = "float32",
    options: Sequence[str] = (),
    notify: Notify | None = None,
) -> Any:
    """Load a prior with guidance enabled; only downloads show progress bars.

    Arguments and errors are the same as in ``load_quiet_prior``.
    """
    return enable_geometry_guidance(load_quiet_prior(name, device, space, dtype, options, notify))


def load_quiet_prior(
    name: str,
    device: torch.device,
    space: str | None = None,
    dtype: str = "float32",
    options: Sequence[str] = (),
    notify: Notify | None = None,
) -> Any:
    """Load a prior without guidance; only downloads show progress bars.

    Args:
        name: ``--prior``: ``"bundled"``, a Hugging Face model ID or a folder.
        device: device of the prior.
        space: prediction space, overriding the prior's config.
        dtype: precision of its weights: ``"float32"``, ``"float16"`` or ``"bfloat16"``.
        options: ``NAME=VALUE`` arguments of its call; the names are checked.
        notify: receives a line with the prior and its licence; if omitted, downloads show no bar either.

    Raises:
        InputError: unknown prior, or an option that it does not take.
    """
    on_disk = name == "bundled" or os.path.isdir(name) or os.path.isdir(name.partition(":")[2])
    with no_bars() if on_disk or notify is None else nullcontext():
        prior = find_prior(name)
    if notify is not None:
        notify(f"prior: {name} ({prior.key}; {prior.licence})")
    with no_bars():
        pipe = prior.load(device, getattr(torch, dtype), space)
    taken = pipe.call_options() if isinstance(pipe, DepthDiffusionPipeline) else []
    for entry in options:
        if (option := entry.partition("=")[0]) not in taken:
            expected = f"an option of {prior.key} ({', '.join(taken) or 'none'})"
            bad_value("--option", expected, repr(option))
    pipe.set_progress_bar_config(disable=True)
    return pipe


def graphs_for_many(options: SpeedOptions, device: torch.device) -> bool:
    """Whether a job of many images records CUDA graphs; they pay off if most images have the same size."""
    return options.cuda_graphs or device.type == "cuda"


def compile_for(options: SpeedOptions, device: torch.device, notify: Notify | None = None) -> None:
    """Compile the kernels for a job's first image, if Triton has not yet, and report it before."""
    with without_kernels(options.no_triton):
        compile_kernels(device, notify or silent)


def prior_of_options(options: DepthOptions, device: torch.device, notify: Notify | None = None) -> Any:
    """Call ``load_guided_prior`` with the options."""
    pipe = load_quiet_prior(options.prior, device, options.space, options.dtype, options.option, notify)
    compile_for(options, device, notify)
    return enable_geometry_guidance(pipe, cuda_graphs=options.cuda_graphs, kernels=not options.no_triton)


def prior_of_capture(options: CaptureOptions) -> Any:
    """Load the prior of a capture with guidance enabled."""
    name = "map" if options.prior_map is not None else options.prior
    device = pick_device(options.device)
    pipe = load_quiet_prior(name, device, options.space, options.dtype)
    graphs = graphs_for_many(options, device)
    return enable_geometry_guidance(pipe, cuda_graphs=graphs, kernels=not options.no_triton)
