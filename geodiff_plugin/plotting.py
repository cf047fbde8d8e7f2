"""Draws depth maps (S5): colours and legends, contact sheets, overviews, videos; no global state.

Layer 2: imports ``formats`` and below; imported by ``jobs``, ``evaluation``, ``app`` and ``cli``.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin._internal.checks import (
    InputError,
    InputFileError,
    bad_value,
    check_number,
    check_positive,
)
from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.formats import atomic_path, in_8_bits, reason_of

#: Map ``(H, W)``, or image ``(H, W, 3)``.
Map = np.ndarray
#: Colour map for depth. Lightness is uniform, so equal steps look equal, and no colour is near the grey of
#: unknown.
DEPTH_COLOURS = "plasma"
#: Colour map for fractions and probabilities, also uniform, and distinguishable from depth.
FRACTION_COLOURS = "YlGnBu_r"
GREY = 128
#: Number of colours in a colour map, more than an 8-bit image can show.
SHADES = 1024
#: Fraction of the colour range of the previous frame of a video that is kept.
KEPT_RANGE = 0.9
#: Percentage of pixels beyond either end of the colours, so that outliers do not compress the rest.
TAIL_PERCENT = 2.0
#: Maximum number of pixels that determine the ends of the colours, of a map or of all maps of a video.
MAX_RANGE_PIXELS = 1 << 22
#: Minimum height of a figure; smaller maps are enlarged so that the legend is legible.
FIGURE_MIN_HEIGHT = 256
#: Width of an overview's cell, pixels; larger maps are subsampled to at least twice that.
CELL_WIDTH = 480
#: Distance between the cells of a contact sheet, pixels.
GAP = 6
#: Size of the letters of a colour bar next to a contact sheet, pixels.
BAR_LETTERS = 13
#: Minimum upper end of the photometric error's colours, which is its 98 % quantile.
MIN_ERROR = 0.05
VIDEO_SUFFIXES = (".mp4", ".webp", ".gif")
#: Font of legends and titles, which supports most alphabets.
FONT = "DejaVuSans.ttf"


def _as_map(values: Any) -> np.ndarray:
    """Convert a tensor or array whose other axes have length 1 to ``(H, W)``."""
    array = np.asarray(values.detach().cpu() if isinstance(values, torch.Tensor) else values)
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2:
        bad_value("depth_m", "one map of shape (H, W)", f"shape {array.shape}")
    return array


def _known(depth_m: np.ndarray) -> np.ndarray:
    return np.isfinite(depth_m) & (depth_m > 0)


def depth_range(depth_m: Any, near: float | None = None, far: float | None = None) -> tuple[float, float]:
    """Return the depths at the ends of the colours, ``0 < near < far``, by default without 2 % per side."""
    for name, value in (("near", near), ("far", far)):
        if value is not None:
            check_positive(value, name, "metres")
    if near is not None and far is not None and near >= far:
        bad_value("near (--near)", "less than far (--far)", f"{near:g} and {far:g}")
    depth_m = _as_map(depth_m)
    use = _known(depth_m)
    every = math.isqrt(max(1, depth_m.size // MAX_RANGE_PIXELS))
    if use[::every, ::every].any():
        depth_m, use = depth_m[::every, ::every], use[::every, ::every]
    used = depth_m[use].astype(np.float64)
    low, high = np.percentile(used, (TAIL_PERCENT, 100 - TAIL_PERCENT)) if len(used) else (1.0, 2.0)
    low, high = (low if near is None else near), (high if far is None else far)
    if high <= low * (1 + 1e-6):  # a flat map, or a given end beyond the data: widen the other end slightly
        low, high = (low, low * 1.01) if far is None else (high / 1.01, high)
    return float(low), float(high)


def measured_range(
    measured_m: Any, depth_m: Any, near: float | None = None, far: float | None = None
) -> tuple[float, float]:
    """Return the ``depth_range`` of measured depths, or of all ``depth_m`` if none was measured.

    ``measured_m`` is ``depth_m`` with 0 where it is invalid or too far to be measured, as in the sky, which
    would leave few colours for the rest.
    """
    return depth_range(measured_m if (measured_m > 0).any() else depth_m, near, far)


class SmoothedRange:
    """The range of the colours of a video, which changes slowly, so that colours do not flicker."""

    def __init__(self) -> None:
        self._range: np.ndarray | None = None

    def update(self, measured_m: np.ndarray, depth_m: np.ndarray) -> tuple[float | None, float | None]:
        """Include the depth of the next frame, as in ``measured_range``.

        Returns:
            Nearest and farthest depth, ``None`` before any depth is known.
        """
        if (depth_m > 0).any():
            current = np.array(measured_range(measured_m, depth_m))
            kept = current if self._range is None else self._range
            self._range = KEPT_RANGE * kept + (1 - KEPT_RANGE) * current
        return (None, None) if self._range is None else (float(self._range[0]), float(self._range[1]))


def ticks(near: float, far: float, most: int = 8) -> list[float]:
    """Return up to ``most`` increasing round depths in ``[near, far]`` for a log scale."""
    from matplotlib.ticker import MaxNLocator

    if far / near >= 4:
        powers = 10.0 ** np.arange(math.floor(math.log10(near)), math.ceil(math.log10(far)) + 1)
        for digits in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)):
            inside = [float(value) for value in np.outer(powers, digits).flat if near <= value <= far]
            if len(inside) >= 4:
                return inside[:: math.ceil(len(inside) / most)]
    values = MaxNLocator(most - 1, steps=[1, 2, 5, 10]).tick_values(near, far)
    return [float(f"{value:.6g}") for value in values if near <= value <= far]


@functools.cache
def _table(colours: str) -> np.ndarray:
    """Return a colour map, ``(SHADES + 1, 3)`` uint8, followed by the grey of unknown pixels."""
    import matplotlib

    shades = matplotlib.colormaps[colours].resampled(SHADES)(np.arange(SHADES), bytes=True)[:, :3]
    return np.vstack([shades, np.full((1, 3), GREY, np.uint8)])


def _coloured(
    values: np.ndarray, use: np.ndarray, position_of: Callable[[Any], Any], colours: str
) -> np.ndarray:
    """Colour a map, ``(H, W, 3)`` uint8; ``position_of`` maps each value to [0, 1] on the colour map."""
    rgb = np.empty((*values.shape, 3), np.uint8)
    for rows in row_strips(*values.shape):
        known = np.where(use[rows], values[rows], 1.0).astype(np.float64)
        shades = np.clip(position_of(known) * SHADES, 0, SHADES - 1).astype(np.intp)
        rgb[rows] = np.take(_table(colours), np.where(use[rows], shades, SHADES), axis=0)
    return rgb


def colour_depth(depth_m: Any, near: float | None = None, far: float | None = None) -> np.ndarray:
    """Colour a depth map by its log, ``(H, W, 3)`` uint8: near is yellow, far dark blue, unknown grey."""
    near, far = depth_range(depth_m, near, far)
    depth_m = _as_map(depth_m)
    scale = math.log(far / near)
    return _coloured(depth_m, _known(depth_m), lambda z: np.log(far / z) / scale, DEPTH_COLOURS)


def colour_fraction(values: np.ndarray, top: float = 1.0) -> np.ndarray:
    """Colour values ``(H, W)`` from 0 (dark) to ``top`` (light), ``(H, W, 3)`` uint8; non-finite is grey."""
    values = np.asarray(values)
    return _coloured(values, np.isfinite(values), lambda v: v / top, FRACTION_COLOURS)


@functools.lru_cache
def _font(letters: float) -> ImageFont.FreeTypeFont:
    """Load matplotlib's bundled font with letters of the given size, pixels."""
    import matplotlib

    return ImageFont.truetype(os.path.join(matplotlib.get_data_path(), "fonts", "ttf", FONT), letters)


@dataclass(frozen=True)
class _Legend:
    """A legend next to an image: a colour bar with labels, and a grey key.

    Attributes:
        height: height of the image, pixels.
        letters: size of the letters, pixels.
        colours: name of a colour map.
        label: text above the bar.
        marks: positions on the bar in [0, 1], each with its text.
        unknown: whether there is a key for the grey of unknown pixels.
    """

    height: int
    letters: int
    colours: str
    label: str
    marks: tuple[tuple[float, str], ...]
    unknown: bool


def _draw(legend: _Legend) -> np.ndarray:
    """Draw a legend, ``(H, W, 3)`` uint8."""
    high = legend.height
    size = legend.letters
    font = _font(legend.letters)
    left = size // 2
    right = size // 2 + max(14, high // 24)
    top = 2 * size
    bottom = high - size * (3 if legend.unknown else 1)
    line = max(1, size // 12)
    sheet = Image.new("RGB", (right + 5 * size, high), "white")
    drawn = ImageDraw.Draw(sheet)
    ramp = Image.fromarray(_table(legend.colours)[SHADES - 1 :: -1, None])
    sheet.paste(ramp.resize((right - left, bottom - top), Image.Resampling.NEAREST), (left, top))
    drawn.rectangle((left, top, right - 1, bottom - 1), outline="black", width=line)
    for fraction, text in legend.marks:
        y = bottom - fraction * (bottom - top)
        drawn.line((right, y, right + size // 3, y), "black", line)
        drawn.text((right + 7 * size // 12, y), text, "black", font, anchor="lm")
    drawn.text((left, 0.9 * size), legend.label, "black", font, anchor="lm")
    if legend.unknown:
        drawn.rectangle((left, high - 2 * size, right - 1, high - size - 1), (GREY,) * 3, "black", line)
        drawn.text((right + size // 2, high - 1.5 * size), "none", "black", font, anchor="lm")
    return np.asarray(sheet)


def _figure(
    rgb: np.ndarray, colours: str, label: str, marks: Sequence[tuple[float, str]], unknown: bool
) -> Image.Image:
    """Place an image next to its colour bar with labels; with a grey key if pixels are ``unknown``."""
    factor = math.ceil(FIGURE_MIN_HEIGHT / len(rgb))  # an integer, so that pixels stay square
    if factor > 1:
        rgb = rgb.repeat(factor, axis=0).repeat(factor, axis=1)
    legend = _Legend(len(rgb), max(12, len(rgb) // 26), colours, label, tuple(marks), unknown)
    return Image.fromarray(np.hstack([rgb, _draw(legend)]))


def depth_figure(
    depth_m: Any, near: float | None = None, far: float | None = None, unit: str | None = "m"
) -> Image.Image:
    """Draw a coloured depth map, enlarged if small, with a colour bar; ``unit=None``: without unit."""
    near, far = depth_range(depth_m, near, far)
    label = "no unit" if unit is None else f"depth, {unit}"
    unknown = not _known(_as_map(depth_m)).all()
    return _figure(
        colour_depth(depth_m, near, far), f"{DEPTH_COLOURS}_r", label, _depth_marks(near, far), unknown
    )


def _depth_marks(near: float, far: float) -> list[tuple[float, str]]:
    """Return the positions on a colour bar of round depths, with their text."""
    return [(math.log(z / near) / math.log(far / near), f"{z:g}") for z in ticks(near, far)]


def fraction_figure(values: np.ndarray, label: str, top: float) -> Image.Image:
    """Draw a map ``(H, W)`` of values from 0 to ``top`` (> 0) with a colour bar and its ``label``."""
    from matplotlib.ticker import MaxNLocator

    round_values = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0.0, top)
    marks = [(float(v / top), f"{v:.6g}") for v in round_values if 0 <= v <= top * (1 + 1e-9)]
    unknown = not np.isfinite(values).all()
    return _figure(colour_fraction(values, top), FRACTION_COLOURS, label, marks, unknown)


def as_rgb_image(image: Any) -> Image.Image:
    """Convert ``(H, W)`` or ``(H, W, 3)`` of uint8, bool or floats in [0, 1], or a PIL image, to RGB."""
    if isinstance(image, Image.Image):
        return image.convert("RGB")
    values = np.asarray(image)
    if values.dtype.kind in "fb":
        values = in_8_bits(np.nan_to_num(values.astype(np.float32, copy=False)))
    if values.dtype != np.uint8 or not (values.ndim == 2 or (values.ndim == 3 and values.shape[-1] == 3)):
        expected = "PIL, or (H, W) or (H, W, 3) of uint8, bool or [0, 1]"
        bad_value("images", expected, f"{values.dtype} {values.shape}")
    return Image.fromarray(values).convert("RGB")


def _heading(
    titles: Sequence[str], width: int, height: int, cell_width: int, image_width: int
) -> Image.Image:
    """Draw titles above the left ``image_width`` of the cells of a row; long ones in smaller letters."""
    sheet = Image.new("RGB", (width, height), "white")
    drawn = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        font = _font(min(15, 1.7 * image_width / max(1, len(title))))
        centre = GAP + k * (cell_width + GAP) + image_width / 2, height / 2
        drawn.text(centre, title, "black", font, anchor="mm")
    return sheet


def _depth_bar(height: int, near: float, far: float) -> Image.Image:
    """Draw the colour bar of depth maps of this height, in metres."""
    legend = _Legend(
        height, BAR_LETTERS, f"{DEPTH_COLOURS}_r", "depth, m", tuple(_depth_marks(near, far)), False
    )
    return Image.fromarray(_draw(legend))


def grid(
    images: Sequence[Any],
    titles: Sequence[str],
    *,
    columns: int | None = None,
    cell_width: int = 320,
    image_width: int | None = None,
    depth_ranges: Sequence[tuple[float, float] | None] = (),
) -> Image.Image:
    """Draw a contact sheet: images in a grid, each under its title, scaled to ``cell_width`` pixels.

    A row, with ``columns`` images (all, up to 4), is as high as its tallest image.

    Args:
        images: PIL images or arrays.
        titles: one per image.
        columns: number of images per row.
        cell_width: width of the scaled images, pixels.
        image_width: part of this width above which titles are centred, if cells include colour bars.
        depth_ranges: nearest and farthest depth of the colours of each row, metres, for a bar at its end;
            ``None`` for a row without one.
    """
    rgb_images = [as_rgb_image(image) for image in images]
    if not rgb_images or len(titles) != len(rgb_images):
        bad_value("images", "one or more, each with a title", f"{len(rgb_images)}, {len(titles)} titles")
    columns = columns or min(len(rgb_images), 4)
    head = 24
    cells = [p.resize((cell_width, max(1, round(p.height * cell_width / p.width)))) for p in rgb_images]
    rows = [cells[start : start + columns] for start in range(0, len(cells), columns)]
    heights = [head + GAP + max(cell.height for cell in row) for row in rows]
    legends = {
        number: _depth_bar(heights[number] - head - GAP, *ends)
        for number, ends in enumerate(depth_ranges[: len(rows)])
        if ends is not None
    }
    wide = GAP + columns * (cell_width + GAP)
    top = GAP
    size = wide + max((legend.width for legend in legends.values()), default=0), GAP + sum(heights)
    sheet = Image.new("RGB", size, "white")
    named = iter(titles)
    for number, (row, height) in enumerate(zip(rows, heights, strict=True)):
        names = list(itertools.islice(named, len(row)))
        for k, cell in enumerate(row):
            sheet.paste(cell, (GAP + k * (cell_width + GAP), top + head))
        sheet.paste(_heading(names, wide, head, cell_width, image_width or cell_width), (0, top))
        if number in legends:
            sheet.paste(legends[number], (wide, top + head))
        top += height
    return sheet


def shrunk(figure: Image.Image) -> Image.Image:
    """Downscale a figure to the width of an overview's cell."""
    size = CELL_WIDTH, max(1, round(figure.height * CELL_WIDTH / figure.width))
    return figure.resize(size, reducing_gap=2.0)


def overview(
    left_01: Map, depth: Image.Image, confidence: Image.Image | None, error: Map | None
) -> Image.Image:
    """Draw left image in [0, 1], depth, confidence and photometric error (non-finite if unseen), 2 per row.

    ``depth`` and ``confidence`` are ``shrunk`` figures; ``confidence`` and ``error`` are optional.
    """
    every = max(1, left_01.shape[1] // (2 * CELL_WIDTH))
    left = as_rgb_image(left_01[::every, ::every])
    padded = Image.new("RGB", depth.size, "white")  # as wide as a map with its bar
    left_width = round(left.width * depth.height / left.height)
    padded.paste(left.resize((left_width, depth.height)), (0, 0))
    cells = {"left image": padded, "depth": depth}
    if confidence is not None:
        cells["confidence: within 10 % of ground truth"] = confidence
    if error is not None:
        error = error[::every, ::every]
        finite = error[np.isfinite(error)]
        top = max(MIN_ERROR, float(np.quantile(finite, 0.98))) if finite.size else MIN_ERROR
        cells["photometric error (grey: not seen from the right)"] = fraction_figure(error, "difference", top)
    image_width = round(CELL_WIDTH * left_width / depth.width)
    return grid(list(cells.values()), list(cells), columns=2, cell_width=CELL_WIDTH, image_width=image_width)


def depth_frames(
    depths_m: Sequence[Map], near: float | None = None, far: float | None = None, unit: str | None = "m"
) -> Iterator[Image.Image]:
    """Draw one image per map ``(H, W)``, in the same colours, lazily."""
    shapes = set()
    samples = []
    for depth_m in depths_m:  # one pass: a map may be read from its file at every access
        every = max(1, math.ceil(len(depths_m) * depth_m.size / (4 * MAX_RANGE_PIXELS)))
        shapes.add(depth_m.shape)
        samples.append(np.asarray(depth_m).reshape(-1)[::every].copy())
    if len(shapes) != 1:
        bad_value("depths_m", "at least one map, all of one shape", sorted(shapes) or "none")
    near, far = depth_range(np.concatenate(samples)[None], near=near, far=far)
    return (depth_figure(depth_m, near=near, far=far, unit=unit) for depth_m in depths_m)


def check_video(path: str | os.PathLike[str], fps: float) -> None:
    """Raise ``ValueError`` for a suffix not in ``VIDEO_SUFFIXES``, or ``fps`` outside [0.1, 120]."""
    if Path(path).suffix.lower() not in VIDEO_SUFFIXES:
        bad_value("the video", f"a file with a suffix in {', '.join(VIDEO_SUFFIXES)}", Path(path).name)
    check_number(fps, "fps", 0.1, 120)


def _write_mp4(path: Path, frames: Iterable[Image.Image], fps: float) -> None:
    """Write frame by frame; H.264 and similar codecs need even sides."""
    writer = cv2.VideoWriter()
    try:
        for frame in frames:
            width, height = size = tuple(side // 2 * 2 for side in frame.size)
            opened = writer.isOpened() or writer.open(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
            if not opened:
                raise InputFileError("the video must have a format that OpenCV can write; got .mp4.")
            writer.write(np.ascontiguousarray(np.asarray(frame.convert("RGB"))[:height, :width, ::-1]))
    finally:  # on Windows an open file can be neither renamed nor removed
        writer.release()


def write_depth_video(path: str | os.PathLike[str], frames: Iterable[Image.Image], fps: float = 10.0) -> None:
    """Write frames of one size as .mp4 (by OpenCV), .webp or .gif, atomically.

    An MP4 is written frame by frame; for other formats Pillow needs all frames in memory. ``ValueError`` as
    in ``check_video``, and without frames; ``OSError`` if the file cannot be written.
    """
    check_video(path, fps)
    rest = iter(frames)
    kind = Path(path).suffix.lower()
    first = next(rest, None)
    if first is None:
        bad_value("frames", "at least one image", "none")
    more: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0}
    more |= {"quality": 85} if kind == ".webp" else {}
    try:
        with atomic_path(path) as temporary:
            if kind == ".mp4":
                _write_mp4(temporary, itertools.chain([first], rest), fps)
                return
            with open(temporary, "wb") as file:  # Pillow leaves its own file open after a Ctrl-C
                first.save(file, kind[1:], save_all=True, append_images=rest, **more)
    except InputError:  # about an image, or about the file, which it names
        raise
    except OSError as error:
        message = f"the video must be a writable file; got {path} ({reason_of(error)})."
        raise InputFileError(message) from error
