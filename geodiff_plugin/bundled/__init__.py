"""The small prior and the stereo pair that ship with the package, so that everything works offline."""

from __future__ import annotations

from pathlib import Path

import torch
from diffusers import MarigoldDepthPipeline

from geodiff_plugin.priors import BUNDLED_FOLDER
from geodiff_plugin.priors.loading import no_bars

__all__ = ["load_bundled_prior", "no_bars", "open_pipeline"]


def load_bundled_prior(
    device: str | torch.device | None = None, dtype: torch.dtype = torch.float32
) -> MarigoldDepthPipeline:
    """The small depth prior of this package, a new stock pipeline on every call; nothing is downloaded.

    ``device`` is the CPU for ``None``; ``OSError`` where the package was installed without its weights.
    """
    return open_pipeline(BUNDLED_FOLDER, device, dtype)


def open_pipeline(
    folder: str | Path, device: str | torch.device | None = None, dtype: torch.dtype = torch.float32
) -> MarigoldDepthPipeline:
    """Load a folder of the bundled prior, or of one trained like it, offline and without progress bars."""
    with no_bars():
        pipeline = MarigoldDepthPipeline.from_pretrained(
            str(folder), dtype=dtype, local_files_only=True, trust_remote_code=False
        )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cpu" if device is None else device)
