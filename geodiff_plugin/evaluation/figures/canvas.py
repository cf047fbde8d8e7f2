"""What the figures share: samples, depth maps of methods, maps with colour bars, small PNG files."""

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

from geodiff_plugin.evaluation.baselines import NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions, all_refs, select
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.plotting import ticks

#: A figure of matplotlib, and what it shows as JSON values.
Drawing = tuple[Any, dict[str, Any]]
DPI = 90
#: Colours of lines, in order (Okabe and Ito's, distinguishable for the colour-blind), and their markers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = "osD^vP"
#: The largest error that has a colour of its own.
WORST_SHOWN = 0.5


def references(options: FigureOptions) -> list[SampleRef]:
    """The samples that a figure shows, their poses perturbed where the options say so."""
    return options.changed(select(all_refs(options), options))


def samples(options: FigureOptions) -> list[StereoSample]:
    """The same, read; ``ValueError`` for one without truth."""
    return [load(ref).check_truth() for ref in references(options)]


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


def depths_of(sample: StereoSample, name: str, settings: Settings, priors: PriorCache) -> MethodDepth:
    """Run one method; relative depth gets scale and shift from the truth."""
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


class Scale(NamedTuple):
    """Colours of a map, by a name and a norm of matplotlib, and the ticks and the label of their bar."""

    colours: str
    norm: Any
    label: str
    ticks: Any
    labels: Sequence[str]


def depth_scale(near: float, far: float) -> Scale:
    """Metres in the colours of ``plotting.colour_depth``: near is yellow, far is dark."""
    at = ticks(near, far, 5)
    return Scale("plasma_r", LogNorm(near, far, clip=True), "depth, m", at, [f"{value:g}" for value in at])


def value_scale(colours: str, low: float, high: float, label: str) -> Scale:
    """Anything else between two values."""
    at = np.linspace(low, high, 3)
    return Scale(colours, Normalize(low, high, clip=True), label, at, [f"{value:g}" for value in at])


_SHARES = np.linspace(0, WORST_SHOWN, 6)
ERROR = Scale(
    "inferno",
    Normalize(0, WORST_SHOWN, clip=True),
    "error / depth, %",
    _SHARES,
    [f"{100 * share:.0f}" for share in _SHARES],
)


def show_map(axes: Any, values: np.ndarray, scale: Scale, title: str = "") -> Any:
    """A map ``(H, W)``; what is not finite is grey. Returns what a colour bar is made of."""
    show_image(axes, np.zeros((*values.shape, 3), np.uint8), title)
    colours = colormaps[scale.colours].with_extremes(bad="#808080")
    # No smoothing: a pixel without a value must not bleed into its neighbours.
    return axes.imshow(np.ma.masked_invalid(values), cmap=colours, norm=scale.norm, interpolation="nearest")


def known_depth(depth_m: np.ndarray) -> np.ndarray:
    """``(H, W)`` metres, NaN where not finite or not positive."""
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.nan)


def relative_error(depth_m: np.ndarray, sample: StereoSample) -> np.ndarray:
    """``(H, W)`` of ``|p - t| / t``, NaN without truth or prediction."""
    truth = np.where(sample.valid, sample.depth_m, np.nan)
    return np.abs(known_depth(depth_m) - truth) / truth


def colour_bar(
    figure: Any,
    drawn: Any,
    axes: Sequence[Any],
    scale: Scale,
    location: str = "right",
    beyond: str = "neither",
) -> None:
    """A colour bar beside a row of maps, or at ``"bottom"`` under one.

    Args:
        figure: that has the maps.
        drawn: what ``show_map`` returned.
        axes: of the maps.
        scale: of the maps.
        location: side of the maps.
        beyond: ends at which values go on without a colour of their own: matplotlib's ``extend``.
    """
    shape = {"pad": 0.01} if location == "right" else {"pad": 0.03, "aspect": 16, "panchor": False}
    bar = figure.colorbar(drawn, ax=list(axes), location=location, shrink=0.9, extend=beyond, **shape)
    bar.set_ticks(scale.ticks, labels=scale.labels)
    bar.minorticks_off()
    if isinstance(scale.norm, LogNorm):
        bar.ax.invert_yaxis()  # near above far, as in the picture
    bar.ax.tick_params(labelsize=8)
    bar.set_label(scale.label, fontsize=8)


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
