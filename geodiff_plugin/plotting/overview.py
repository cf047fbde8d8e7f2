"""Overview of a run in one picture: left image, depth, confidence, photometric error.

Data flow: image, depth in metres, confidence, photometric error -> RGB picture.
Paper: none.
"""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageDraw

from geodiff_plugin.formats.depth import row_strips
from geodiff_plugin.plotting.figures import (
    BLACK,
    FIGURE_MIN_HEIGHT,
    GREY,
    WHITE,
    depth_figure,
    text_font,
)
from geodiff_plugin.plotting.sheets import grid

__all__ = ["overview", "share_figure"]

#: Dark is 0; the middle and the end differ for the colour-blind too.
SHARE_COLOURS = np.array([(30, 30, 60), (60, 110, 160), (120, 190, 160), (250, 240, 150)], dtype=np.float64)
CELL_WIDTH = 480
#: Maps are thinned to no less than so many times the width of a cell.
ENOUGH = 2
#: The error's colours end at its 98 % quantile, and not below this.
LEAST_ERROR = 0.05


def _shade(values: np.ndarray, top: float) -> np.ndarray:
    """``(H, W, 3)`` uint8 of values in [0, ``top``]; grey where not finite."""
    picture = np.empty((*values.shape, 3), np.uint8)
    for rows in row_strips(*values.shape):
        picture[rows] = _shade_strip(values[rows].astype(np.float64) / top)
    return picture


def _shade_strip(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    position = np.clip(np.where(known, values, 0.0), 0.0, 1.0) * (len(SHARE_COLOURS) - 1)
    lower = np.minimum(position.astype(int), len(SHARE_COLOURS) - 2)
    part = (position - lower)[..., None]
    colours = SHARE_COLOURS[lower] * (1.0 - part) + SHARE_COLOURS[lower + 1] * part
    return np.where(known[..., None], np.rint(colours), GREY[0]).astype(np.uint8)


def share_figure(values: np.ndarray, label: str, top: float) -> Image.Image:
    """A coloured map of something from 0 to ``top``, beside its colour bar.

    Args:
        values: ``(H, W)``; not finite is unknown and grey.
        label: what it is, a word or two above the bar.
        top: value of the last colour, > 0.

    Returns:
        RGB picture; small maps are enlarged by a whole factor.
    """
    picture = Image.fromarray(_shade(np.asarray(values), top))
    factor = math.ceil(FIGURE_MIN_HEIGHT / picture.height)
    if factor > 1:
        size = (picture.width * factor, picture.height * factor)
        picture = picture.resize(size, Image.Resampling.NEAREST)
    height = picture.height
    text = max(12, height // 26)
    bar, gap = max(14, height // 24), text // 2
    figure = Image.new("RGB", (picture.width + gap + bar + 5 * text, height), WHITE)
    figure.paste(picture, (0, 0))
    draw, left = ImageDraw.Draw(figure), picture.width + gap
    draw.text((left, text // 3), label, font=text_font(text), fill=BLACK)
    high, low = 2 * text, height - text
    shades = _shade(np.linspace(1.0, 0.0, low - high)[:, None], 1.0)
    figure.paste(Image.fromarray(np.repeat(shades, bar, axis=1)), (left, high))
    draw.rectangle((left, high, left + bar - 1, low - 1), outline=BLACK)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = low - 1 - share * (low - 1 - high)
        at = (left + bar + text // 2, y)
        draw.text(at, f"{share * top:.2g}", font=text_font(text), fill=BLACK, anchor="lm")
    return figure


def _beside_bar(image_01: np.ndarray, like: Image.Image, width: int) -> Image.Image:
    """The left image on a canvas as wide as a map with its bar, so that all cells have one scale."""
    picture = Image.fromarray(np.rint(np.clip(image_01, 0.0, 1.0) * 255).astype(np.uint8))
    canvas = Image.new("RGB", like.size, WHITE)
    canvas.paste(picture.resize((width, like.height)), (0, 0))
    return canvas


def overview(
    left_01: np.ndarray,
    depth_m: np.ndarray,
    confidence: np.ndarray | None,
    error: np.ndarray | None,
    unit: str | None = "m",
) -> Image.Image:
    """Left image, depth with legend, and where there are any confidence and photometric error.

    Args:
        left_01: ``(H, W, 3)`` in [0, 1].
        depth_m: ``(H, W)`` metres.
        confidence: ``(H, W)`` in [0, 1], or ``None``.
        error: ``(H, W)`` in [0, 1], not finite where no right view sees the pixel, or ``None``.
        unit: of the depth, as in ``depth_figure``.

    Returns:
        RGB picture, two cells a row.
    """
    every = max(1, depth_m.shape[1] // (ENOUGH * CELL_WIDTH))
    if every > 1:  # a cell shows no more of a large picture
        depth_m, left_01 = depth_m[::every, ::every], left_01[::every, ::every]
        confidence, error = (None if v is None else v[::every, ::every] for v in (confidence, error))
    depth = depth_figure(depth_m, unit=unit)
    enlarged = math.ceil(FIGURE_MIN_HEIGHT / depth_m.shape[0])
    cells = [_beside_bar(left_01, depth, enlarged * depth_m.shape[1]), depth]
    titles = ["left image", "depth"]
    if confidence is not None:
        cells.append(share_figure(confidence, "within 10 %", 1.0))
        titles.append("confidence")
    if error is not None:
        known = error[np.isfinite(error)]
        top = max(LEAST_ERROR, float(np.quantile(known, 0.98))) if known.size else LEAST_ERROR
        cells.append(share_figure(error, "difference", top))
        titles.append("photometric error (grey: not seen from the right)")
    return grid(cells, titles, columns=2, cell_width=CELL_WIDTH)
