"""Two matchers for the rows of rectified pairs, OpenCV's and the sweep's aggregation, against ground truth.

    python -m tests.benchmarks.rows DATA

Data flow: rectified pairs with ground truth -> shifts of both, at the size of row matching -> a table of
    how many pixels each matches, and how many of these are wrong, with the CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.evaluation.datasets import StereoSample, find_pairs, load
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.matching import match_volume, sweep_planes
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.rows import RowImages, first_rectified_pair, grid_of_rows
from tests.tiny import rows_of

__all__ = ["Score", "compare", "main"]

#: Matches of the aggregation count from this confidence on, which is a probability.
SURE = 0.5
#: Wrong by more pixels than these.
WRONG_PX = (1.0, 2.0)


@dataclass(frozen=True)
class Score:
    """Accuracy of a matcher: fractions of pixels with ground truth, and of matched pixels; CPU seconds."""

    matched: float
    wrong: tuple[float, ...]  # of the matched ones, by ``WRONG_PX``
    seconds: float


def _on_grid(sample: StereoSample) -> tuple[PosedViews, np.ndarray]:
    """The views at the size at which rows are matched, and the true depth there, 0 where unknown."""
    guidance = GeometryGuidance(sample.right, (sample.K_left, sample.K_right), sample.E)
    native = guidance.inputs[0].posed_views(left_images(sample.left)[0])
    size = grid_of_rows(native.size)
    resized = PosedViews(native.left.resized(size), tuple(view.resized(size) for view in native.rights))
    depth_m = np.where(sample.valid, sample.depth_m, 0.0).astype(np.float32)
    depth_m = cv2.resize(depth_m, size[::-1], interpolation=cv2.INTER_NEAREST)
    return resized, depth_m


def _by_opencv(images: RowImages, views: PosedViews, nearest_px: float) -> tuple[Tensor, Tensor]:
    found = rows_of(images, nearest_px)
    return found.shift, found.matched > 0


def _by_aggregation(images: RowImages, views: PosedViews, nearest_px: float) -> tuple[Tensor, Tensor]:
    """Planes a pixel apart, from infinity to the nearest."""
    per_px = 1.0 / images.shift_px(1.0)
    planes = torch.arange(int(nearest_px) + 5, dtype=torch.float32) * per_px
    pair = views.left, views.rights[0]
    left, right = (view._replace(image_01=grey(view.image_01[None])[0]) for view in pair)
    matches = match_volume(sweep_planes(PosedViews(left, (right,)), planes))
    return matches.inverse_depth[0] / per_px, matches.confidence[0] > SURE


#: Name -> matcher: shifts ``(H, W)`` in pixels, and where they are known.
MATCHERS: dict[str, Callable[[RowImages, PosedViews, float], tuple[Tensor, Tensor]]] = {
    "OpenCV": _by_opencv,
    "aggregation": _by_aggregation,
}


def compare(sample: StereoSample) -> dict[str, Score]:
    """The scores of both matchers on a rectified pair with ground truth."""
    views, depth_m = _on_grid(sample)
    images = first_rectified_pair(views)
    assert images is not None
    known = depth_m > 0
    true_px = np.where(known, images.shift_px(1.0) / np.where(known, depth_m, 1.0), 0.0)
    scores = {}
    for name, matcher in MATCHERS.items():
        started = time.process_time()
        shift, matched = (each.numpy() for each in matcher(images, views, float(true_px.max())))
        seconds = time.process_time() - started
        off = np.abs(shift - true_px)[matched & known]
        wrong = tuple(float((off > most).mean()) for most in WRONG_PX)
        scores[name] = Score(float(matched[known].mean()), wrong, seconds)
    return scores


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, help="folder of data sets, as for geodiff eval")
    typed = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    head = ("pair", "matcher", "matched", *(f"wrong by > {px:g} px" for px in WRONG_PX), "CPU s")
    table, every = new_table(head), dict[str, list[Score]]()
    for ref in find_pairs(typed.data):
        sample = load(ref)
        if not sample.rectified or sample.left.shape != sample.right.shape:
            continue
        for name, score in compare(sample).items():
            every.setdefault(name, []).append(score)
            cells = (score.matched, *score.wrong, score.seconds)
            table.add_row(sample.label, name, *(f"{cell:.3f}" for cell in cells))
    for name, scores in every.items():
        means = np.mean([(score.matched, *score.wrong, score.seconds) for score in scores], axis=0)
        table.add_row(f"mean of {len(scores)}", name, *(f"{mean:.3f}" for mean in means))
    show(table)


if __name__ == "__main__":
    main()
