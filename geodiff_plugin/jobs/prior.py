"""The prior of a job, by the name that ``--prior`` takes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin._compilation import compile_kernels
from geodiff_plugin._kernels import without_kernels
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.options import SpeedOptions
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.loading import no_bars
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance


def load_guided_prior(
    name: str,
    device: torch.device,
    space: str | None = None,
    dtype: str = "float32",
    options: Sequence[str] = (),
    tell: Tell | None = None,
) -> Any:
    """A prior with guidance enabled, and with no progress bars but that of a download.

    Arguments and errors as ``load_quiet_prior``.
    """
    return enable_geometry_guidance(load_quiet_prior(name, device, space, dtype, options, tell))


def load_quiet_prior(
    name: str,
    device: torch.device,
    space: str | None = None,
    dtype: str = "float32",
    options: Sequence[str] = (),
    tell: Tell | None = None,
) -> Any:
    """A prior with no progress bars but that of a download, and as yet without guidance.

    Args:
        name: as ``--prior`` takes it: ``"bundled"``, a hub id or a folder.
        device: where it runs.
        space: of its map, in place of what its folder says.
        dtype: of its weights: ``"float32"``, ``"float16"`` or ``"bfloat16"``.
        options: ``NAME=VALUE`` of its call, of which the names are checked.
        tell: takes a line with the prior and its licence; without it a download shows no bar either.

    Raises:
        InputError: no such prior, or an option that it does not take.
    """
    on_disk = name == "bundled" or os.path.isdir(name) or os.path.isdir(name.partition(":")[2])
    with no_bars() if on_disk or tell is None else nullcontext():
        prior = find_prior(name)
    if tell is not None:
        tell(f"prior: {name} ({prior.key}; {prior.licence})")
    with no_bars():
        pipe = prior.load(device, getattr(torch, dtype), space)
    taken = pipe.call_options() if isinstance(pipe, DepthDiffusionPipeline) else []
    for entry in options:
        if (option := entry.partition("=")[0]) not in taken:
            expected = f"one that {prior.key} takes ({', '.join(taken) or 'none'})"
            bad_value("--option", expected, repr(option))
    pipe.set_progress_bar_config(disable=True)
    return pipe


def graphs_for_many(options: SpeedOptions, device: torch.device) -> bool:
    """Whether a job of many pictures records its networks: they mostly have one size, for which that pays."""
    return options.graphs or device.type == "cuda"


def compile_for(options: SpeedOptions, device: torch.device, tell: Tell | None = None) -> None:
    """Compile the kernels of a job's first picture, where Triton has not yet, and tell a line before."""
    with without_kernels(options.no_kernels):
        compile_kernels(device, tell or silent)


def prior_of_options(options: DepthOptions, device: torch.device, tell: Tell | None = None) -> Any:
    """``load_guided_prior`` as the options say."""
    pipe = load_quiet_prior(options.prior, device, options.space, options.dtype, options.option, tell)
    compile_for(options, device, tell)
    return enable_geometry_guidance(pipe, graphs=options.graphs, kernels=not options.no_kernels)
