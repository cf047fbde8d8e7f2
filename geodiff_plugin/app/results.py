"""Contents of the result panels of the page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gradio as gr
import numpy as np
from PIL import Image

from geodiff_plugin.app import look
from geodiff_plugin.app.files import report_of, write_files, write_scene
from geodiff_plugin.app.job import Result
from geodiff_plugin.app.measure import Reading, distance_m, read_pixel
from geodiff_plugin.app.panels import Panels
from geodiff_plugin.app.pictures import (
    colour_relative,
    colour_share,
    in_metres,
    legend_of_depth,
    legend_of_share,
    marked,
    metres,
)

__all__ = ["Shown", "comparison", "everything", "measurement", "scene"]

#: Pictures on the page are no larger than this; files to take home have every pixel.
LARGEST_SIDE = 1600
#: Where the cloud is looked at from: degrees around it and down from above, and a share of its depth.
VIEW_ANGLES, VIEW_FROM = (90, 75), 1.05


@dataclass(frozen=True, eq=False)
class Shown:
    """A result and where its files lie, for one visitor.

    Attributes:
        result: of the job.
        folder: of its own.
        scale: size of the pictures on the page / size of the maps.
    """

    result: Result
    folder: Path
    scale: float

    def picture(self, name: str) -> np.ndarray:
        """``(h, w, 3)`` uint8, as large as the page shows it."""
        full = self._full(name)
        if self.scale == 1:
            return full
        size = (round(full.shape[1] * self.scale), round(full.shape[0] * self.scale))
        return np.asarray(Image.fromarray(full).resize(size, Image.Resampling.LANCZOS))

    def _full(self, name: str) -> np.ndarray:
        result = self.result
        if name == "photograph":
            return np.rint(np.clip(result.views.left, 0, 1) * 255).astype(np.uint8)
        if name == "depth":
            return in_metres(result.depth_m)
        if name == "prior" and result.prior_map is not None:
            return colour_relative(result.prior_map, result.depth_m)
        if name == "confidence" and result.confidence is not None:
            return colour_share(result.confidence)
        if name == "error" and result.error is not None:
            return colour_share(result.error, self.most_error)
        raise KeyError(name)

    @property
    def most_error(self) -> float:
        """The error at the upper end of its colours."""
        error = self.result.error
        return 1.0 if error is None else max(float(np.percentile(error, 99)), 1e-3)

    def reading(self, pixel: tuple[int, int]) -> Reading:
        """What the map says at a pixel of a picture on the page."""
        result = self.result
        height, width = result.depth_m.shape
        x, y = (round((value + 0.5) / self.scale - 0.5) for value in pixel)
        inside = (min(max(x, 0), width - 1), min(max(y, 0), height - 1))
        return read_pixel(result.depth_m, result.K, inside, result.confidence, result.uncertainty_m)


def comparison(shown: Shown, beside: str) -> tuple[np.ndarray, np.ndarray]:
    """The two pictures of the slider."""
    has_prior = shown.result.prior_map is not None
    return shown.picture(beside if has_prior else "photograph"), shown.picture("depth")


def measurement(shown: Shown, clicks: list[tuple[int, int]], under: str) -> tuple[np.ndarray, str]:
    """The picture with the points of these clicks, and what they say as HTML."""
    readings = [shown.reading(pixel) for pixel in clicks]
    picture = marked(shown.picture(under), list(zip(clicks, readings, strict=True)))
    return picture, _words(readings) if readings else look.HOW_TO_MEASURE


def _words(readings: list[Reading]) -> str:
    rows = "".join(
        f"<tr><td><b>{name}</b></td><td>{metres(reading.depth_m, reading.spread_m)}</td>"
        f"<td>{'unknown' if reading.confidence is None else f'{100 * reading.confidence:.0f} %'}</td></tr>"
        for name, reading in zip("AB", readings, strict=False)
    )
    table = f'<table class="readings"><tr><th></th><th>depth</th><th>confidence</th></tr>{rows}</table>'
    if len(readings) < 2:
        return f'<div class="say">{table}<p>Click a second point for the distance.</p></div>'
    length = metres(*distance_m(*readings))
    note = "± is one standard deviation, from the confidence that each depth is within 10 %."
    return (
        f'<div class="say"><div>Distance A to B</div><div class="distance">{length}</div>{table}'
        f'<p class="legend-caption" style="text-align:left">{note}</p></div>'
    )


def scene(shown: Shown, least_confidence: float) -> tuple[Any, str]:
    """The view of the cloud of the sure points from behind the cameras, and a line about it."""
    sure = least_confidence if shown.result.confidence is not None else 0.0
    path = shown.folder / f"scene-{round(100 * sure)}.glb"
    count = write_scene(path, shown.result, sure)
    share = 100 * count / shown.result.depth_m.size
    away = VIEW_FROM * float(np.percentile(shown.result.depth_m, 90))
    view = gr.Model3D(str(path), camera_position=(*VIEW_ANGLES, away))
    return view, f'<div class="legend-caption">{count:,} points, {share:.0f} % of the pixels</div>'


def _figures(shown: Shown) -> list[tuple[str, str]]:
    report, result = report_of(shown.result), shown.result
    depth = report["depth"]
    figures = [
        (f"{depth['min_m']:.2f} m to {depth['max_m']:.2f} m", "nearest and farthest"),
        (f"{depth['median_m']:.2f} m", "median depth"),
    ]
    if not result.verdict.trusted:  # what is not trusted is not praised
        return [(f"{figures[1][0]}, unconfirmed", "median depth"), *_seconds(shown)]
    if result.visible is not None:
        figures.append((f"{100 * depth['visible_fraction']:.0f} %", "seen by both cameras"))
    if result.confidence is not None:
        figures.append((f"{100 * depth['median_confidence']:.0f} %", "median confidence"))
    return [*figures, *_seconds(shown)]


def _seconds(shown: Shown) -> list[tuple[str, str]]:
    return [(f"{sum(shown.result.seconds.values()):.1f} s", "computing")]


def everything(panels: Panels, shown: Shown, beside: str, under: str) -> dict[Any, Any]:
    """Every panel's value for a new result, but the cloud's, which is drawn when its tab is opened."""
    result = shown.result
    picture, words = measurement(shown, [], under)
    legend = legend_of_depth(result.depth_m)
    sure = "probability that a depth is within 10 % of the truth"
    differ = "difference between the photograph and the other view brought to it; dark where they agree"
    values: dict[Any, Any] = {
        panels.status: look.finished(result.verdict.status, _figures(shown), result.warnings),
        panels.slider: comparison(shown, beside),
        panels.depth_legend: legend,
        panels.picture: picture,
        panels.readings: words,
        panels.files: [str(path) for path in write_files(shown.folder, result)],
    }
    for name, image, note, most, caption in (
        ("confidence", panels.confidence, panels.confidence_legend, 1.0, sure),
        ("error", panels.error, panels.error_legend, 0.0, differ),
    ):
        known = getattr(result, name) is not None
        values[image] = shown.picture(name) if known else None
        values[note] = legend_of_share(most or shown.most_error, caption) if known else ""
    return values
