"""Prints how depth and confidence do on repeated patterns, with and without the search for them.

python -m tests.benchmarks.repetition --pairs 20 --size 448x336

Rendered rooms with a fence, bars, tiles, blinds or shelves and their exact depth, half of the pairs rectified
and half in a general pose. Without the search, every match is taken as it is.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

import tests.scenes.dataset  # noqa: F401  registers synthetic-repeated
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evidence import prepare
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from tests.scenes.layouts.repeated import PATTERNS

__all__ = ["Scores", "mean_scores", "score", "scores_of"]

#: Confidence of pixels that count as sure.
SURE = 0.9


@dataclass(frozen=True)
class Scores:
    """What a result is worth: of one pair, or the mean of several."""

    abs_rel: float  # mean relative error
    within: float  # fraction of pixels within ``RIGHT_WITHIN``
    sure: float  # fraction with a confidence of ``SURE`` or more
    sure_and_within: float  # fraction of all pixels that are both

    @property
    def kept(self) -> float:
        """Fraction of the sure pixels that are within ``RIGHT_WITHIN``."""
        return self.sure_and_within / self.sure if self.sure else float("nan")


def scores_of(depth_m: np.ndarray, confidence: np.ndarray, truth_m: np.ndarray) -> Scores:
    """Compare maps ``(H, W)``; the truth is 0 where it is unknown."""
    known = truth_m > 0
    error = np.abs(depth_m[known] / truth_m[known] - 1.0)
    right, sure = error < RIGHT_WITHIN, confidence[known] >= SURE
    return Scores(*(float(each.mean()) for each in (error, right, sure, right & sure)))


def mean_scores(pairs: Sequence[Scores]) -> Scores:
    """Mean of pairs, so that every pair weighs the same."""
    return Scores(**{name: float(np.mean([vars(each)[name] for each in pairs])) for name in vars(pairs[0])})


def score(pipe: Any, sample: Any) -> Scores:
    """Score a guided call with seed 0 on a pair with ground truth."""
    guidance = GeometryGuidance(sample.right, (sample.K_left, sample.K_right), sample.E)
    image, generator = Image.fromarray(sample.left), torch.Generator().manual_seed(0)
    out = pipe(image, guidance=guidance, generator=generator)
    maps = (np.asarray(each)[0, ..., 0] for each in (out.prediction, out.confidence))
    return scores_of(*maps, np.where(sample.valid, sample.depth_m, 0.0))


def _print(found: dict[str, list[tuple[Scores, Scores]]]) -> None:
    heads = ("AbsRel", "within 10 %", f"confidence >= {SURE}", "of these within 10 %")
    table = Table(
        "pattern", "pairs", *heads, title="without the search -> with it; every pair weighs the same"
    )
    for name, pairs in found.items():
        without, searched = (mean_scores(each) for each in zip(*pairs, strict=True))
        cells = ("abs_rel", "within", "sure", "kept")
        table.add_row(
            name,
            str(len(pairs)),
            *(f"{getattr(without, cell):.3f} -> {getattr(searched, cell):.3f}" for cell in cells),
        )
    Console(width=140).print(table)


def main() -> None:
    """Print a row for each pattern and kind of pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--size", default="448x336")
    arguments = parser.parse_args()
    pipe = enable_geometry_guidance(load_prior("bundled"))
    pipe.set_progress_bar_config(disable=True)
    found: dict[str, list[tuple[Scores, Scores]]] = {}
    for ref in tqdm(find_pairs(f"synthetic-repeated:{arguments.pairs}@{arguments.size}")):
        sample, seed = load(ref), ref.files["seed"]
        with patch.object(prepare, "with_repetition", lambda matches, volume: matches):
            without = score(pipe, sample)
        pair = without, score(pipe, sample)
        kind = "posed" if ref.files["posed"] else "rectified"
        for row in (list(PATTERNS)[seed // 2 % len(PATTERNS)], f"all {kind}", "all"):
            found.setdefault(row, []).append(pair)
    _print(dict(sorted(found.items(), key=lambda row: (row[0].startswith("all"), row[0]))))


if __name__ == "__main__":
    main()
