"""Depth maps, error maps and point clouds of methods side by side (paper Figures 5 and 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.evaluation.figures.canvas import (
    ERROR,
    Drawing,
    MethodDepth,
    colour_bar,
    depth_scale,
    depths_of,
    known_depth,
    new_figure,
    relative_error,
    samples,
    show_image,
    show_map,
)
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.geometry import project, resize_intrinsics, transform, unproject
from geodiff_plugin.plotting import depth_range

ABLATION_METHODS = ("prior-aligned", "reprojection-only", "guided")
QUALITATIVE_METHODS = ("prior-aligned", "paper", "sweep-sgm", "guided")
YAW_DEGREES, PITCH_DEGREES = -25.0, 12.0
#: A picture of points is drawn this much smaller than the map that they come from, which closes its holes.
SHRINK = 0.6
CELL_IN = 1.75


def orbit(centre_m: float) -> np.ndarray:
    """``T_view_from_left`` ``(4, 4)`` of a camera that swung left and up around a point on the axis.

    Args:
        centre_m: depth of the point that stays where it is, metres.
    """
    T, centre = np.eye(4), np.array([0.0, 0.0, centre_m])
    T[:3, :3] = Rotation.from_euler("yx", [YAW_DEGREES, PITCH_DEGREES], degrees=True).as_matrix()
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def render_cloud(
    depth_m: np.ndarray, image: np.ndarray, K: np.ndarray, T_view_from_left: np.ndarray
) -> np.ndarray:
    """Points of a depth map from another camera, the nearest one in every pixel.

    Args:
        depth_m: ``(H, W)`` metres; not finite or not positive has no point.
        image: ``(H, W, 3)`` uint8, colours of the points.
        K: ``(3, 3)`` pixels of both.
        T_view_from_left: ``(4, 4)``.

    Returns:
        ``(H', W', 3)`` uint8, ``SHRINK`` times the size, white where no point lies.
    """
    height, width = depth_m.shape
    size = (round(height * SHRINK), round(width * SHRINK))
    known = np.isfinite(known_depth(depth_m))
    z_left = torch.from_numpy(np.where(known, depth_m, 1.0).astype(np.float32))[None, None]
    K_left, T = (torch.from_numpy(matrix.astype(np.float32))[None] for matrix in (K, T_view_from_left))
    points = transform(unproject(z_left, K_left), T)
    uv, z = project(points, resize_intrinsics(K_left, (height, width), size))
    at = uv.round().long().view(-1, 2)
    inside = (at >= 0).all(1) & (at[:, 0] < size[1]) & (at[:, 1] < size[0])
    keep = inside & torch.from_numpy(known).view(-1)
    target, z = (at[:, 1] * size[1] + at[:, 0])[keep], z.view(-1)[keep]
    colours = torch.from_numpy(np.ascontiguousarray(image)).view(-1, 3)[keep]
    # Far to near, and a stable sort: the last point written into a pixel is its nearest one.
    order = torch.argsort(z, descending=True, stable=True).numpy()
    picture = np.full((size[0] * size[1], 3), 255, np.uint8)
    picture[target.numpy()[order]] = colours.numpy()[order]
    return picture.reshape(*size, 3)


def _title(answer: MethodDepth) -> str:
    return answer.title if answer.abs_rel is None else f"{answer.title}\nAbsRel {answer.abs_rel:.3f}"


def _rows(figure: Any, axes: Any, sample: StereoSample, answers: Sequence[MethodDepth], clouds: bool) -> None:
    """The two or three rows of one sample: depth under the left image, errors under the truth, clouds."""
    truth = np.where(sample.valid, sample.depth_m, np.nan)
    scale = depth_scale(*depth_range(truth, sample.valid))
    show_image(axes[0, 0], sample.left, f"left image\n{sample.name}")
    depth, error = show_map(axes[1, 0], truth, scale, "truth"), None
    for column, answer in enumerate(answers, 1):
        if answer.depth_m is None:
            show_image(axes[0, column], np.full((*truth.shape, 3), 255, np.uint8), _title(answer))
            axes[1, column].axis("off")
            continue
        show_map(axes[0, column], known_depth(answer.depth_m), scale, _title(answer))
        error = show_map(axes[1, column], relative_error(answer.depth_m, sample), ERROR)
    colour_bar(figure, depth, axes[0], scale)
    if error is not None:
        colour_bar(figure, error, axes[1], ERROR, beyond="max")
    if clouds:
        view = orbit(float(np.median(sample.depth_m[sample.valid])))
        for cell, depth_m in zip(axes[2], [truth, *(answer.depth_m for answer in answers)], strict=True):
            if depth_m is None:
                cell.axis("off")
            else:
                show_image(cell, render_cloud(depth_m, sample.left, sample.K_left, view))
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
        answers = [depths_of(sample, name, options.settings, priors) for name in methods]
        own = axes[per_sample * index : per_sample * (index + 1)]
        _rows(figure, own, sample, answers, options.clouds)
        numbers[sample.label] = {n: a.abs_rel for n, a in zip(methods, answers, strict=True)}
    return figure, {"abs_rel": numbers}


def draw_ablation(options: FigureOptions) -> Drawing:
    """The prior, the reprojection loss without diffusion, and both together."""
    return _draw(options, options.methods or ABLATION_METHODS)


def draw_qualitative(options: FigureOptions) -> Drawing:
    """Every chosen method."""
    return _draw(options, options.methods or QUALITATIVE_METHODS)
