"""Curves of error by updates per step (paper S9), exposure (S11), strength of the prior, scale (S7.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin.algorithm.terms import masked_mean, photometric_map
from geodiff_plugin.evaluation.baselines import METHODS, PriorCache, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample
from geodiff_plugin.evaluation.datasets.changed import changed_ref
from geodiff_plugin.evaluation.experiment import measure_cells, method_cells
from geodiff_plugin.evaluation.figures.canvas import (
    COLOURS,
    MARKERS,
    Drawing,
    new_figure,
    plain_log_axis,
    references,
    samples,
    save_png,
    show_image,
)
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.evaluation.tables import (
    Mean,
    ValueOf,
    count_of_pairs,
    headline,
    mean_with_interval,
    seconds_of,
)
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.geometry import warp_right_to_left
from geodiff_plugin.runner import Record
from geodiff_plugin.scale.space import SPACES, smooth_floor

EXPOSURE_METHODS = ("paper", "guided", "sgbm")
#: Half and twice the light, and the steps between; also exponents.
GAINS = (0.5, 0.7, 1.0, 1.4, 2.0)
PRESETS = ("guided", "paper")


def _records(options: FigureOptions, refs: Sequence[SampleRef], methods: Sequence[str]) -> list[Record]:
    return measure_cells(method_cells(refs, methods, options.settings, options.out), options) or []


def _mean(records: Sequence[Record], value_of: ValueOf) -> Mean:
    values = [value_of(record) for record in records if record["status"] == "ok"]
    return mean_with_interval([value for value in values if value is not None])


def _style(index: int) -> dict[str, Any]:
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)], "markersize": 4}


def _line(axes: Any, x: Sequence[float], means: Sequence[Mean], title: str, index: int) -> list[float | None]:
    """A line through the means that are there, with a band where they have intervals; returns the means."""
    known = [(at, mean) for at, mean in zip(x, means, strict=True) if mean.count]
    if known:
        at = [place for place, _ in known]
        axes.plot(at, [mean.value for _, mean in known], label=title, **_style(index))
        if all(mean.low is not None for _, mean in known):
            low, high = [m.low for _, m in known], [m.high for _, m in known]
            axes.fill_between(at, low, high, color=_style(index)["color"], alpha=0.15, linewidth=0)
    return [mean.value if mean.count else None for mean in means]


def _name_axes(axes: Any, x_name: str, y_name: str, x: Sequence[float] = ()) -> None:
    """Names, and for a logarithmic abscissa its values."""
    if x:
        axes.set_xscale("log")
        axes.set_xticks(x, labels=[f"{value:g}" for value in x])
        axes.minorticks_off()
    axes.set_xlabel(x_name, fontsize=9)
    axes.set_ylabel(y_name, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def draw_inner_steps(options: FigureOptions) -> Drawing:
    """Error and seconds against updates per denoising step, for both presets."""
    updates, refs = sorted(set(options.updates)), references(options)
    methods = {preset: [f"{preset}:inner_steps={n}" for n in updates] for preset in PRESETS}
    records = _records(options, refs, [name for names in methods.values() for name in names])
    figure = new_figure(7.6, 3.1)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs], "updates": updates}
    numbers |= {preset: {} for preset in PRESETS}
    quantities = {"abs_rel": ("AbsRel", headline), "seconds": ("seconds a pair", seconds_of)}
    panels = figure.subplots(1, 2)
    for axes, (key, (name, value_of)) in zip(panels, quantities.items(), strict=True):
        for index, (preset, names) in enumerate(methods.items()):
            means = [_mean([r for r in records if r["method"] == own], value_of) for own in names]
            numbers[preset][key] = _line(axes, updates, means, find_method(preset).title, index)
        _name_axes(axes, "updates per denoising step", name, updates)
        axes.set_ylim(bottom=0)
    panels[1].legend(fontsize=8)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    return figure, numbers


def draw_exposure(options: FigureOptions) -> Drawing:
    """Error against gain and against gamma of the right view; the left view stays as it is."""
    methods, refs = options.methods or EXPOSURE_METHODS, references(options)
    changes = {"gain": [(gain, 1.0) for gain in GAINS], "gamma": [(1.0, gamma) for gamma in GAINS]}
    every = dict.fromkeys(change for own in changes.values() for change in own)
    exposed = {change: [changed_ref(ref, "right_exposure", change) for ref in refs] for change in every}
    records = _records(options, [ref for own in exposed.values() for ref in own], methods)
    figure = new_figure(7.6, 3.1)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs]}
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (name, own) in zip(panels, changes.items(), strict=True):
        numbers[name] = {"values": list(GAINS)}
        for index, method in enumerate(methods):
            means = []
            for change in own:
                names = {ref.name for ref in exposed[change]}
                chosen = [r for r in records if r["method"] == method and r["sample"] in names]
                means.append(_mean(chosen, headline))
            numbers[name][method] = _line(axes, GAINS, means, find_method(method).title, index)
        _name_axes(axes, f"{name} of the right view", "AbsRel" if name == "gain" else "", GAINS)
    drawn = [value for name in changes for method in methods for value in numbers[name][method] if value]
    if drawn:  # errors of good and bad methods are decades apart
        plain_log_axis(panels[0].yaxis, min(drawn), max(drawn))
    panels[0].legend(fontsize=8)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    return figure, numbers


LIGHT = np.array([-0.4, -0.5, 0.77])


def shaded(depth_m: np.ndarray, focal_px: float) -> np.ndarray:
    """``(H, W)`` in [0, 1]: the surface lit from the upper left, so that roughness shows."""
    rows, columns = np.gradient(np.log(np.maximum(depth_m, 1e-6)))
    normal = np.stack([-columns * focal_px, -rows * focal_px, np.ones_like(rows)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.clip(normal @ LIGHT, 0.0, 1.0)


def draw_strength(
    records: Sequence[Record], oracle: str, pictures: Mapping[str, np.ndarray], path: Path
) -> None:
    """Write the figure of ``geodiff eval strength``.

    Args:
        records: of its run.
        oracle: the method whose error is the abscissa.
        pictures: title -> shaded crop.
        path: PNG to write.
    """
    figure = new_figure(11.0, 4.4)
    grid = figure.add_gridspec(2, 4)
    axes = figure.add_subplot(grid[:, :2])
    errors: dict[str, dict[str, list[float]]] = {}
    for record in records:
        of_method = errors.setdefault(record["method"], {})
        of_method.setdefault(record["strength"], []).append(record["abs_rel"])
    at = {strength: float(np.mean(own)) for strength, own in errors.pop(oracle).items()}
    ordered = sorted(at, key=at.__getitem__)
    for index, (method, own) in enumerate(errors.items()):
        means = [float(np.mean(own[strength])) for strength in ordered]
        axes.plot([at[s] for s in ordered], means, label=find_method(method).title, **_style(index))
    ends = (min(at.values()) * 0.8, max(at.values()) * 1.2)
    axes.plot(ends, ends, color="0.6", linestyle="--", linewidth=1, label=find_method(oracle).title)
    axes.set(xscale="log", yscale="log")
    _name_axes(axes, "AbsRel of the prior, aligned by an oracle", "AbsRel in metres")
    axes.legend(fontsize=8)
    for k, (title, picture) in enumerate(pictures.items()):
        panel = figure.add_subplot(grid[k // 2, 2 + k % 2])
        panel.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        panel.set_title(title, fontsize=8)
        panel.set_axis_off()
    save_png(figure, path)


#: Candidates, as many as the one-number search of the paper preset has; weight of SSIM; pictures shown.
CANDIDATES, ETA, SHOWN = 80, 0.85, 4


class Sweep(NamedTuple):
    """One sample at every candidate.

    Attributes:
        g_s: ``(M,)`` metres.
        loss: ``(M,)`` photometric error over the visible pixels, Eq. 14.
        visible: ``(M,)`` share of pixels that the right camera sees.
        abs_rel: ``(M,)`` over all pixels with truth.
        rendered: index -> ``(H, W, 3)`` in [0, 1], the left image re-rendered from the right one.
    """

    g_s: np.ndarray
    loss: np.ndarray
    visible: np.ndarray
    abs_rel: np.ndarray
    rendered: dict[int, np.ndarray]


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
    cameras = [torch.as_tensor(matrix, dtype=torch.float32)[None] for matrix in matrices]
    x = smooth_floor(torch.from_numpy(np.asarray(relative, np.float32))[None, None])
    candidates = torch.from_numpy(np.geomspace(1.0, largest_m, CANDIDATES).astype(np.float32))
    scale, shift = torch.ones(1), torch.zeros(1)
    if not SPACES[space].grows_with_depth:
        scale = shift = F.softplus(torch.zeros(1))

    def at(g_s: torch.Tensor) -> tuple[torch.Tensor, Any]:
        depth_m = SPACES[space].forward(scale * x + shift, g_s)
        return depth_m, warp_right_to_left(right, depth_m, *cameras)

    rows = []
    for g_s in candidates:
        depth_m, warped = at(g_s)
        loss = float(masked_mean(photometric_map(left, warped.image, ETA), warped.visible))
        error = evaluate_depth(depth_m[0, 0].numpy(), sample.depth_m, sample.valid)["abs_rel"]
        rows.append((loss, float(warped.visible.float().mean()), error))
    loss, visible, abs_rel = np.array(rows).T
    # Both optima, the last candidate, and others evenly between.
    chosen = dict.fromkeys([int(loss.argmin()), int(abs_rel.argmin()), CANDIDATES - 1])
    chosen |= dict.fromkeys(np.linspace(0, CANDIDATES - 1, SHOWN + 1).round().astype(int)[1:].tolist())
    shown = sorted(list(chosen)[:SHOWN])
    rendered = {i: at(candidates[i])[1].image[0].permute(1, 2, 0).numpy() for i in shown}
    return Sweep(candidates.numpy(), loss, visible, abs_rel, rendered)


def _sweep_curves(axes: Any, sweep: Sweep) -> None:
    """Loss above error on one logarithmic axis, both optima marked in both."""
    best = (int(sweep.loss.argmin()), "--", "least L_geo"), (int(sweep.abs_rel.argmin()), ":", "least AbsRel")
    curves = (sweep.loss, "L_geo (visible)"), (sweep.abs_rel, "AbsRel")
    for axis, (values, name), own_colour in zip(axes, curves, COLOURS, strict=False):
        axis.plot(sweep.g_s, values, color=own_colour)
        for (index, line, what), colour in zip(best, COLOURS, strict=False):
            label = f"{what}: g_s = {sweep.g_s[index]:.3g} m"
            axis.axvline(sweep.g_s[index], color=colour, linestyle=line, linewidth=1.2, label=label)
        axis.set_xlim(0.95 * sweep.g_s[0], 1.05 * sweep.g_s[-1])  # an optimum at an end is seen too
        _name_axes(axis, "", name)
    axes[0].legend(fontsize=8)
    plain_log_axis(axes[0].xaxis, float(sweep.g_s[0]), float(sweep.g_s[-1]))
    plain_log_axis(axes[1].yaxis, float(sweep.abs_rel.min()), float(sweep.abs_rel.max()))
    axes[1].set_xlabel("global scale g_s, m", fontsize=9)


def draw_gs_sweep(options: FigureOptions) -> Drawing:
    """L_geo and AbsRel of the first sample against g_s, with re-rendered left images (fig:lossAbs1)."""
    sample = samples(options)[0]
    prior = METHODS["prior-aligned"].run(sample, options.settings, PriorCache())
    assert prior.relative is not None
    sweep = sweep_g_s(sample, prior.relative, prior.space, options.max)
    figure = new_figure(8.6, 4.9)
    upper, lower = figure.subfigures(2, 1, height_ratios=[2.0, 1.0])
    _sweep_curves(upper.subplots(2, 1, sharex=True), sweep)
    cells = lower.subplots(1, 1 + len(sweep.rendered))
    show_image(cells[0], sample.left, "left image")
    for axes, (index, picture) in zip(cells[1:], sweep.rendered.items(), strict=True):
        show_image(axes, picture, f"g_s = {sweep.g_s[index]:.3g} m\n{sweep.visible[index]:.0%} in view")
    numbers = {"sample": sample.label, "visible": sweep.visible.tolist()}
    numbers |= {"g_s_m": sweep.g_s.tolist(), "loss": sweep.loss.tolist(), "abs_rel": sweep.abs_rel.tolist()}
    return figure, numbers
