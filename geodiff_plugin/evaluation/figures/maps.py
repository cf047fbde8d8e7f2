"""Depth maps, error maps and point clouds of methods side by side (paper Figures 5 and 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.evaluation.figures.canvas import (
    Drawing,
    MethodDepth,
    depth_bar,
    depths_of,
    error_bar,
    new_figure,
    samples,
    show_depth,
    show_error,
    show_image,
)
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.geometry import project, resize_intrinsics, transform, unproject
from geodiff_plugin.plotting import depth_range

__all__ = [
    "ABLATION_METHODS",
    "QUALITATIVE_METHODS",
    "draw_ablation",
    "draw_qualitative",
    "orbit",
    "render_cloud",
]

YAW_DEGREES = -25.0
PITCH_DEGREES = 12.0
#: A picture of points is drawn this much smaller than the map that they come from, which closes its holes.
SHRINK = 0.6


def orbit(
    centre_m: float, yaw_degrees: float = YAW_DEGREES, pitch_degrees: float = PITCH_DEGREES
) -> np.ndarray:
    """``T_view_from_left`` of a camera that swings around the point at ``centre_m`` on the optical axis.

    Args:
        centre_m: depth of the point that stays where it is, metres.
        yaw_degrees: turn about the vertical axis; positive moves the camera to the right.
        pitch_degrees: turn about the horizontal axis; positive moves the camera up.

    Returns:
        ``(4, 4)`` float64.
    """
    yaw, pitch = math.radians(yaw_degrees), math.radians(pitch_degrees)
    turn_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    turn_x = np.array(
        [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]]
    )
    T = np.eye(4)
    T[:3, :3] = turn_x @ turn_y
    centre = np.array([0.0, 0.0, centre_m])
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
    known = np.isfinite(depth_m) & (depth_m > 0)
    z_left = torch.from_numpy(np.where(known, depth_m, 1.0).astype(np.float32))[None, None]
    cameras = (
        torch.from_numpy(K.astype(np.float32))[None],
        torch.from_numpy(T_view_from_left.astype(np.float32)),
    )
    points = transform(unproject(z_left, cameras[0]), cameras[1][None])
    uv, z = project(points, resize_intrinsics(cameras[0], (height, width), size))
    cell = uv.round().long().view(-1, 2)
    inside = (cell >= 0).all(1) & (cell[:, 0] < size[1]) & (cell[:, 1] < size[0])
    keep = inside & torch.from_numpy(known).view(-1)
    target, z = (cell[:, 1] * size[1] + cell[:, 0])[keep], z.view(-1)[keep]
    colours = torch.from_numpy(np.ascontiguousarray(image)).view(-1, 3)[keep]
    # Far to near, and a stable sort: the last point written into a pixel is its nearest one.
    order = torch.argsort(z, descending=True, stable=True).numpy()
    picture = np.full((size[0] * size[1], 3), 255, np.uint8)
    picture[target.numpy()[order]] = colours.numpy()[order]
    return picture.reshape(*size, 3)


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
        answers = [depths_of(sample, name, options.settings, priors) for name in methods]
        own = axes[per_sample * index : per_sample * (index + 1)]
        _rows(figure, own, sample, answers, options.clouds)
        numbers[sample.label] = {n: a.abs_rel for n, a in zip(methods, answers, strict=True)}
    return (figure, {"abs_rel": numbers})


def draw_ablation(options: FigureOptions) -> Drawing:
    """The prior, the reprojection loss without diffusion, and both together.

    Raises:
        ValueError: no samples, or an unknown method.
    """
    return _draw(options, options.methods or ABLATION_METHODS)


def draw_qualitative(options: FigureOptions) -> Drawing:
    """Every chosen method; errors as ``draw_ablation``."""
    return _draw(options, options.methods or QUALITATIVE_METHODS)
