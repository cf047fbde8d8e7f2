"""Curves of error: against updates per step (paper S9), exposure (S11), and the strength of the prior."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.datasets import SampleRef
from geodiff_plugin.evaluation.datasets.changed import exposed_ref
from geodiff_plugin.evaluation.experiment import headline, measure_cells, method_cells
from geodiff_plugin.evaluation.figures.canvas import (
    COLOURS,
    Drawing,
    new_figure,
    plain_log_axis,
    references,
    save_png,
)
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.evaluation.table import Mean, count_of_pairs, mean_with_interval
from geodiff_plugin.runner import Record

__all__ = ["draw_exposure", "draw_inner_steps", "draw_strength", "shaded"]

EXPOSURE_METHODS = ("paper", "guided", "sgbm")
#: Half and twice the light, and the steps between.
GAINS = (0.5, 0.7, 1.0, 1.4, 2.0)
GAMMAS = (0.5, 0.7, 1.0, 1.4, 2.0)
PRESETS = ("guided", "paper")


def _records(options: FigureOptions, refs: Sequence[SampleRef], methods: Sequence[str]) -> list[Record]:
    return measure_cells(method_cells(refs, methods, options.settings, options.out), options) or []


def _mean(records: Sequence[dict[str, Any]], value_of: Callable[[dict[str, Any]], float | None]) -> Mean:
    values = [value_of(record) for record in records if record["status"] == "ok"]
    return mean_with_interval([value for value in values if value is not None])


def _line(axes: Any, x: Sequence[float], means: Sequence[Mean], title: str, index: int) -> None:
    """A line through the means that are there, with a band where they have intervals."""
    known = [(at, mean) for at, mean in zip(x, means, strict=True) if mean.count]
    if not known:
        return
    style = {"color": COLOURS[index % len(COLOURS)], "marker": "osD^vP"[index % 6], "markersize": 4}
    axes.plot([at for at, _ in known], [mean.value for _, mean in known], label=title, **style)
    if all(mean.low is not None for _, mean in known):
        low, high = [m.low for _, m in known], [m.high for _, m in known]
        axes.fill_between([at for at, _ in known], low, high, color=style["color"], alpha=0.15, linewidth=0)


def _finish(axes: Any, x: Sequence[float], x_name: str, y_name: str) -> None:
    axes.set_xscale("log")
    axes.set_xticks(x, labels=[f"{value:g}" for value in x])
    axes.minorticks_off()
    axes.set_xlabel(x_name, fontsize=9)
    axes.set_ylabel(y_name, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def _numbers(means: Sequence[Mean]) -> list[float | None]:
    return [mean.value if mean.count else None for mean in means]


def draw_inner_steps(options: FigureOptions) -> Drawing:
    """Error and seconds against updates per denoising step, for both presets.

    Raises:
        ValueError: no samples, or numbers of updates that are no positive integers.
    """
    updates = sorted(set(options.updates))
    methods = {preset: [f"{preset}:inner_steps={n}" for n in updates] for preset in PRESETS}
    refs = references(options)
    records = _records(options, refs, [name for names in methods.values() for name in names])
    figure = new_figure(7.6, 3.1)
    left, right = figure.subplots(1, 2)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs], "updates": updates}
    for index, (preset, names) in enumerate(methods.items()):
        own = [[record for record in records if record["method"] == name] for name in names]
        errors = [_mean(each, headline) for each in own]
        seconds = [_mean(each, lambda record: record["seconds"]) for each in own]
        title = find_method(preset).title
        _line(left, updates, errors, title, index)
        _line(right, updates, seconds, title, index)
        numbers[preset] = {"abs_rel": _numbers(errors), "seconds": _numbers(seconds)}
    _finish(left, updates, "updates per denoising step", "AbsRel")
    _finish(right, updates, "updates per denoising step", "seconds a pair")
    left.set_ylim(bottom=0)
    right.set_ylim(bottom=0)
    right.legend(fontsize=8)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    return (figure, numbers)


def draw_exposure(options: FigureOptions) -> Drawing:
    """Error against gain and against gamma of the right view; the left view stays as it is.

    Raises:
        ValueError: no samples, or an unknown method.
    """
    methods, refs = options.methods or EXPOSURE_METHODS, references(options)
    panels = {"gain": [(gain, 1.0) for gain in GAINS], "gamma": [(1.0, gamma) for gamma in GAMMAS]}
    changes = list(dict.fromkeys(change for own in panels.values() for change in own))
    exposed = {change: [exposed_ref(ref, *change) for ref in refs] for change in changes}
    records = _records(options, [ref for own in exposed.values() for ref in own], methods)
    figure = new_figure(7.6, 3.1)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs]}
    axes_of = dict(zip(panels, figure.subplots(1, 2, sharey=True), strict=True))
    for name, own in panels.items():
        x = [change[0] if name == "gain" else change[1] for change in own]
        numbers[name] = {"values": x}
        for index, method in enumerate(methods):
            means = []
            for change in own:
                names = {ref.name for ref in exposed[change]}
                means.append(
                    _mean([r for r in records if r["method"] == method and r["sample"] in names], headline)
                )
            _line(axes_of[name], x, means, find_method(method).title, index)
            numbers[name][method] = _numbers(means)
    _finish(axes_of["gain"], GAINS, "gain of the right view", "AbsRel")
    _finish(axes_of["gamma"], GAMMAS, "gamma of the right view", "")
    drawn = [value for panel in panels for name in methods for value in numbers[panel][name] if value]
    if drawn:  # errors of good and bad methods are decades apart
        plain_log_axis(axes_of["gain"].yaxis, min(drawn), max(drawn))
    axes_of["gain"].legend(fontsize=8)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    return (figure, numbers)


LIGHT = np.array([-0.4, -0.5, 0.77])


def shaded(depth_m: np.ndarray, focal_px: float) -> np.ndarray:
    """``(H, W)`` in [0, 1]: the surface lit from the upper left, so that roughness shows."""
    rows, columns = np.gradient(np.log(np.maximum(depth_m, 1e-6)))
    normal = np.stack([-columns * focal_px, -rows * focal_px, np.ones_like(rows)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.clip(normal @ LIGHT, 0.0, 1.0)


def draw_strength(
    records: Sequence[Mapping[str, Any]], oracle: str, pictures: Mapping[str, np.ndarray], path: Path
) -> None:
    """Write the figure.

    Args:
        records: of ``run_strength``.
        oracle: the method whose error is the abscissa.
        pictures: title -> shaded crop.
        path: PNG to write.
    """
    strengths = list(dict.fromkeys(r["strength"] for r in records))
    methods = [m for m in dict.fromkeys(r["method"] for r in records) if m != oracle]
    figure = new_figure(11.0, 4.4)
    grid = figure.add_gridspec(2, 4)
    axes = figure.add_subplot(grid[:, :2])

    def mean(strength: str, method: str) -> float:
        own = [r["abs_rel"] for r in records if (r["strength"], r["method"]) == (strength, method)]
        return float(np.mean(own))

    at = {s: mean(s, oracle) for s in strengths}
    ordered = sorted(strengths, key=at.__getitem__)
    for index, method in enumerate(methods):
        axes.plot(
            [at[s] for s in ordered],
            [mean(s, method) for s in ordered],
            color=COLOURS[index % len(COLOURS)],
            marker="osD^vP"[index % 6],
            markersize=4,
            label=find_method(method).title,
        )
    ends = (min(at.values()) * 0.8, max(at.values()) * 1.2)
    axes.plot(ends, ends, color="0.6", linestyle="--", linewidth=1, label=find_method(oracle).title)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("AbsRel of the prior, aligned by an oracle", fontsize=9)
    axes.set_ylabel("AbsRel in metres", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    for k, (title, picture) in enumerate(pictures.items()):
        row, column = divmod(k, 2)
        panel = figure.add_subplot(grid[row, 2 + column])
        panel.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        panel.set_title(title, fontsize=8)
        panel.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(figure, path)
