"""A Hugging Face Space with the page of ``geodiff app``; it also runs as ``python examples/space/app.py``."""

from __future__ import annotations

import os

try:
    import spaces  # of ZeroGPU: it must be imported before torch
except ImportError:
    spaces = None
import torch

from geodiff_plugin.app.launch import launch_page

#: A hub id, chosen by a variable of the Space. A visitor of a CPU Space would wait minutes for a large one.
FULL_SIZE = os.environ.get("GEODIFF_PRIOR", "prs-eth/marigold-depth-v1-1")
HAS_GPU = spaces is not None or torch.cuda.is_available()
PRIORS = (FULL_SIZE, "bundled") if HAS_GPU or "GEODIFF_PRIOR" in os.environ else ("bundled",)

if __name__ == "__main__":
    if spaces is not None:
        from geodiff_plugin.app import page

        page.run_job = spaces.GPU(duration=120)(page.run_job)
    launch_page(PRIORS, "cuda" if spaces is not None else "auto")
