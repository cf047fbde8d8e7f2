"""``geodiff info``: what is installed, where it can run, and which priors are at hand.

Hop: the machine -> lines of text.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from huggingface_hub import CacheNotFound, scan_cache_dir

from geodiff_plugin.commands.report import versions
from geodiff_plugin.priors import BUNDLED_FOLDER, PRIORS, find_adapter, load_prior

__all__ = ["run_info"]


def _megabytes(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.1f} MB"


def _devices() -> list[str]:
    lines = [f"cpu ({torch.get_num_threads()} threads)"]
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        lines.append(f"cuda:{index} ({properties.name}, {properties.total_memory / 2**30:.0f} GiB)")
    return lines + (["mps"] if torch.backends.mps.is_available() else [])


def _bundled() -> str:
    if not (BUNDLED_FOLDER / "model_index.json").is_file():
        return "missing from this installation"
    return _megabytes(sum(path.stat().st_size for path in BUNDLED_FOLDER.rglob("*") if path.is_file()))


def _cached() -> list[str]:
    """Pipelines and models in the hub cache, whatever they are; only those with an adapter can be guided."""
    try:
        repositories = scan_cache_dir().repos
    except CacheNotFound:
        return []
    models = sorted(
        (repo for repo in repositories if repo.repo_type == "model"), key=lambda repo: repo.repo_id
    )
    return [f"{repo.repo_id} ({_megabytes(repo.size_on_disk)})" for repo in models]


def _describe(pipe: Any, name: str) -> list[tuple[str, str]]:
    parameters = sum(
        weight.numel()
        for part in pipe.components.values()
        if isinstance(part, torch.nn.Module)
        for weight in part.parameters()
    )
    adapter = next(key for key, value in PRIORS.items() if value is find_adapter(pipe))
    rows = [
        ("prior", name),
        ("pipeline", type(pipe).__name__),
        ("adapter", adapter),
        ("scheduler", type(pipe.scheduler).__name__),
        ("parameters", f"{parameters / 1e6:.1f} M"),
    ]
    options = ("prediction_type", "default_denoising_steps", "default_processing_resolution")
    return rows + [(name, str(pipe.config.get(name))) for name in options]


def run_info(prior: str | None) -> None:
    """Print it.

    Args:
        prior: also load this one and tell what it is.

    Raises:
        ValueError, TypeError: that prior does not exist, is not cached, or has no adapter.
    """
    described = [] if prior is None else _describe(load_prior(prior), prior)
    rows = [*versions().items()]
    rows += [("device", line) for line in _devices()]
    rows += [("adapters", ", ".join(PRIORS)), ("bundled prior", _bundled())]
    rows += [("cached", line) for line in _cached() or ["nothing"]]
    rows += [("package", str(Path(__file__).resolve().parents[1])), *described]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value}")
