"""Curves of error against updates per step, and against the exposure of the right view.

Data flow: samples + variants -> records (resumable) -> mean per variant -> figure.
Paper: S9 (fig:error_time); S11 (limits) for the exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from geodiff_plugin._checks import check_number
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.cells import count_of_pairs
from geodiff_plugin.evaluation.datasets import SampleRef
from geodiff_plugin.evaluation.datasets.exposure import exposed_ref
from geodiff_plugin.evaluation.figures.base import Drawing, FigureOptions, references
from geodiff_plugin.evaluation.figures.canvas import COLOURS, new_figure, plain_log_axis
from geodiff_plugin.evaluation.runner import headline, run
from geodiff_plugin.evaluation.statistics import Mean, mean_with_interval

__all__ = ["draw_exposure", "draw_inner_steps"]

EXPOSURE_METHODS = ("paper", "guided", "sgbm")
#: Half and twice the light, and the steps between.
GAINS = (0.5, 0.7, 1.0, 1.4, 2.0)
GAMMAS = (0.5, 0.7, 1.0, 1.4, 2.0)
PRESETS = ("guided", "paper")


def _records(
    options: FigureOptions, refs: Sequence[SampleRef], methods: Sequence[str]
) -> list[dict[str, Any]]:
    return run(
        refs,
        methods,
        options.run.settings,
        options.run.out,
        skip_broken=options.run.skip_broken,
        progress=not options.run.quiet,
    )


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
    updates = sorted({check_number(n, "updates", 1, 10_000, integer=True) for n in options.updates})
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
    return Drawing(figure, numbers)


def draw_exposure(options: FigureOptions) -> Drawing:
    """Error against gain and against gamma of the right view; the left view stays as it is.

    Raises:
        ValueError: no samples, or an unknown method.
    """
    methods, refs = options.run.methods or EXPOSURE_METHODS, references(options)
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
    return Drawing(figure, numbers)
