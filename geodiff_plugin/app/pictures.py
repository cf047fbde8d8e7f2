"""Pictures of a result for the page: coloured maps with legends, and marks on a photograph."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin.app.measure import Reading, distance_m
from geodiff_plugin.plotting import colour_depth, colour_share, depth_range, ticks

LEGEND_STOPS = 24
MARK = "#c2410c"


def metres(value: float, spread: float | None = None) -> str:
    """``2.31 m`` or ``2.31 ± 0.07 m``; to the millimetre where the spread is below half a centimetre."""
    decimals = 3 if spread is not None and spread < 0.005 else 2
    return f"{value:.{decimals}f}{'' if spread is None else f' ± {spread:.{decimals}f}'} m"


def colour_relative(values: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """``(H, W, 3)`` uint8: a map without a unit, its near end in the colour of the metric map's near end.

    Args:
        values: ``(H, W)`` depth, inverse depth or the like, up to scale and shift.
        depth_m: ``(H, W)`` metres; tells which end is near.
    """
    low, high = np.percentile(values, (2, 98))
    share = np.clip((values - low) / max(high - low, 1e-9), 0, 1)
    if np.corrcoef(share.ravel(), depth_m.ravel())[0, 1] < 0:
        share = 1 - share
    return colour_depth(np.exp(share), near=1.0, far=math.e)  # exp: the colours go with the logarithm


def _legend(colours: np.ndarray, marks: Sequence[tuple[float, str]], caption: str) -> str:
    stops = ", ".join(
        f"rgb({r},{g},{b}) {100 * i / (len(colours) - 1):.1f}%" for i, (r, g, b) in enumerate(colours)
    )
    words = "".join(f'<span style="left:{100 * share:.2f}%">{text}</span>' for share, text in marks)
    bar = f"background:linear-gradient(90deg, {stops})"
    return (
        f'<div class="legend"><div class="legend-bar" style="{bar}"></div>'
        f'<div class="legend-ticks">{words}</div><div class="legend-caption">{caption}</div></div>'
    )


def legend_of_depth(depth_m: np.ndarray) -> str:
    """A bar from near to far with depths in metres under it, as HTML."""
    near, far = depth_range(depth_m)
    shares = np.linspace(0, 1, LEGEND_STOPS)
    colours = colour_depth((near * (far / near) ** shares)[None], near=near, far=far)[0]
    marks = [(math.log(value / near) / math.log(far / near), f"{value:g} m") for value in ticks(near, far, 7)]
    return _legend(colours, marks, "depth in metres; equal steps of colour are equal factors")


def legend_of_share(most: float, caption: str) -> str:
    """A bar from 0 to ``most`` with percentages under it, as HTML."""
    colours = colour_share(np.linspace(0, 1, LEGEND_STOPS)[None])[0]
    return _legend(colours, [(s, f"{100 * s * most:.0f} %") for s in (0, 0.25, 0.5, 0.75, 1)], caption)


def marked(picture: np.ndarray, points: Sequence[tuple[tuple[int, int], str, Reading]]) -> np.ndarray:
    """A copy of a picture with the points that were chosen, and the distance of every two of them.

    Args:
        picture: ``(h, w, 3)`` uint8.
        points: ``(pixel of this picture, name, reading)``; the first two are a segment, and so on.
    """
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    unit = max(image.size) / 100
    radius, font = max(3.0, 0.8 * unit), ImageFont.load_default(size=max(11.0, 2.8 * unit))
    segments = list(zip(points[::2], points[1::2], strict=False))
    for (a, _, _), (b, _, _) in segments:
        draw.line([a, b], fill="black", width=max(3, round(0.7 * unit)))
        draw.line([a, b], fill="white", width=max(1, round(0.3 * unit)))
    for (x, y), name, _ in points:
        box = (x - radius, y - radius, x + radius, y + radius)
        draw.ellipse(box, fill=MARK, outline="white", width=max(1, round(0.25 * unit)))
        _label(draw, (x, y - 2.6 * radius), name, font)
    for (a, _, first), (b, _, second) in segments:
        middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 2.2 * radius)
        _label(draw, middle, f"{distance_m(first, second)[0]:.2f} m", font)
    return np.asarray(image)


def _label(
    draw: ImageDraw.ImageDraw,
    centre: tuple[float, float],
    text: str,
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
) -> None:
    left, top, right, bottom = draw.textbbox(centre, text, font=font, anchor="mm")
    draw.rounded_rectangle((left - 3, top - 2, right + 3, bottom + 2), radius=3, fill=(20, 20, 20))
    draw.text(centre, text, font=font, fill="white", anchor="mm")
