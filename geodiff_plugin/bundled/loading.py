"""Loads the folder of the bundled prior, or of one trained like it, without progress bars."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from diffusers import MarigoldDepthPipeline
from diffusers.utils import logging as diffusers_logging
from transformers.utils import logging as transformers_logging

__all__ = ["no_bars", "open_pipeline"]


def open_pipeline(
    folder: str | Path, device: str | torch.device | None = None, dtype: torch.dtype = torch.float32
) -> MarigoldDepthPipeline:
    """Load a prior folder from disk, offline.

    Args:
        folder: a folder written by ``save_prior``.
        device: where the modules go; CPU for ``None``.
        dtype: of the weights; the file holds float16.

    Returns:
        A new stock pipeline without a progress bar.
    """
    with no_bars():
        pipeline = MarigoldDepthPipeline.from_pretrained(
            str(folder), dtype=dtype, local_files_only=True, trust_remote_code=False
        )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cpu" if device is None else device)


@contextmanager
def no_bars() -> Iterator[None]:
    """Switch off the progress bars of both hosts, for files this small, and put them back after."""
    shown = [log for log in (diffusers_logging, transformers_logging) if log.is_progress_bar_enabled()]
    for log in shown:
        log.disable_progress_bar()
    try:
        yield
    finally:
        for log in shown:
            log.enable_progress_bar()
