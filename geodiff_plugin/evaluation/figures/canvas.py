"""Drawing tools of the figures: a sheet, maps with shared colour bars, small PNG files.

Data flow: arrays -> matplotlib figure -> PNG.
Paper: none.
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.formats import atomic_path
from geodiff_plugin.plotting import ticks

__all__ = [
    "COLOURS",
    "depth_bar",
    "error_bar",
    "mark",
    "new_figure",
    "plain_log_axis",
    "save_png",
    "show_depth",
    "show_error",
    "show_image",
    "show_values",
    "value_bar",
]

DPI = 90
#: Colours of lines, in order (Okabe and Ito's, distinguishable for the colour-blind).
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: The largest error that has a colour of its own.
WORST_SHOWN = 0.5
_GREY = "#808080"


def _matplotlib(part: str = "") -> Any:
    return importlib.import_module(f"matplotlib.{part}" if part else "matplotlib")


def new_figure(width_in: float, height_in: float) -> Any:
    """An empty figure that lays itself out; it belongs to no global state."""
    return _matplotlib("figure").Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


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
    colours = _matplotlib().colormaps[name].with_extremes(bad=_GREY)
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
    return _map(axes, known, title, "plasma_r", _matplotlib("colors").LogNorm(near, far, clip=True))


def show_error(
    axes: Any, depth_m: np.ndarray, truth_m: np.ndarray, valid: np.ndarray, title: str = ""
) -> Any:
    """The map of ``|p - t| / t``, grey without truth or prediction; arguments as for ``show_depth``."""
    known = valid & np.isfinite(depth_m) & (depth_m > 0)
    safe = np.where(known, truth_m, 1.0)
    error = np.where(known, np.abs(np.where(known, depth_m, 1.0) - safe) / safe, np.nan)
    return _map(axes, error, title, "inferno", _matplotlib("colors").Normalize(0, WORST_SHOWN, clip=True))


def show_values(axes: Any, values: np.ndarray, title: str, colours: str, low: float, high: float) -> Any:
    """A map of anything else between two values, in a colour map of matplotlib; NaN is grey."""
    return _map(axes, values, title, colours, _matplotlib("colors").Normalize(low, high, clip=True))


def mark(axes: Any, mask: np.ndarray, colour: str) -> None:
    """Paint pixels of a map in one colour that its own colours do not have."""
    rgba = np.zeros((*mask.shape, 4))
    rgba[mask] = _matplotlib("colors").to_rgba(colour)
    axes.imshow(rgba, interpolation="nearest")


def plain_log_axis(axis: Any, low: float, high: float) -> None:
    """A logarithmic axis with round numbers instead of powers."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    values = ticks(low, max(high, 1.01 * low), 7)
    axis.set_ticks(values, labels=[f"{value:g}" for value in values])
    axis.set_minor_locator(_matplotlib("ticker").NullLocator())


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
