"""Pictures of depth maps: colours and a legend in metres, with Pillow alone.

Data flow: depth in metres, mask -> RGB picture.
Paper: Figures of S5 (coloured depth).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.depth import row_strips

__all__ = ["WHITE", "colour_depth", "depth_figure", "depth_range", "text_font", "ticks", "write_centred"]

# The map "plasma" of matplotlib (public domain, CC0), at 17 equal steps. Its lightness grows evenly, so equal
# steps look equal; far is dark blue, near is bright yellow, and no entry is near the grey of "no depth".
PLASMA = (
    "0d0887 310597 4c02a1 6600a7 7e03a8 9511a1 aa2395 bc3587 cc4778 "
    "da5a6a e66c5c f0804e f89540 fdac33 fdc527 f8df25 f0f921"
)
TABLE = np.array([[int(word[i : i + 2], 16) for i in (0, 2, 4)] for word in PLASMA.split()], dtype=np.float64)
GREY = (128, 128, 128)
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
#: Share of the pixels beyond either end of the colours, so that one outlier does not flatten the rest.
TAIL_PERCENT = 2.0
#: The ends of the colours are those of so many pixels of a larger map.
MOST_FOR_RANGE = 1 << 22
#: Maps lower than this are enlarged in a figure, so that the legend can be read.
FIGURE_MIN_HEIGHT = 256


def _plain(values: np.ndarray) -> np.ndarray:
    """``(H, W)`` of ``(1, H, W, 1)``, ``(1, 1, H, W)`` and the like."""
    while values.ndim > 2 and values.shape[0] == 1:
        values = values[0]
    while values.ndim > 2 and values.shape[-1] == 1:
        values = values[..., 0]
    return values


def _as_map(depth_m: Any, valid: Any) -> tuple[np.ndarray, np.ndarray]:
    depth_m, valid = (
        v.detach().cpu().numpy() if isinstance(v, torch.Tensor) else v for v in (depth_m, valid)
    )
    depth_m = _plain(np.asarray(depth_m))
    if depth_m.ndim != 2:
        bad_value("depth_m", "one map of shape (H, W)", f"shape {depth_m.shape}")
    use = np.isfinite(depth_m) & (depth_m > 0)
    if valid is not None:
        mask = _plain(np.asarray(valid, dtype=bool))
        if mask.shape != depth_m.shape:
            bad_value("valid", f"of shape {depth_m.shape} as depth_m", f"shape {mask.shape}")
        use &= mask
    return depth_m, use


def depth_range(
    depth_m: Any, valid: Any = None, near: float | None = None, far: float | None = None
) -> tuple[float, float]:
    """The depths at the two ends of the colours.

    Args:
        depth_m: ``(H, W)`` metres, numpy or torch.
        valid: ``(H, W)`` boolean; pixels that are not finite or not above 0 never count.
        near: nearest depth in metres, > 0; ``None`` takes the 2nd percentile.
        far: farthest depth in metres; ``None`` takes the 98th percentile.

    Returns:
        ``(near, far)`` metres with ``0 < near < far``.

    Raises:
        ValueError: ``near`` or ``far`` not above 0 and finite, or ``near >= far`` when both are given.
    """
    for name, value in (("near", near), ("far", far)):
        if value is not None and not (0 < value < math.inf):
            bad_value(name, "a depth in metres above 0", value)
    if near is not None and far is not None and near >= far:
        bad_value("near, far", "near < far, in metres", f"{near}, {far}")
    depth_m, use = _as_map(depth_m, valid)
    every = math.isqrt(max(1, depth_m.size // MOST_FOR_RANGE))
    if use[::every, ::every].any():
        depth_m, use = depth_m[::every, ::every], use[::every, ::every]
    known = depth_m[use].astype(np.float64)
    low, high = np.percentile(known, (TAIL_PERCENT, 100 - TAIL_PERCENT)) if len(known) else (1.0, 2.0)
    low, high = (low if near is None else near), (high if far is None else far)
    if high <= low * (1 + 1e-6):  # a flat map, or a given end beyond the data: open the other end a little
        low, high = (low, low * 1.01) if far is None else (high / 1.01, high)
    return float(low), float(high)


def _shade(depth_m: np.ndarray, near: float, far: float) -> np.ndarray:
    """``(..., 3)`` uint8; logarithmic, so a step of colour is a step of relative depth, as in AbsRel."""
    position = np.log(far / np.clip(depth_m, near, far)) / np.log(far / near) * (len(TABLE) - 1)
    lower = np.minimum(position.astype(int), len(TABLE) - 2)
    share = (position - lower)[..., None]
    return np.rint(TABLE[lower] * (1 - share) + TABLE[lower + 1] * share).astype(np.uint8)


def colour_depth(
    depth_m: Any, valid: Any = None, near: float | None = None, far: float | None = None
) -> np.ndarray:
    """Colour a depth map: near is yellow, far is dark blue, unknown is grey.

    Args:
        depth_m: ``(H, W)`` metres, numpy or torch (axes of length 1 are dropped).
        valid: ``(H, W)`` boolean; ``None`` means wherever the depth is finite and above 0.
        near: depth of the last colour, metres; ``None`` takes the 2nd percentile.
        far: depth of the first colour, metres; ``None`` takes the 98th percentile.

    Returns:
        ``(H, W, 3)`` uint8 RGB; the colour goes with the logarithm of depth.

    Raises:
        ValueError: not one map, a mask of another shape, or a bad ``near``, ``far``.
    """
    near, far = depth_range(depth_m, valid, near, far)
    depth_m, use = _as_map(depth_m, valid)
    picture = np.empty((*depth_m.shape, 3), np.uint8)
    for rows in row_strips(*depth_m.shape):
        known = use[rows]
        colours = _shade(np.where(known, depth_m[rows].astype(np.float64), far), near, far)
        picture[rows] = np.where(known[..., None], colours, np.uint8(GREY[0]))
    return picture


def ticks(near: float, far: float, most: int = 8) -> list[float]:
    """Round depths in ``[near, far]`` for a logarithmic scale.

    Args:
        near: metres, > 0.
        far: metres, > near.
        most: at most so many ticks.

    Returns:
        Rising depths: 1, 2, 5 (or denser) times powers of ten over wide ranges, equal steps over narrow ones.
    """
    if far / near >= 4:
        powers = range(math.floor(math.log10(near)), math.ceil(math.log10(far)) + 1)
        for digits in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)):
            inside = [d * 10.0**power for power in powers for d in digits if near <= d * 10.0**power <= far]
            if len(inside) >= 4:
                return inside[:: math.ceil(len(inside) / most)]
    magnitude = 10.0 ** math.floor(math.log10((far - near) / most))
    for step in (magnitude * factor for factor in (1, 2, 5, 10)):
        inside = [i * step for i in range(math.ceil(near / step - 1e-9), math.floor(far / step + 1e-9) + 1)]
        if len(inside) <= most:
            return [float(f"{value:.6g}") for value in inside]
    return [near, far]


def text_font(size: int) -> Any:
    """Pillow's own font at a size in pixels."""
    return ImageFont.load_default(size=size)


def _legend(height: int, near: float, far: float, unknown: bool, unit: str | None = "m") -> Image.Image:
    """Colour bar with far on top, tick labels in metres, and a grey key where pixels are unknown."""
    size = max(12, height // 26)
    font, bar, gap = text_font(size), max(14, height // 24), size // 2
    picture = Image.new("RGB", (gap + bar + 5 * size, height), WHITE)
    draw = ImageDraw.Draw(picture)
    top, bottom = 2 * size, height - size - (2 * size if unknown else 0)
    draw.text((gap, size // 3), "no unit" if unit is None else f"depth, {unit}", font=font, fill=BLACK)
    shares = np.linspace(1.0, 0.0, bottom - top)
    shades = _shade(near * (far / near) ** shares, near, far)
    picture.paste(Image.fromarray(np.repeat(shades[:, None], bar, axis=1)), (gap, top))
    draw.rectangle((gap, top, gap + bar - 1, bottom - 1), outline=BLACK)
    for value in ticks(near, far):
        y = bottom - 1 - math.log(value / near) / math.log(far / near) * (bottom - 1 - top)
        draw.line((gap + bar, y, gap + bar + size // 3, y), fill=BLACK)
        draw.text((gap + bar + size // 2, y), f"{value:g}", font=font, fill=BLACK, anchor="lm")
    if unknown:
        box = (gap, height - 2 * size, gap + bar - 1, height - size - 1)
        draw.rectangle(box, fill=GREY, outline=BLACK)
        draw.text((gap + bar + size // 2, height - 1.5 * size), "none", font=font, fill=BLACK, anchor="lm")
    return picture


def depth_figure(
    depth_m: Any,
    valid: Any = None,
    near: float | None = None,
    far: float | None = None,
    title: str | None = None,
    unit: str | None = "m",
) -> Image.Image:
    """A coloured depth map beside a colour bar in metres.

    Args:
        depth_m: ``(H, W)`` metres, numpy or torch.
        valid: ``(H, W)`` boolean; the rest is drawn grey.
        near: as in ``colour_depth``.
        far: as in ``colour_depth``.
        title: a line above it.
        unit: ``"m"``, or ``None`` for a depth without one, as the legend then says.

    Returns:
        RGB picture; small maps are enlarged by a whole factor, so pixels stay squares.

    Raises:
        ValueError: as ``colour_depth``.
    """
    near, far = depth_range(depth_m, valid, near, far)
    use = _as_map(depth_m, valid)[1]
    picture = Image.fromarray(colour_depth(depth_m, valid, near, far))
    factor = math.ceil(FIGURE_MIN_HEIGHT / picture.height)
    if factor > 1:
        picture = picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST)
    legend = _legend(picture.height, near, far, not use.all(), unit)
    head = 0 if title is None else 2 * max(12, picture.height // 26)
    figure = Image.new("RGB", (picture.width + legend.width, picture.height + head), WHITE)
    figure.paste(picture, (0, head))
    figure.paste(legend, (picture.width, head))
    if title is not None:
        write_centred(figure, title, (0, 0, figure.width, head), head // 2)
    return figure


def write_centred(picture: Image.Image, text: str, box: tuple[int, int, int, int], size: int) -> None:
    """Text centred in a box, in a smaller font where it is too long."""
    draw, width = ImageDraw.Draw(picture), box[2] - box[0]
    while size > 7 and draw.textlength(text, font=text_font(size)) > width:
        size -= 1
    draw.text(
        ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), text, font=text_font(size), fill=BLACK, anchor="mm"
    )
