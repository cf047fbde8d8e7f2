"""Depth maps, error maps and point clouds of several methods side by side.

Data flow: samples + methods -> predictions -> figure.
Paper: Figure 6 (fig:ab1), the qualitative figures (fig:qualitative, fig:exp-two-view).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.evaluation.figures.base import Drawing, FigureOptions, MethodDepth, depths_of, samples
from geodiff_plugin.evaluation.figures.canvas import (
    depth_bar,
    error_bar,
    new_figure,
    show_depth,
    show_error,
    show_image,
)
from geodiff_plugin.evaluation.figures.clouds import orbit, render_cloud
from geodiff_plugin.plotting import depth_range

__all__ = ["ABLATION_METHODS", "QUALITATIVE_METHODS", "draw_ablation", "draw_qualitative"]

ABLATION_METHODS = ("prior-aligned", "reprojection-only", "guided")
QUALITATIVE_METHODS = ("prior-aligned", "paper", "sweep-sgm", "guided")
CELL_IN = 1.75


def _title(answer: MethodDepth) -> str:
    return answer.title if answer.abs_rel is None else f"{answer.title}\nAbsRel {answer.abs_rel:.3f}"


def _cloud_row(axes: Sequence[Any], sample: StereoSample, maps: Sequence[np.ndarray | None]) -> None:
    view = orbit(float(np.median(sample.depth_m[sample.valid])))
    for cell, depth_m in zip(axes, maps, strict=True):
        if depth_m is None:
            cell.axis("off")
        else:
            show_image(cell, render_cloud(depth_m, sample.left, sample.K_left, view))


def _rows(figure: Any, axes: Any, sample: StereoSample, answers: Sequence[MethodDepth], clouds: bool) -> None:
    """The two or three rows of one sample: depth under the left image, errors under the truth, clouds."""
    truth = np.where(sample.valid, sample.depth_m, np.nan)
    near, far = depth_range(truth, sample.valid)
    show_image(axes[0, 0], sample.left, f"left image\n{sample.name}")
    depth = show_depth(axes[1, 0], truth, near, far, "truth")
    error = None
    for column, answer in enumerate(answers, 1):
        if answer.depth_m is None:
            show_image(axes[0, column], np.full((*truth.shape, 3), 255, np.uint8), _title(answer))
            axes[1, column].axis("off")
            continue
        show_depth(axes[0, column], answer.depth_m, near, far, _title(answer))
        error = show_error(axes[1, column], answer.depth_m, sample.depth_m, sample.valid)
    depth_bar(figure, depth, axes[0], near, far)
    if error is not None:
        error_bar(figure, error, axes[1])
    if clouds:
        _cloud_row(axes[2], sample, [truth, *(answer.depth_m for answer in answers)])
        axes[2, 0].set_ylabel("from the left, above", fontsize=8)


def _draw(options: FigureOptions, methods: Sequence[str]) -> Drawing:
    shown, priors = samples(options), PriorCache()
    per_sample = 3 if options.clouds else 2
    ratio = max(sample.left.shape[0] / sample.left.shape[1] for sample in shown)
    width = CELL_IN * (1 + len(methods)) + 0.9
    figure = new_figure(width, len(shown) * (CELL_IN * ratio * per_sample + 0.75))
    axes = figure.subplots(per_sample * len(shown), 1 + len(methods), squeeze=False)
    numbers: dict[str, Any] = {}
    for index, sample in enumerate(shown):
        answers = [depths_of(sample, name, options.run.settings, priors) for name in methods]
        own = axes[per_sample * index : per_sample * (index + 1)]
        _rows(figure, own, sample, answers, options.clouds)
        numbers[sample.label] = {n: a.abs_rel for n, a in zip(methods, answers, strict=True)}
    return Drawing(figure, {"abs_rel": numbers})


def draw_ablation(options: FigureOptions) -> Drawing:
    """The prior, the reprojection loss without diffusion, and both together.

    Raises:
        ValueError: no samples, or an unknown method.
    """
    return _draw(options, options.run.methods or ABLATION_METHODS)


def draw_qualitative(options: FigureOptions) -> Drawing:
    """Every chosen method; errors as ``draw_ablation``."""
    return _draw(options, options.run.methods or QUALITATIVE_METHODS)
