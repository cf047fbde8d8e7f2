"""A Hugging Face Space with the page of ``geodiff app``; it also runs as ``python examples/space/app.py``."""

from __future__ import annotations

import torch

from geodiff_plugin.app.launch import launch_page

#: A visitor of a CPU Space would wait minutes for the large one.
PRIORS = ("prs-eth/marigold-depth-v1-1", "bundled") if torch.cuda.is_available() else ("bundled",)

if __name__ == "__main__":
    launch_page(PRIORS)
