"""Implement ``geodiff info``, which prints installed packages, devices and available priors.

Without ``--prior`` it imports no diffusers, which takes seconds.
"""

from __future__ import annotations

import ast
from pathlib import Path
from textwrap import fill, wrap

import torch
from huggingface_hub import CacheNotFound, scan_cache_dir

from geodiff_plugin._internal.checks import raise_input_error
from geodiff_plugin._internal.kernels import kernels_in_use
from geodiff_plugin.cli.terminal import print_lines
from geodiff_plugin.runtime.machine import versions

PACKAGE = Path(__file__).resolve().parents[1]

#: Default width of a terminal in characters.
SCREEN_WIDTH = 80
#: Width of the value column in characters.
LINE_WIDTH = SCREEN_WIDTH - 18


def _adapters() -> list[str]:
    """Return the keys of ``priors.PRIORS``, read from its source."""
    tree = ast.parse((PACKAGE / "priors" / "__init__.py").read_text(encoding="utf-8"))
    tables = (node.value for node in tree.body if isinstance(node, ast.AnnAssign))
    (table,) = (value for value in tables if isinstance(value, ast.Dict))
    return [str(ast.literal_eval(key)) for key in table.keys if key is not None]


def _describe(prior: str, space: str | None) -> list[tuple[str, str]]:
    """Load a prior and describe it with its adapter's properties."""
    from geodiff_plugin.priors import find_prior, prior_of
    from geodiff_plugin.priors.loading import no_bars
    from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline

    with no_bars():
        source = find_prior(prior)
        pipe = source.load(space=space)
    adapter = prior_of(pipe)
    parts = [part for part in pipe.components.values() if isinstance(part, torch.nn.Module)]
    parameters = sum(weight.numel() for part in parts for weight in part.parameters())
    limit = "" if adapter.max_steps is None else f", at most {adapter.max_steps}"
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
        ("steps", f"{pipe.default_denoising_steps} by default{limit}"),
        ("deterministic", "yes, ensembles run one member" if adapter.deterministic else "no"),
        ("gradients", "denoised" if adapter.network_input is None else "denoised, full"),
        ("longer side", f"{pipe.default_processing_resolution} pixels by default"),
        ("grid", f"sides are multiples of {side} pixels"),
        ("options", ", ".join(options) or "none"),
    ]


def _cached_models() -> list[str]:
    """Return the models in the hub's cache with their sizes."""
    try:
        models = [repo for repo in scan_cache_dir().repos if repo.repo_type == "model"]
    except CacheNotFound:
        return []
    return sorted(f"{repo.repo_id} ({repo.size_on_disk / 1e6:.1f} MB)" for repo in models)


def run_info(prior: str | None, space: str | None, parameters: bool) -> None:
    """Print versions, devices and priors, or the guidance parameters instead."""
    if parameters:
        from geodiff_plugin.config import parameter_lines

        for line in parameter_lines():
            print(fill(line, SCREEN_WIDTH, subsequent_indent=" " * 6))
        return
    if space is not None and prior is None:
        raise_input_error("--space needs --prior: it applies to that prior.")
    described = [] if prior is None else _describe(prior, space)
    rows = [*versions().items(), ("device", f"cpu (threads: {torch.get_num_threads()})")]
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        rows.append(("device", f"cuda:{index} ({device.name}, {device.total_memory / 2**30:.0f} GiB)"))
    rows += [("device", "mps")] if torch.backends.mps.is_available() else []
    rows.append(("kernels", kernels_in_use()))
    first, *others = wrap(", ".join(_adapters()), LINE_WIDTH)
    rows += [("adapters", first), *(("", line) for line in others)]
    rows += [("cached", line) for line in _cached_models() or ["nothing"]]
    print_lines([*rows, ("package", str(PACKAGE)), *described])
