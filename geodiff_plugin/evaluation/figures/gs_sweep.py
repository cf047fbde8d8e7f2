"""Sweep of the global scale: L_geo and AbsRel against g_s, with re-rendered left images.

Paper: S7.3, supplementary figures (fig:lossAbs1, fig:lossAbs2, fig:warp).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin._checks import check_number
from geodiff_plugin.algorithm.photometric import masked_mean, photometric_map
from geodiff_plugin.evaluation.baselines import METHODS, PriorCache
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.evaluation.figures.canvas import (
    COLOURS,
    Drawing,
    new_figure,
    plain_log_axis,
    samples,
    show_image,
)
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.geometry import warp_right_to_left
from geodiff_plugin.scale.space import SPACES, smooth_floor

__all__ = ["Sweep", "draw_gs_sweep", "sweep_g_s"]

#: Candidates, as many as the one-number search of the paper preset has.
CANDIDATES = 80
ETA = 0.85
SHOWN = 4


class Sweep(NamedTuple):
    """One sample at every candidate.

    Attributes:
        g_s: ``(M,)`` metres.
        loss: ``(M,)`` photometric error over the visible pixels, Eq. 14.
        visible: ``(M,)`` share of pixels that the right camera sees.
        abs_rel: ``(M,)`` over all pixels with truth.
        shown: indices of candidates whose re-rendered image is kept.
        rendered: ``(H, W, 3)`` in [0, 1] each.
    """

    g_s: np.ndarray
    loss: np.ndarray
    visible: np.ndarray
    abs_rel: np.ndarray
    shown: tuple[int, ...]
    rendered: tuple[np.ndarray, ...]


def _shown(loss: np.ndarray, abs_rel: np.ndarray) -> tuple[int, ...]:
    """Both optima, the last candidate, and others evenly between, in rising order."""
    chosen = {int(loss.argmin()), int(abs_rel.argmin()), len(loss) - 1}
    for index in np.linspace(0, len(loss) - 1, SHOWN + 1).round().astype(int)[1:]:
        if len(chosen) < SHOWN:
            chosen.add(int(index))
    return tuple(sorted(chosen))


def sweep_g_s(sample: StereoSample, relative: np.ndarray, space: str, largest_m: float) -> Sweep:
    """Scale a relative map by every candidate: ``x = g_s * x_rel``, without shift.

    A map that falls with depth has no depth at 0 without a shift: it gets that of raw scale and shift 0.

    Args:
        sample: with truth.
        relative: ``(H, W)`` the prior's map, about [0, 1].
        space: what it is affine in, key of ``SPACES``.
        largest_m: the last candidate, metres; the first one is 1 m.

    Source: S7.3. Deviation: L_geo is the mean over the visible pixels, not over all
    (docs/reference/paper-map.md, E8).
    """
    left, right = (as_image_01(image, "image")[None] for image in (sample.left, sample.right))
    matrices = (sample.K_left, sample.K_right, np.linalg.inv(sample.E))
    K_left, K_right, T = (torch.as_tensor(matrix, dtype=torch.float32)[None] for matrix in matrices)
    x = smooth_floor(torch.from_numpy(np.asarray(relative, np.float32))[None, None])
    candidates = torch.from_numpy(np.geomspace(1.0, largest_m, CANDIDATES).astype(np.float32))
    scale, shift = torch.ones(1), torch.zeros(1)
    if not SPACES[space].grows_with_depth:
        scale = shift = F.softplus(torch.zeros(1))
    losses, shares, errors = [], [], []

    def at(g_s: torch.Tensor) -> tuple[torch.Tensor, Any]:
        depth_m = SPACES[space].forward(scale * x + shift, g_s)
        return depth_m, warp_right_to_left(right, depth_m, K_left, K_right, T)

    for g_s in candidates:
        depth_m, warped = at(g_s)
        losses.append(float(masked_mean(photometric_map(left, warped.image, ETA), warped.visible)))
        shares.append(float(warped.visible.float().mean()))
        errors.append(evaluate_depth(depth_m[0, 0].numpy(), sample.depth_m, sample.valid)["abs_rel"])
    loss, abs_rel = np.array(losses), np.array(errors)
    shown = _shown(loss, abs_rel)
    rendered = tuple(at(candidates[i])[1].image[0].permute(1, 2, 0).numpy() for i in shown)
    return Sweep(candidates.numpy(), loss, np.array(shares), abs_rel, shown, rendered)


def _curves(axes: Any, sweep: Sweep) -> None:
    """Loss above error on one logarithmic axis, both optima marked in both."""
    best_loss, best_error = int(sweep.loss.argmin()), int(sweep.abs_rel.argmin())
    for axis, values, name, colour in (
        (axes[0], sweep.loss, "L_geo (visible)", COLOURS[0]),
        (axes[1], sweep.abs_rel, "AbsRel", COLOURS[1]),
    ):
        axis.plot(sweep.g_s, values, color=colour)
        for index, of, line, what in (
            (best_loss, COLOURS[0], "--", "least L_geo"),
            (best_error, COLOURS[1], ":", "least AbsRel"),
        ):
            label = f"{what}: g_s = {sweep.g_s[index]:.3g} m"
            axis.axvline(sweep.g_s[index], color=of, linestyle=line, linewidth=1.2, label=label)
        axis.set_ylabel(name, fontsize=9)
        axis.set_xlim(0.95 * sweep.g_s[0], 1.05 * sweep.g_s[-1])  # an optimum at an end is seen too
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    plain_log_axis(axes[0].xaxis, float(sweep.g_s[0]), float(sweep.g_s[-1]))
    plain_log_axis(axes[1].yaxis, float(sweep.abs_rel.min()), float(sweep.abs_rel.max()))
    axes[1].set_xlabel("global scale g_s, m", fontsize=9)
    for axis in axes:
        axis.tick_params(labelsize=8)


def draw_gs_sweep(options: FigureOptions) -> Drawing:
    """Draw the first sample.

    Raises:
        ValueError: no sample, or ``largest`` not above 1 m.
    """
    largest = check_number(options.max, "max", 1.01, 1e6)
    sample, priors = samples(options)[0], PriorCache()
    prior = METHODS["prior-aligned"].run(sample, options.settings, priors)
    assert prior.relative is not None
    sweep = sweep_g_s(sample, prior.relative, prior.space, largest)
    figure = new_figure(8.6, 4.9)
    upper, lower = figure.subfigures(2, 1, height_ratios=[2.0, 1.0])
    _curves(upper.subplots(2, 1, sharex=True), sweep)
    cells = lower.subplots(1, 1 + len(sweep.shown))
    show_image(cells[0], sample.left, "left image")
    for axes, index, picture in zip(cells[1:], sweep.shown, sweep.rendered, strict=True):
        title = f"g_s = {sweep.g_s[index]:.3g} m\n{sweep.visible[index]:.0%} in view"
        show_image(axes, picture, title)
    numbers = {"sample": sample.label, "visible": sweep.visible.tolist()}
    numbers |= {"g_s_m": sweep.g_s.tolist(), "loss": sweep.loss.tolist(), "abs_rel": sweep.abs_rel.tolist()}
    return (figure, numbers)
