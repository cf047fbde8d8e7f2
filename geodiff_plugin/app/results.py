"""What the result panels show: coloured maps with legends, points and distances, and files to take home."""

from __future__ import annotations

import csv
import json
import math
import zlib
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin._reprojection import PosedCamera
from geodiff_plugin.app import look
from geodiff_plugin.app.shown import Pixels, Shown, kept_in_view
from geodiff_plugin.formats.clouds import CAMERA_COLOURS, EDGES, PYRAMID_SHARE, camera_pyramid
from geodiff_plugin.formats.out import REPORT
from geodiff_plugin.plotting import colour_depth, colour_share, depth_range, ticks
from geodiff_plugin.result.readings import Reading, distance_m, metres, read_pixel

#: Pictures on the page are no larger than this; files to take home have every pixel.
LARGEST_SIDE = 1600
#: More points than this make a browser slow; the files to take home hold all.
MOST_POINTS_SHOWN = 160_000
LARGEST_16_BITS = 65535
JPEG_QUALITY = 88
NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
LEGEND_STOPS = 24
#: Name of the archive of all files.
EVERYTHING = "everything.zip"
#: Name of the table of what the visitor measured.
MEASUREMENTS = "measurements.csv"
MARK = "#c2410c"


def scale_of(shown: Shown) -> float:
    """Size of the pictures on the page / size of the maps."""
    return min(1.0, LARGEST_SIDE / max(shown.depth_m.shape))


def picture(shown: Shown, name: str) -> np.ndarray | None:
    """``(h, w, 3)`` uint8 of ``photograph``, ``depth`` or ``confidence``; ``None`` without such a map."""
    if name == "photograph":
        full = shown.photograph
    elif name == "depth":
        full = colour_depth(shown.depth_m)
    elif shown.confidence is None:
        return None
    else:
        full = colour_share(shown.confidence)
    if (scale := scale_of(shown)) == 1:
        return full
    size = (round(full.shape[1] * scale), round(full.shape[0] * scale))
    return np.asarray(Image.fromarray(full).resize(size, Image.Resampling.LANCZOS))


def data_url(pixels: np.ndarray) -> str:
    """A picture ``(h, w, 3)`` uint8 as the address of itself: no copy of it lies at the server."""
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return f"data:image/jpeg;base64,{b64encode(buffer.getvalue()).decode()}"


def reading(shown: Shown, pixel: tuple[int, int]) -> Reading:
    """What the maps say at a pixel ``(x, y)``; one outside of them counts as the nearest inside."""
    height, width = shown.depth_m.shape
    x, y = (min(max(number, 0), side - 1) for number, side in zip(pixel, (width, height), strict=True))
    return read_pixel(shown.depth_m, shown.K, (x, y), shown.confidence, shown.uncertainty_m)


def _drawn_camera(number: int, view: PosedCamera, length_m: float) -> dict[str, Any]:
    """The edges of a camera's pyramid in WebGL's axes, and its colour."""
    corners = camera_pyramid(view.K, view.E, view.size, length_m)
    edges = (corners[EDGES] * (1.0, -1.0, -1.0)).reshape(-1, 3)
    colour = [value / 255 for value in CAMERA_COLOURS[number % len(CAMERA_COLOURS)]]
    return {"edges": edges.round(4).tolist(), "colour": colour}


def scene_data(shown: Shown) -> str:
    """What ``viewer.js`` draws, as JSON: a thinned grid of depth and confidence, photograph and cameras."""
    height, width = shown.depth_m.shape
    stride = max(1, math.ceil(math.sqrt(height * width / MOST_POINTS_SHOWN)))
    z = np.where(kept_in_view(shown), shown.depth_m, 0)[::stride, ::stride]
    sure = np.ones_like(z) if shown.confidence is None else shown.confidence[::stride, ::stride]
    unit = max(float(z.max()) / LARGEST_16_BITS, 1e-6)
    maps = np.rint(z / unit).astype("<u2").tobytes() + np.rint(sure * 255).astype(np.uint8).tobytes()
    photograph = picture(shown, "photograph")
    assert photograph is not None
    length_m = PYRAMID_SHARE * float(np.median(z[z > 0])) if (z > 0).any() else 1.0
    cameras = [_drawn_camera(number, view, length_m) for number, view in enumerate(shown.views)]
    lens = {"fx": shown.K[0, 0], "fy": shown.K[1, 1], "cx": shown.K[0, 2], "cy": shown.K[1, 2]}
    size = {"width": width, "height": height, "w": z.shape[1], "h": z.shape[0], "stride": stride}
    encoded = b64encode(zlib.compress(maps, 9)).decode()
    drawn = {"maps": encoded, "unit": unit, "photograph": data_url(photograph), "cameras": cameras}
    return json.dumps(size | lens | drawn)


def marks_data(readings: Sequence[Reading]) -> str:
    """The measured points and their distances as JSON, for ``viewer.js``."""
    points = [
        {"name": name, "at": [round(float(value), 4) for value in each.point_m]}
        for name, each in zip(NAMES, readings, strict=False)
    ]
    segments = [
        {"ends": [2 * number, 2 * number + 1], "text": metres(*distance_m(*pair))}
        for number, pair in enumerate(zip(readings[::2], readings[1::2], strict=False))
    ]
    return json.dumps({"points": points, "segments": segments})


def _legend(colours: np.ndarray, marks: Sequence[tuple[float, str]], caption: str) -> str:
    places = zip(np.linspace(0, 100, len(colours)), colours, strict=True)
    stops = ", ".join(f"rgb({r},{g},{b}) {place:.1f}%" for place, (r, g, b) in places)
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


def legend_of_confidence() -> str:
    """A bar with percentages under it, as HTML."""
    colours = colour_share(np.linspace(0, 1, LEGEND_STOPS)[None])[0]
    marks = [(share, f"{100 * share:.0f} %") for share in (0, 0.25, 0.5, 0.75, 1)]
    return _legend(colours, marks, "Confidence: probability that a depth is within 10 % of the truth")


@dataclass(frozen=True, eq=False)
class Measurement:
    """Points that were chosen: their readings, the photograph with them, and what they say as HTML."""

    readings: list[Reading]
    picture: np.ndarray
    words: str
    headline: str  # the last distance, for the 3D view


def measurement(shown: Shown, pixels: Pixels) -> Measurement:
    """What the maps say at these pixels; every two are a segment."""
    readings, photograph = [reading(shown, pixel) for pixel in pixels], picture(shown, "photograph")
    assert photograph is not None
    scale = scale_of(shown)
    places = [(round(x * scale), round(y * scale)) for x, y in pixels]
    words = _words(readings) if readings else look.HOW_TO_MEASURE
    return Measurement(readings, marked(photograph, places, readings), words, _headline(shown, readings))


def _headline(shown: Shown, readings: list[Reading]) -> str:
    if len(readings) % 2:
        return look.headline(metres(readings[-1].depth_m, readings[-1].spread_m), look.SECOND_POINT)
    if not readings:
        return look.headline("", look.CLICK_TWO)
    hint = look.CLICK_OR_BRING if shown.title else look.CLICK_TWO
    return look.headline(metres(*distance_m(readings[-2], readings[-1])), hint)


def marked(photograph: np.ndarray, pixels: Pixels, readings: Sequence[Reading]) -> np.ndarray:
    """A copy of a photograph ``(h, w, 3)`` uint8 with these pixels, and the distance of every two of them."""
    image = Image.fromarray(photograph)
    draw = ImageDraw.Draw(image)
    unit = max(image.size) / 100
    radius, font = max(3.0, 0.8 * unit), ImageFont.load_default(size=max(11.0, 2.8 * unit))

    def label(x: float, y: float, text: str) -> None:
        left, top, right, bottom = draw.textbbox((x, y), text, font=font, anchor="mm")
        draw.rounded_rectangle((left - 3, top - 2, right + 3, bottom + 2), radius=3, fill=(20, 20, 20))
        draw.text((x, y), text, font=font, fill="white", anchor="mm")

    segments = list(zip(pixels[::2], pixels[1::2], readings[::2], readings[1::2], strict=False))
    for a, b, *_ in segments:
        draw.line([a, b], fill="black", width=max(3, round(0.7 * unit)))
        draw.line([a, b], fill="white", width=max(1, round(0.3 * unit)))
    for (x, y), name in zip(pixels, NAMES, strict=False):
        box = (x - radius, y - radius, x + radius, y + radius)
        draw.ellipse(box, fill=MARK, outline="white", width=max(1, round(0.25 * unit)))
        label(x, y - 2.6 * radius, name)
    for a, b, first, second in segments:
        middle = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 2.2 * radius
        label(*middle, f"{distance_m(first, second)[0]:.2f} m")
    return np.asarray(image)


def _words(readings: list[Reading]) -> str:
    rows = "".join(
        f"<tr><td><b>{name}</b></td><td>{metres(each.depth_m, each.spread_m)}</td>"
        f"<td>{'unknown' if each.confidence is None else f'{100 * each.confidence:.0f} %'}</td></tr>"
        for name, each in zip(NAMES, readings, strict=False)
    )
    table = f'<table class="readings"><tr><th></th><th>depth</th><th>confidence</th></tr>{rows}</table>'
    pairs = zip(NAMES[::2], NAMES[1::2], readings[::2], readings[1::2], strict=False)
    segments = "".join(
        f'<div>Distance {a} to {b}</div><div class="distance">{metres(*distance_m(first, second))}</div>'
        for a, b, first, second in pairs
    )
    note = (
        "± is one standard deviation of the depth, from its confidence and the spread of the members. Errors "
        "have heavier tails than a normal distribution: one in ten may be beyond twice that."
    )
    more = "<p>Choose a second point for the distance.</p>" if len(readings) % 2 else ""
    return f'<div class="say">{segments}{table}{more}<p class="legend-caption">{note}</p></div>'


def _readings_as_csv(readings: Sequence[Reading]) -> str:
    """Points and segments: pixels of the photograph, metres. Empty without any."""
    if not readings:
        return ""
    table = StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow(("name", "x_px", "y_px", "x_m", "y_m", "z_m", "spread_m", "confidence", "distance_m"))
    for name, each in zip(NAMES, readings, strict=False):
        point = (f"{value:.4f}" for value in each.point_m)
        writer.writerow((name, *each.pixel, *point, each.spread_m, each.confidence, ""))
    for a, b, first, second in zip(NAMES[::2], NAMES[1::2], readings[::2], readings[1::2], strict=False):
        length, spread = distance_m(first, second)
        writer.writerow((f"{a} to {b}", *[""] * 5, spread, "", f"{length:.4f}"))
    return table.getvalue()


def _write_measurements(path: Path, readings: Sequence[Reading]) -> bool:
    """Write what was measured, or delete it where nothing was; whether that changes what was there."""
    now = _readings_as_csv(readings).encode()
    if now == (path.read_bytes() if path.exists() else b""):
        return False
    if now:
        path.write_bytes(now)
    else:
        path.unlink()
    return True


def files_of(shown: Shown, pixels: Sequence[tuple[int, int]] = ()) -> list[Path]:
    """Everything that can be downloaded, first all in one, with ``measurements.csv`` of these pixels.

    The archive of all is made anew only where something else was measured.
    """
    folder = shown.folder
    if folder is None:
        return []
    measured = [reading(shown, pixel) for pixel in pixels]
    archive_is_old = _write_measurements(folder / MEASUREMENTS, measured)
    wanted = f"depth_mm.png depth.npy depth.png confidence.npy cloud.ply cloud.glb mesh.glb {REPORT}".split()
    others = sorted({path.name for path in folder.iterdir()} - {*wanted, EVERYTHING})
    paths = [folder / name for name in (*wanted, *others) if (folder / name).is_file()]
    if archive_is_old or not (folder / EVERYTHING).exists():
        with ZipFile(folder / EVERYTHING, "w", ZIP_STORED) as archive:
            for path in paths:
                archive.write(path, path.name)
    return [folder / EVERYTHING, *paths]
