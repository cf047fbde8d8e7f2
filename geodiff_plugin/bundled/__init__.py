"""Contains the small prior and the stereo pairs that ship with the package, for offline use.

Belongs here: these files and their readers. To replace the prior, see examples/training.
Layer 8: imports ``priors``, ``formats`` and below; ``jobs``, ``app`` and ``cli`` import it.
"""

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
    """Load the package's small depth prior as a new stock pipeline; downloads nothing.

    ``device=None`` is the CPU. Raises ``OSError`` if the package was installed without its weights.
    """
    return open_pipeline(BUNDLED_FOLDER, device, dtype)


def open_pipeline(
    folder: str | Path, device: str | torch.device | None = None, dtype: torch.dtype = torch.float32
) -> MarigoldDepthPipeline:
    """Load a folder of the bundled prior, or one trained like it, offline and without progress bars."""
    with no_bars():
        pipeline = MarigoldDepthPipeline.from_pretrained(
            str(folder), dtype=dtype, local_files_only=True, trust_remote_code=False
        )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cpu" if device is None else device)
