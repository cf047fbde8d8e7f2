"""Averages the weights of two runs: ``python -m examples.training.blend --help``.

Data flow: two prior folders with the same autoencoder -> one whose U-Net interpolates between theirs.
Paper: none; the weights of a run and its continuation are averaged as in "Model soups" (arXiv 2203.05482).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from diffusers import MarigoldDepthPipeline

from examples.training.models import save_prior
from geodiff_plugin._internal.checks import bad_value, check_number
from geodiff_plugin.bundled import open_pipeline

__all__ = ["blend", "main"]


@torch.no_grad()
def blend(first: Path, second: Path, fraction: float) -> MarigoldDepthPipeline:
    """Return the second pipeline with the U-Net ``(1 - fraction) * first + fraction * second``.

    Args:
        first: prior folder.
        second: prior folder trained from the first, or from the same weights as the first.
        fraction: weight of the second, in [0, 1].

    Returns:
        A new pipeline on the CPU, float32, with the second's options.

    Raises:
        ValueError: ``fraction`` is out of range, or the autoencoders (and so the latents) differ.
    """
    check_number(fraction, "fraction", 0, 1)
    start, end = open_pipeline(first), open_pipeline(second)
    codes = start.vae.state_dict()
    if any(not torch.equal(value, codes[name]) for name, value in end.vae.state_dict().items()):
        bad_value("second", f"a prior with the autoencoder of {first}", second, "Train it with --init-from.")
    weights = start.unet.state_dict()
    for name, value in end.unet.state_dict().items():
        value.copy_(torch.lerp(weights[name], value, fraction))
    return end


def main(argv: list[str] | None = None) -> None:
    """Command line; see ``--help``."""
    parser = argparse.ArgumentParser(prog="python -m examples.training.blend", description=__doc__)
    parser.add_argument("first", type=Path, help="prior folder")
    parser.add_argument("second", type=Path, help="prior folder trained from the first")
    parser.add_argument("--fraction", type=float, default=0.5, help="weight of the second, 0 to 1")
    parser.add_argument("--out", type=Path, required=True, help="prior folder to write")
    options = parser.parse_args(argv)
    save_prior(blend(options.first, options.second, options.fraction), options.out)


if __name__ == "__main__":
    main()
