"""Depth maps as the prior: five kinds, from exact to blurred, relative and metric, with holes.

Data flow: rendered pairs, their degraded ground truth -> AbsRel of the map with the best scale and shift, and
of the guided result -> table.

    python -m tests.benchmarks.maps --data synthetic:12
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.metrics import evaluate_depth, filled
from tests.lab.options import STRENGTHS
from tests.lab.strength import relative_map

__all__ = ["main", "measure"]

#: Side of the blocks of pixels that a map with holes lacks, one in three.
BLOCK = 40


class Kind(NamedTuple):
    """A kind of map: its space, and how it is made of a pair with dense ground truth."""

    title: str
    space: str
    make: Callable[[StereoSample], np.ndarray]


def _metric(sample: StereoSample, strength: str) -> np.ndarray:
    """Depth in metres with the error of a strength."""
    relative, ground_truth = (
        relative_map(sample, STRENGTHS[strength], "log"),
        filled(sample.depth_m, sample.valid),
    )
    low, high = np.quantile(np.log(ground_truth), (0.0, 1.0))
    return np.exp(low + relative * (high - low))


def _with_holes(depth_map: np.ndarray) -> np.ndarray:
    row, column = np.indices(depth_map.shape) // BLOCK
    return np.where((row + column) % 3 == 0, np.nan, depth_map)


KINDS = (
    Kind("metres, exact", "depth", lambda s: filled(s.depth_m, s.valid)),
    Kind("metres 30 % too long, 5 % wrong", "depth", lambda s: 1.3 * _metric(s, "5%")),
    Kind(
        "disparity up to scale and shift, 2 % wrong",
        "disparity",
        lambda s: relative_map(s, STRENGTHS["2%"], "disparity"),
    ),
    Kind("relative depth, blurred", "depth", lambda s: relative_map(s, STRENGTHS["blur"], "depth")),
    Kind(
        "relative depth, 10 % wrong, a third unknown",
        "depth",
        lambda s: _with_holes(relative_map(s, STRENGTHS["10%"], "depth")),
    ),
)


def _error_of_map(sample: StereoSample, kind: Kind, depth_map: np.ndarray) -> float:
    """AbsRel of the map where it is known, after the best-fit scale and shift in its space."""
    known = sample.valid & np.isfinite(depth_map)
    ground_truth = sample.depth_m[known]
    target = 1.0 / ground_truth if kind.space == "disparity" else ground_truth
    A = np.stack([depth_map[known], np.ones(known.sum())], 1)
    weight = 1.0 / target  # relative errors
    fit = A @ np.linalg.lstsq(A * weight[:, None], target * weight, rcond=None)[0]
    depth = 1.0 / np.clip(fit, 1e-3, None) if kind.space == "disparity" else fit
    return float(np.abs(depth / ground_truth - 1.0).mean())


def measure(samples: Sequence[StereoSample]) -> list[tuple[str, float, float, float, int]]:
    """Title, AbsRel of the map and of the guided result, median confidence and trusted results, by kind."""
    rows = []
    for kind in (None, *KINDS):
        prior = load_bundled_prior() if kind is None else load_prior("map", space=kind.space)
        pipe = enable_geometry_guidance(prior)
        pipe.set_progress_bar_config(disable=True)
        alone, errors, confidence, trusted = [], [], [], 0
        for sample in samples:
            guidance = GeometryGuidance(sample.right, (sample.K_left, sample.K_right), sample.E)
            call = {"generator": torch.Generator().manual_seed(0)}
            if kind is not None:
                call["depth_map"] = kind.make(sample)
                alone.append(_error_of_map(sample, kind, call["depth_map"]))
            out = pipe(sample.left, guidance=guidance, **call)
            depth = out.prediction[0, ..., 0]
            errors.append(evaluate_depth(depth, sample.depth_m, sample.valid, None)["abs_rel"])
            confidence.append(float(np.median(out.confidence)))
            trusted += out.verdict.trusted
        title = "none: the bundled prior" if kind is None else kind.title
        of_map = float(np.mean(alone)) if alone else float("nan")
        rows.append((title, of_map, float(np.mean(errors)), float(np.mean(confidence)), trusted))
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--data", default="synthetic:12", help="synthetic:N, or a folder with dense ground truth"
    )
    samples = [load(ref) for ref in find_pairs(parser.parse_args(arguments).data)]
    torch.set_num_threads(1)
    print("| map | AbsRel, fitted to the truth | guided | confidence | trusted |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for title, alone, error, sure, trusted in measure(samples):
        of_map = "-" if np.isnan(alone) else f"{alone:.4f}"
        print(f"| {title} | {of_map} | {error:.4f} | {sure:.2f} | {trusted} of {len(samples)} |")


if __name__ == "__main__":
    main()
