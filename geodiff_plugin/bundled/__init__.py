"""The small prior and the stereo pair that ship with the package.

Paper: S3.1 (the prior); this one is ours, so that everything works without a download.
"""

from __future__ import annotations

from pathlib import Path

import torch
from diffusers import MarigoldDepthPipeline

from geodiff_plugin.bundled.loading import open_pipeline

__all__ = ["PRIOR_FOLDER", "load_bundled_prior"]

PRIOR_FOLDER = Path(__file__).parent / "prior"
"""The pipeline folder in the package."""


def load_bundled_prior(
    device: str | torch.device | None = None, dtype: torch.dtype = torch.float32
) -> MarigoldDepthPipeline:
    """The small depth prior of this package, as a stock pipeline.

    Args:
        device: where it goes; the CPU for ``None``.
        dtype: of its weights; they are stored in float16.

    Returns:
        A new ``MarigoldDepthPipeline`` on every call; nothing is downloaded.

    Raises:
        OSError: the package was installed without its weights.
    """
    return open_pipeline(PRIOR_FOLDER, device, dtype)
