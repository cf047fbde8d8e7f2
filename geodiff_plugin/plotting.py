"""Pictures of depth maps (S5): colours and legends, contact sheets, overviews, videos; no global state."""

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

from geodiff_plugin._checks import InputError, InputFileError, bad_value, check_number, check_positive
from geodiff_plugin._strips import row_strips
from geodiff_plugin.formats.clouds import in_8_bits
from geodiff_plugin.formats.out import atomic_path, reason_of

#: ``(H, W)``, of a picture ``(H, W, 3)``.
Map = np.ndarray
#: Colours of depth. Lightness grows evenly, so equal steps look equal; none is near the grey of "unknown".
DEPTH_COLOURS = "plasma"
#: Colours of shares and probabilities, likewise, and not to be taken for depth.
SHARE_COLOURS = "YlGnBu_r"
GREY = 128
#: Steps of a colour map: more than a picture of 8 bits can show of one colour.
SHADES = 1024
#: Share of the pixels beyond either end of the colours, so that one outlier does not flatten the rest.
TAIL_PERCENT = 2.0
#: The ends of the colours are those of so many pixels of a larger map, or of all maps of a video.
MOST_FOR_RANGE = 1 << 22
#: Maps lower than this are enlarged in a figure, so that the legend can be read.
FIGURE_MIN_HEIGHT = 256
#: Of a picture in an overview; larger maps are thinned to no less than twice that.
CELL_WIDTH = 480
#: The colours of the photometric error end at its 98 % quantile, and not below this.
LEAST_ERROR = 0.05
VIDEO_SUFFIXES = (".mp4", ".webp", ".gif")
#: The font of legends and titles, which has the letters of most alphabets.
FONT = "DejaVuSans.ttf"


def _as_map(values: Any) -> np.ndarray:
    """``(H, W)`` of a tensor or array whose other axes have length 1."""
    array = np.asarray(values.detach().cpu() if isinstance(values, torch.Tensor) else values)
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2:
        bad_value("depth_m", "one map of shape (H, W)", f"shape {array.shape}")
    return array


def _known(depth_m: np.ndarray) -> np.ndarray:
    return np.isfinite(depth_m) & (depth_m > 0)


def depth_range(depth_m: Any, near: float | None = None, far: float | None = None) -> tuple[float, float]:
    """The depths at the ends of the colours, ``0 < near < far``, by default without 2 % on either side."""
    for name, value in (("near", near), ("far", far)):
        if value is not None:
            check_positive(value, name, "metres")
    if near is not None and far is not None and near >= far:
        bad_value("near (--near)", "less than far (--far)", f"{near:g} and {far:g}")
    depth_m = _as_map(depth_m)
    use = _known(depth_m)
    every = math.isqrt(max(1, depth_m.size // MOST_FOR_RANGE))
    if use[::every, ::every].any():
        depth_m, use = depth_m[::every, ::every], use[::every, ::every]
    used = depth_m[use].astype(np.float64)
    low, high = np.percentile(used, (TAIL_PERCENT, 100 - TAIL_PERCENT)) if len(used) else (1.0, 2.0)
    low, high = (low if near is None else near), (high if far is None else far)
    if high <= low * (1 + 1e-6):  # a flat map, or a given end beyond the data: open the other end a little
        low, high = (low, low * 1.01) if far is None else (high / 1.01, high)
    return float(low), float(high)


def ticks(near: float, far: float, most: int = 8) -> list[float]:
    """At most ``most`` rising round depths in ``[near, far]`` for a logarithmic scale, ``0 < near < far``."""
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
    """``(SHADES + 1, 3)`` uint8 of a colour map, and last the grey of what is unknown."""
    import matplotlib

    shades = matplotlib.colormaps[colours].resampled(SHADES)(np.arange(SHADES), bytes=True)[:, :3]
    return np.vstack([shades, np.full((1, 3), GREY, np.uint8)])


def _coloured(
    values: np.ndarray, use: np.ndarray, share_of: Callable[[Any], Any], colours: str
) -> np.ndarray:
    """``(H, W, 3)`` uint8 of a map; ``share_of`` tells each value's place among the colours."""
    picture = np.empty((*values.shape, 3), np.uint8)
    for rows in row_strips(*values.shape):
        known = np.where(use[rows], values[rows], 1.0).astype(np.float64)
        shades = np.clip(share_of(known) * SHADES, 0, SHADES - 1).astype(np.intp)
        picture[rows] = np.take(_table(colours), np.where(use[rows], shades, SHADES), axis=0)
    return picture


def colour_depth(depth_m: Any, near: float | None = None, far: float | None = None) -> np.ndarray:
    """``(H, W, 3)`` uint8 of a depth map by its logarithm: near is yellow, far dark blue, unknown grey."""
    near, far = depth_range(depth_m, near, far)
    depth_m = _as_map(depth_m)
    scale = math.log(far / near)
    return _coloured(depth_m, _known(depth_m), lambda z: np.log(far / z) / scale, DEPTH_COLOURS)


def colour_share(values: np.ndarray, top: float = 1.0) -> np.ndarray:
    """``(H, W, 3)`` uint8 RGB of ``(H, W)`` values from 0 (dark) to ``top`` (light); not finite is grey."""
    values = np.asarray(values)
    return _coloured(values, np.isfinite(values), lambda v: v / top, SHARE_COLOURS)


@functools.lru_cache
def _font(letters: float) -> ImageFont.FreeTypeFont:
    """The font that comes with matplotlib, letters of so many pixels."""
    import matplotlib

    return ImageFont.truetype(os.path.join(matplotlib.get_data_path(), "fonts", "ttf", FONT), letters)


@dataclass(frozen=True)
class _Legend:
    """What stands beside a picture: a colour bar with texts at shares of it, and a grey key.

    Attributes:
        height: pixels, of the picture.
        letters: their size, pixels.
        colours: name of a colour map.
        label: above the bar.
        marks: shares of the bar, each with its text.
        unknown: whether there is a key to the grey of pixels that are unknown.
    """

    height: int
    letters: int
    colours: str
    label: str
    marks: tuple[tuple[float, str], ...]
    unknown: bool


def _drawn(legend: _Legend) -> np.ndarray:
    """``(H, W, 3)`` uint8 of a legend."""
    high, size, font = legend.height, legend.letters, _font(legend.letters)
    left, right = size // 2, size // 2 + max(14, high // 24)
    top, bottom, line = 2 * size, high - size * (3 if legend.unknown else 1), max(1, size // 12)
    sheet = Image.new("RGB", (right + 5 * size, high), "white")
    drawn = ImageDraw.Draw(sheet)
    ramp = Image.fromarray(_table(legend.colours)[SHADES - 1 :: -1, None])
    sheet.paste(ramp.resize((right - left, bottom - top), Image.Resampling.NEAREST), (left, top))
    drawn.rectangle((left, top, right - 1, bottom - 1), outline="black", width=line)
    for share, text in legend.marks:
        y = bottom - share * (bottom - top)
        drawn.line((right, y, right + size // 3, y), "black", line)
        drawn.text((right + 7 * size // 12, y), text, "black", font, anchor="lm")
    drawn.text((left, 0.9 * size), legend.label, "black", font, anchor="lm")
    if legend.unknown:
        drawn.rectangle((left, high - 2 * size, right - 1, high - size - 1), (GREY,) * 3, "black", line)
        drawn.text((right + size // 2, high - 1.5 * size), "none", "black", font, anchor="lm")
    return np.asarray(sheet)


def _figure(
    picture: np.ndarray, colours: str, label: str, marks: Sequence[tuple[float, str]], unknown: bool
) -> Image.Image:
    """A picture beside its colour bar with texts at shares of it; a grey key where pixels are ``unknown``."""
    factor = math.ceil(FIGURE_MIN_HEIGHT / len(picture))  # a whole one, so that pixels stay squares
    if factor > 1:
        picture = picture.repeat(factor, axis=0).repeat(factor, axis=1)
    legend = _Legend(len(picture), max(12, len(picture) // 26), colours, label, tuple(marks), unknown)
    return Image.fromarray(np.hstack([picture, _drawn(legend)]))


def depth_figure(
    depth_m: Any, near: float | None = None, far: float | None = None, unit: str | None = "m"
) -> Image.Image:
    """A coloured depth map, enlarged if small, beside a colour bar; no ``unit`` for a depth without."""
    near, far = depth_range(depth_m, near, far)
    marks = [(math.log(z / near) / math.log(far / near), f"{z:g}") for z in ticks(near, far)]
    label = "no unit" if unit is None else f"depth, {unit}"
    unknown = not _known(_as_map(depth_m)).all()
    return _figure(colour_depth(depth_m, near, far), f"{DEPTH_COLOURS}_r", label, marks, unknown)


def share_figure(values: np.ndarray, label: str, top: float) -> Image.Image:
    """A map ``(H, W)`` of something from 0 to ``top`` (> 0), beside a colour bar under its ``label``."""
    marks = [(share, f"{share * top:.2g}") for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    unknown = not np.isfinite(values).all()
    return _figure(colour_share(values, top), SHARE_COLOURS, label, marks, unknown)


def as_picture(image: Any) -> Image.Image:
    """RGB of a picture, ``(H, W)`` or ``(H, W, 3)`` of uint8, bool or floats in [0, 1], or as it is."""
    if isinstance(image, Image.Image):
        return image.convert("RGB")
    values = np.asarray(image)
    if values.dtype.kind in "fb":
        values = in_8_bits(np.nan_to_num(values.astype(np.float32, copy=False)))
    if values.dtype != np.uint8 or not (values.ndim == 2 or (values.ndim == 3 and values.shape[-1] == 3)):
        expected = "PIL, or (H, W) or (H, W, 3) of uint8, bool or [0, 1]"
        bad_value("images", expected, f"{values.dtype} {values.shape}")
    return Image.fromarray(values).convert("RGB")


def _heading(titles: Sequence[str], width: int, height: int, cell_width: int, gap: int) -> Image.Image:
    """Titles above the cells of a row; too long ones in smaller letters."""
    sheet = Image.new("RGB", (width, height), "white")
    drawn = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        font = _font(min(15, 1.7 * cell_width / max(1, len(title))))
        centre = gap + k * (cell_width + gap) + cell_width / 2, height / 2
        drawn.text(centre, title, "black", font, anchor="mm")
    return sheet


def grid(
    images: Sequence[Any], titles: Sequence[str], *, columns: int | None = None, cell_width: int = 320
) -> Image.Image:
    """A contact sheet: pictures side by side, each under its title, scaled to ``cell_width`` pixels.

    PIL images or arrays; a row, of ``columns`` (all, up to 4), is as high as its highest.
    """
    pictures = [as_picture(image) for image in images]
    if not pictures or len(titles) != len(pictures):
        bad_value("images", "one or more, each with a title", f"{len(pictures)}, {len(titles)} titles")
    columns, gap, head = columns or min(len(pictures), 4), 6, 24
    cells = [p.resize((cell_width, max(1, round(p.height * cell_width / p.width)))) for p in pictures]
    rows = [cells[start : start + columns] for start in range(0, len(cells), columns)]
    heights = [head + gap + max(cell.height for cell in row) for row in rows]
    wide, top = gap + columns * (cell_width + gap), gap
    sheet, named = Image.new("RGB", (wide, gap + sum(heights)), "white"), iter(titles)
    for row, height in zip(rows, heights, strict=True):
        names = list(itertools.islice(named, len(row)))
        for k, cell in enumerate(row):
            sheet.paste(cell, (gap + k * (cell_width + gap), top + head))
        sheet.paste(_heading(names, wide, head, cell_width, gap), (0, top))
        top += height
    return sheet


def shrunk(figure: Image.Image) -> Image.Image:
    """A figure as wide as an overview shows it."""
    size = CELL_WIDTH, max(1, round(figure.height * CELL_WIDTH / figure.width))
    return figure.resize(size, reducing_gap=2.0)


def overview(
    left_01: Map, depth: Image.Image, confidence: Image.Image | None, error: Map | None
) -> Image.Image:
    """Left image in [0, 1], depth, any confidence and photometric error (not finite if unseen), 2 a row.

    ``depth`` and ``confidence`` are ``shrunk`` figures.
    """
    every = max(1, left_01.shape[1] // (2 * CELL_WIDTH))
    left = as_picture(left_01[::every, ::every])
    beside = Image.new("RGB", depth.size, "white")  # as wide as a map with its bar: all have one scale
    beside.paste(left.resize((round(left.width * depth.height / left.height), depth.height)), (0, 0))
    cells = {"left image": beside, "depth": depth}
    if confidence is not None:
        cells["confidence: within 10 % of the truth"] = confidence
    if error is not None:
        error = error[::every, ::every]
        finite = error[np.isfinite(error)]
        top = max(LEAST_ERROR, float(np.quantile(finite, 0.98))) if finite.size else LEAST_ERROR
        cells["photometric error (grey: not seen from the right)"] = share_figure(error, "difference", top)
    return grid(list(cells.values()), list(cells), columns=2, cell_width=CELL_WIDTH)


def depth_frames(
    depths_m: Sequence[Map], near: float | None = None, far: float | None = None, unit: str | None = "m"
) -> Iterator[Image.Image]:
    """One picture a map ``(H, W)``, in the same colours, drawn when it is asked for."""
    shapes, samples = set(), []
    for depth_m in depths_m:  # one pass: a map may be read from its file whenever it is asked for
        every = max(1, math.ceil(len(depths_m) * depth_m.size / (4 * MOST_FOR_RANGE)))
        shapes.add(depth_m.shape)
        samples.append(np.asarray(depth_m).reshape(-1)[::every].copy())
    if len(shapes) != 1:
        bad_value("depths_m", "at least one map, all of one shape", sorted(shapes) or "none")
    near, far = depth_range(np.concatenate(samples)[None], near=near, far=far)
    return (depth_figure(depth_m, near=near, far=far, unit=unit) for depth_m in depths_m)


def check_video(path: str | os.PathLike[str], fps: float) -> None:
    """``ValueError`` for a video of another ending than ``VIDEO_SUFFIXES``, or ``fps`` outside [0.1, 120]."""
    if Path(path).suffix.lower() not in VIDEO_SUFFIXES:
        bad_value("the video", f"a file that ends in {', '.join(VIDEO_SUFFIXES)}", Path(path).name)
    check_number(fps, "fps", 0.1, 120)


def _write_mp4(path: Path, frames: Iterable[Image.Image], fps: float) -> None:
    """Frame by frame; H.264 and its like want even sides."""
    writer = cv2.VideoWriter()
    try:
        for frame in frames:
            width, height = size = tuple(side // 2 * 2 for side in frame.size)
            opened = writer.isOpened() or writer.open(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
            if not opened:
                raise InputFileError("the video must be one that OpenCV can write; got .mp4.")
            writer.write(np.ascontiguousarray(np.asarray(frame.convert("RGB"))[:height, :width, ::-1]))
    finally:  # an open file can be neither renamed nor removed on Windows
        writer.release()


def write_depth_video(path: str | os.PathLike[str], frames: Iterable[Image.Image], fps: float = 10.0) -> None:
    """Write frames, all of one size, as .mp4 (by OpenCV), .webp or .gif; whole or not at all.

    An MP4 is written frame by frame; all frames of the others are in memory, as Pillow wants them.
    ``ValueError`` as ``check_video``, and for no frames; ``OSError`` if the file cannot be written.
    """
    check_video(path, fps)
    rest, kind = iter(frames), Path(path).suffix.lower()
    first = next(rest, None)
    if first is None:
        bad_value("frames", "at least one picture", "none")
    more: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0}
    more |= {"quality": 85} if kind == ".webp" else {}
    try:
        with atomic_path(path) as temporary:
            if kind == ".mp4":
                _write_mp4(temporary, itertools.chain([first], rest), fps)
                return
            with open(temporary, "wb") as file:  # Pillow leaves its own open file behind after a Ctrl-C
                first.save(file, kind[1:], save_all=True, append_images=rest, **more)
    except InputError:  # of a photograph, or of the file, which it names
        raise
    except OSError as error:
        said = f"the video must be a file that can be written; got {path} ({reason_of(error)})."
        raise InputFileError(said) from error
