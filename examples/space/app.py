"""Hugging Face Space of the web app; also runs locally with ``python examples/space/app.py``."""

from __future__ import annotations

import os

try:
    import spaces  # ZeroGPU's package, which must be imported before torch
except ImportError:
    spaces = None
import torch

from geodiff_plugin.app.launch import launch_page

#: Hub id of the full-size prior, set by a variable of the Space. It would take minutes on a CPU Space.
FULL_SIZE = os.environ.get("GEODIFF_PRIOR", "prs-eth/marigold-depth-v1-1")
HAS_GPU = spaces is not None or torch.cuda.is_available()
PRIORS = (FULL_SIZE, "bundled") if HAS_GPU or "GEODIFF_PRIOR" in os.environ else ("bundled",)

if __name__ == "__main__":
    if spaces is not None:
        from geodiff_plugin.app import page

        page.run_job = spaces.GPU(duration=120)(page.run_job)
    launch_page(PRIORS, "cuda" if spaces is not None else "auto")
