"""``geodiff info``: installed packages, devices and available priors."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill, wrap

import torch
from huggingface_hub import CacheNotFound, scan_cache_dir

from geodiff_plugin._checks import refuse
from geodiff_plugin._kernels import kernels_in_use
from geodiff_plugin.cli.terminal import print_lines
from geodiff_plugin.config import knob_lines
from geodiff_plugin.priors import PRIORS, PriorSource, find_prior, prior_of
from geodiff_plugin.priors.loading import no_bars
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime.machine import versions

#: Columns of a terminal as it opens.
SCREEN_WIDTH = 80
#: Those of a value, beside its name.
LINE_WIDTH = SCREEN_WIDTH - 18


def _describe(source: PriorSource, space: str | None) -> list[tuple[str, str]]:
    """What the adapter of a prior says, once its weights are read."""
    pipe = source.load(space=space)
    adapter = prior_of(pipe)
    parts = [part for part in pipe.components.values() if isinstance(part, torch.nn.Module)]
    parameters = sum(weight.numel() for part in parts for weight in part.parameters())
    most = "" if adapter.max_steps is None else f", at most {adapter.max_steps}"
    options = pipe.call_options() if isinstance(pipe, DepthDiffusionPipeline) else []
    side = pipe.image_processor.config.vae_scale_factor
    return [
        ("prior", source.layout.name),
        ("adapter", source.key),
        ("licence", source.licence),
        ("pipeline", type(pipe).__name__),
        ("scheduler", type(pipe.scheduler).__name__),
        ("parameters", f"{parameters / 1e6:.1f} M"),
        ("space", adapter.space),
        ("steps", f"{pipe.default_denoising_steps} by default{most}"),
        ("same every time", "yes, ensembles run one member" if adapter.deterministic else "no"),
        ("gradients", "denoised" if adapter.network_input is None else "denoised, full"),
        ("longer side", f"{pipe.default_processing_resolution} pixels by default"),
        ("grid", f"sides are multiples of {side} pixels"),
        ("options", ", ".join(options) or "none"),
    ]


def _cached_models() -> list[str]:
    """Models that the hub's cache holds, with their sizes."""
    try:
        models = [repo for repo in scan_cache_dir().repos if repo.repo_type == "model"]
    except CacheNotFound:
        return []
    return sorted(f"{repo.repo_id} ({repo.size_on_disk / 1e6:.1f} MB)" for repo in models)


def run_info(prior: str | None, space: str | None, knobs: bool) -> None:
    """Print it, with what a prior is, or the knobs instead."""
    if knobs:
        for line in knob_lines():
            print(fill(line, SCREEN_WIDTH, subsequent_indent=" " * 6))
        return
    if space is not None and prior is None:
        refuse("--space needs --prior: it describes that prior.")
    described = []
    if prior is not None:
        with no_bars():
            described = _describe(find_prior(prior), space)
    rows = [*versions().items(), ("device", f"cpu (threads: {torch.get_num_threads()})")]
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        rows.append(("device", f"cuda:{index} ({device.name}, {device.total_memory / 2**30:.0f} GiB)"))
    rows += [("device", "mps")] if torch.backends.mps.is_available() else []
    rows.append(("kernels", kernels_in_use()))
    first, *others = wrap(", ".join(PRIORS), LINE_WIDTH)
    rows += [("adapters", first), *(("", line) for line in others)]
    rows += [("cached", line) for line in _cached_models() or ["nothing"]]
    print_lines([*rows, ("package", str(Path(__file__).resolve().parents[1])), *described])
