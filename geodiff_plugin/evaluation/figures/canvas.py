"""What the figures share: options, depth maps of methods, a sheet, maps with colour bars, small PNG files."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import NotApplicable, PriorCache, find_method
from geodiff_plugin.evaluation.baselines.base import Settings
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load
from geodiff_plugin.evaluation.datasets.changed import perturbed_ref
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions, all_refs, select
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.plotting import ticks

__all__ = [
    "COLOURS",
    "Drawing",
    "MethodDepth",
    "depth_bar",
    "depths_of",
    "error_bar",
    "mark",
    "new_figure",
    "plain_log_axis",
    "references",
    "samples",
    "save_png",
    "show_depth",
    "show_error",
    "show_image",
    "show_values",
    "value_bar",
]


#: A figure of matplotlib, and what it shows as JSON values.
Drawing = tuple[Any, dict[str, Any]]


class MethodDepth(NamedTuple):
    """A method's answer for one sample, ready to be drawn.

    Attributes:
        title: of its column.
        depth_m: ``(H, W)`` metres, ``None`` where the method cannot work on the sample.
        abs_rel: over all pixels with truth; ``None`` without a map, or where it is empty.
    """

    title: str
    depth_m: np.ndarray | None
    abs_rel: float | None


def references(options: FigureOptions) -> list[SampleRef]:
    """The samples that a figure shows, their poses perturbed where the options say so.

    Raises:
        ValueError: none, or bad options.
    """
    refs, change = select(all_refs(options), options), options.perturbed
    return refs if change is None else [perturbed_ref(ref, change) for ref in refs]


def samples(options: FigureOptions) -> list[StereoSample]:
    """The same, read.

    Raises:
        ValueError: none, a broken one, or one without truth.
        OSError: missing files.
    """
    read = [load(ref) for ref in references(options)]
    for sample in read:
        if not sample.valid.any():
            bad_value(f"the truth of {sample.label}", "known for at least one pixel", "none")
    return read


def depths_of(sample: StereoSample, name: str, settings: Settings, priors: PriorCache) -> MethodDepth:
    """Run one method; relative depth gets scale and shift from the truth, and its title says so."""
    method = find_method(name)
    try:
        prediction = method.run(sample, method.own_settings(settings), priors)
    except NotApplicable as reason:
        return MethodDepth(f"{method.title}:\n{reason}", None, None)
    depth_m = prediction.depth_m
    if depth_m is None:
        assert prediction.relative is not None
        depth_m = align(prediction.relative, sample.depth_m, sample.valid, prediction.space)
    abs_rel = evaluate_depth(depth_m, sample.depth_m, sample.valid)["abs_rel"]
    return MethodDepth(method.title, depth_m, None if math.isnan(abs_rel) else abs_rel)


DPI = 90
#: Colours of lines, in order (Okabe and Ito's, distinguishable for the colour-blind).
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: The largest error that has a colour of its own.
WORST_SHOWN = 0.5
_GREY = "#808080"


def new_figure(width_in: float, height_in: float) -> Any:
    """An empty figure that lays itself out; it belongs to no global state."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def save_png(figure: Any, path: Path) -> None:
    """Write a figure whole or not at all, in 256 colours, which are enough and a third of the size."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", metadata={"Software": None})
    picture = Image.open(drawn).convert("RGB")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        picture.quantize(256, kmeans=1, dither=Image.Dither.NONE).save(temporary, format="PNG", optimize=True)


def show_image(axes: Any, image: np.ndarray, title: str = "") -> None:
    """An RGB image without ticks."""
    axes.imshow(image, interpolation="antialiased")
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])


def _map(axes: Any, values: np.ndarray, title: str, name: str, norm: Any) -> Any:
    show_image(axes, np.zeros((*values.shape, 3), np.uint8), title)
    colours = colormaps[name].with_extremes(bad=_GREY)
    # No smoothing: a pixel without a value must not bleed into its neighbours.
    return axes.imshow(np.ma.masked_invalid(values), cmap=colours, norm=norm, interpolation="nearest")


def show_depth(axes: Any, depth_m: np.ndarray, near: float, far: float, title: str = "") -> Any:
    """A depth map in the colours of ``plotting.colour_depth``: near is yellow, far is dark, unknown is grey.

    Args:
        axes: where.
        depth_m: ``(H, W)`` metres; not finite or not positive is unknown.
        near: depth of the last colour, metres.
        far: depth of the first colour, metres.
        title: above it.

    Returns:
        What a colour bar is made of.
    """
    known = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.nan)
    return _map(axes, known, title, "plasma_r", LogNorm(near, far, clip=True))


def show_error(
    axes: Any, depth_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, title: str = ""
) -> Any:
    """The map of ``|p - t| / t``, grey without truth or prediction; arguments as for ``show_depth``."""
    known = valid & np.isfinite(depth_m) & (depth_m > 0)
    safe = np.where(known, truth_m, 1.0)
    error = np.where(known, np.abs(np.where(known, depth_m, 1.0) - safe) / safe, np.nan)
    return _map(axes, error, title, "inferno", Normalize(0, WORST_SHOWN, clip=True))


def show_values(axes: Any, values: np.ndarray, title: str, colours: str, low: float, high: float) -> Any:
    """A map of anything else between two values, in a colour map of matplotlib; NaN is grey."""
    return _map(axes, values, title, colours, Normalize(low, high, clip=True))


def mark(axes: Any, mask: np.ndarray, colour: str) -> None:
    """Paint pixels of a map in one colour that its own colours do not have."""
    rgba = np.zeros((*mask.shape, 4))
    rgba[mask] = to_rgba(colour)
    axes.imshow(rgba, interpolation="nearest")


def plain_log_axis(axis: Any, low: float, high: float) -> None:
    """A logarithmic axis with round numbers instead of powers."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    values = ticks(low, max(high, 1.01 * low), 7)
    axis.set_ticks(values, labels=[f"{value:g}" for value in values])
    axis.set_minor_locator(NullLocator())


def depth_bar(figure: Any, drawn: Any, axes: Sequence[Any], near: float, far: float) -> None:
    """A colour bar in metres beside a row of maps."""
    bar = figure.colorbar(drawn, ax=list(axes), shrink=0.9, pad=0.01)
    round_depths = ticks(near, far, 5)
    bar.set_ticks(round_depths, labels=[f"{value:g}" for value in round_depths])
    bar.minorticks_off()
    bar.ax.invert_yaxis()
    bar.ax.tick_params(labelsize=8)
    bar.set_label("depth, m", fontsize=8)


def error_bar(figure: Any, drawn: Any, axes: Sequence[Any], location: str = "right") -> None:
    """A colour bar of relative errors beside a row of maps, or at ``"bottom"`` under one."""
    steps = np.linspace(0, WORST_SHOWN, 6)
    bar = _bar(figure, drawn, axes, location, extend="max")
    bar.set_ticks(steps, labels=[f"{100 * step:.0f}" for step in steps])
    bar.set_label("error / depth, %", fontsize=8)


def value_bar(figure: Any, drawn: Any, axes: Any, name: str, beyond: str = "neither") -> None:
    """A colour bar under one map.

    Args:
        figure: that has the map.
        drawn: what ``show_values`` returned.
        axes: of the map.
        name: quantity and unit.
        beyond: ends at which values go on without a colour of their own: matplotlib's ``extend``.
    """
    bar = _bar(figure, drawn, [axes], "bottom", extend=beyond)
    bar.set_ticks(np.linspace(drawn.norm.vmin, drawn.norm.vmax, 3))
    bar.set_label(name, fontsize=8)


def _bar(figure: Any, drawn: Any, axes: Sequence[Any], location: str, extend: str) -> Any:
    shape = {"pad": 0.01} if location == "right" else {"pad": 0.03, "aspect": 16, "panchor": False}
    bar = figure.colorbar(drawn, ax=list(axes), location=location, shrink=0.9, extend=extend, **shape)
    bar.ax.tick_params(labelsize=8)
    return bar
