"""What the result panels show: coloured maps with legends, points and distances, and files to take home."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from geodiff_plugin._checks import bad_value
from geodiff_plugin.app import look
from geodiff_plugin.formats import make_cloud, write_glb
from geodiff_plugin.formats.out import REPORT
from geodiff_plugin.jobs.records import PairResult
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.jobs.writing import cameras_of, pixels_of
from geodiff_plugin.plotting import as_picture, colour_depth, colour_share, depth_range, ticks

#: Pictures on the page are no larger than this; files to take home have every pixel.
LARGEST_SIDE = 1600
#: More points than this make a browser slow; the files to take home hold all.
MOST_POINTS_SHOWN = 250_000
NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
LEGEND_STOPS = 24
#: Name of the archive of all files.
EVERYTHING = "everything.zip"
#: Name of the table of what the visitor measured.
MEASUREMENTS = "measurements.csv"
#: Name of the cloud that the page shows.
SCENE = "scene.glb"
MARK = "#c2410c"
#: ``confidence`` is the probability that a depth is within this share of the truth.
CONFIDENT_WITHIN = 0.1
#: A lower confidence says no more about the spread than this one does.
LEAST_CONFIDENCE = 0.05
#: Nor does a higher one than this.
MOST_CONFIDENCE = 0.999
#: From the median absolute deviation to the standard deviation of a normal distribution.
SD_OF_MAD = 1.4826
Pixels = list[tuple[int, int]]


@dataclass(frozen=True)
class Reading:
    """What the depth map says at one pixel ``(x, y)``."""

    pixel: tuple[int, int]
    point_m: np.ndarray  # (3,) in the left camera's frame
    spread: float | None  # standard deviation of the depth as a share of it, if anything tells
    confidence: float | None  # in [0, 1]

    @property
    def depth_m(self) -> float:
        """z, metres."""
        return float(self.point_m[2])

    @property
    def spread_m(self) -> float | None:
        """Standard deviation of the depth in metres."""
        return None if self.spread is None else self.spread * self.depth_m


def _spread(confidence: float | None, uncertainty_m: float | None, depth_m: float) -> float | None:
    """The larger of what the confidence and the spread of the members say, as a share of the depth."""
    spreads = []
    if confidence is not None:
        bounded = min(max(confidence, LEAST_CONFIDENCE), MOST_CONFIDENCE)
        # A normal error that is within 10 % with this probability has this standard deviation.
        spreads.append(CONFIDENT_WITHIN / NormalDist().inv_cdf((1 + bounded) / 2))
    if uncertainty_m is not None:
        spreads.append(SD_OF_MAD * uncertainty_m / depth_m)
    return max(spreads, default=None)


def read_pixel(
    depth_m: np.ndarray,
    K: np.ndarray,
    pixel: tuple[int, int],
    confidence: np.ndarray | None = None,
    uncertainty_m: np.ndarray | None = None,
) -> Reading:
    """The point (Eq. 9) that a pixel ``(x, y)`` shows; ``ValueError`` outside the map, and without depth.

    ``depth_m`` and ``uncertainty_m``, the median absolute deviation of the members, are ``(H, W)`` metres,
    ``confidence`` is ``(H, W)`` in [0, 1], ``K`` ``(3, 3)`` in pixels of these maps.
    """
    x, y = (int(v) for v in pixel)
    height, width = depth_m.shape
    if not (0 <= x < width and 0 <= y < height):
        bad_value("pixel", f"inside the map of {width}x{height}", (x, y))
    z = float(depth_m[y, x])
    if not (np.isfinite(z) and z > 0):
        bad_value("pixel", "one with a depth", (x, y))
    sure, off_m = (None if map is None else float(map[y, x]) for map in (confidence, uncertainty_m))
    return Reading((x, y), z * (np.linalg.inv(K) @ (x, y, 1.0)), _spread(sure, off_m, z), sure)


def distance_m(a: Reading, b: Reading) -> tuple[float, float | None]:
    """How far two points are from each other, and the standard deviation of that if known, in metres.

    An error of depth moves a point along its own ray; the errors of the two points are taken as independent.
    """
    between = b.point_m - a.point_m
    length = float(np.linalg.norm(between))
    if a.spread is None or b.spread is None:
        return length, None
    if length == 0:
        return 0.0, float(np.hypot(a.spread, b.spread) * np.linalg.norm(a.point_m))
    of_a, of_b = between @ a.point_m * a.spread, between @ b.point_m * b.spread
    return length, float(np.hypot(of_a, of_b) / length)


def metres(value: float, spread: float | None = None) -> str:
    """``2.31 m`` or ``2.31 ± 0.07 m``; to the millimetre where the spread is below half a centimetre."""
    decimals = 3 if spread is not None and spread < 0.005 else 2
    return f"{value:.{decimals}f}{'' if spread is None else f' ± {spread:.{decimals}f}'} m"


def map_of(job: PairResult, name: str) -> np.ndarray | None:
    """``(H, W)`` of a map of the output, or ``None``."""
    value = getattr(job.run.output, name)
    return None if value is None else single_map(value)


def depth_of(job: PairResult) -> np.ndarray:
    """``(H, W)`` float32 metres."""
    return single_map(job.run.output.prediction).astype(np.float32)


def K_of(job: PairResult) -> np.ndarray:
    """``(3, 3)`` pixels of the maps."""
    return np.asarray(job.run.output.K)[0].astype(np.float64)


def scale_of(job: PairResult) -> float:
    """Size of the pictures on the page / size of the maps."""
    return min(1.0, LARGEST_SIDE / max(job.run.inputs.left.shape))


def picture(job: PairResult, name: str) -> np.ndarray | None:
    """``(h, w, 3)`` uint8 of ``photograph``, ``depth`` or ``confidence``; ``None`` without such a map."""
    if name == "photograph":
        full = np.asarray(as_picture(job.run.inputs.left))
    elif name == "depth":
        full = colour_depth(depth_of(job))
    else:
        confidence = map_of(job, "confidence")
        if confidence is None:
            return None
        full = colour_share(confidence)
    if (scale := scale_of(job)) == 1:
        return full
    size = (round(full.shape[1] * scale), round(full.shape[0] * scale))
    return np.asarray(Image.fromarray(full).resize(size, Image.Resampling.LANCZOS))


def reading(job: PairResult, pixel: tuple[int, int]) -> Reading:
    """What the map says at a pixel of a picture on the page."""
    depth_m = depth_of(job)
    most = np.array(depth_m.shape[::-1]) - 1
    x, y = np.rint((np.array(pixel) + 0.5) / scale_of(job) - 0.5).astype(int).clip(0, most)
    return read_pixel(depth_m, K_of(job), (x, y), map_of(job, "confidence"), map_of(job, "uncertainty"))


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


def measurement(job: PairResult, pixels: Pixels) -> tuple[np.ndarray, str]:
    """The photograph with the points of these pixels, and what they say as HTML; every two are a segment."""
    readings, photograph = [reading(job, pixel) for pixel in pixels], picture(job, "photograph")
    assert photograph is not None
    return marked(photograph, pixels, readings), _words(readings) if readings else look.HOW_TO_MEASURE


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


def _write_readings(path: Path, readings: Sequence[Reading]) -> None:
    """Points and segments as CSV: pixels of the photograph, metres."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("name", "x_px", "y_px", "x_m", "y_m", "z_m", "spread_m", "confidence", "distance_m"))
        for name, each in zip(NAMES, readings, strict=False):
            point = (f"{value:.4f}" for value in each.point_m)
            writer.writerow((name, *each.pixel, *point, each.spread_m, each.confidence, ""))
        for a, b, first, second in zip(NAMES[::2], NAMES[1::2], readings[::2], readings[1::2], strict=False):
            length, spread = distance_m(first, second)
            writer.writerow((f"{a} to {b}", *[""] * 5, spread, "", f"{length:.4f}"))


def write_scene(path: Path, job: PairResult, least_confidence: float) -> int:
    """Cloud and cameras as GLB, light enough for a browser; how many points there are in all."""
    cloud = make_cloud(*pixels_of(job.run.output, job.run.inputs.left, least_confidence))
    write_glb(path, cloud.thinned(MOST_POINTS_SHOWN), cameras_of(job.run.output, job.run.inputs.guidance))
    return len(cloud.points_m)


def files_of(job: PairResult, pixels: Sequence[tuple[int, int]] = ()) -> list[Path]:
    """Everything that can be downloaded, first all in one, with ``measurements.csv`` of these pixels."""
    folder = job.folder
    if pixels:
        _write_readings(folder / MEASUREMENTS, [reading(job, pixel) for pixel in pixels])
    else:
        (folder / MEASUREMENTS).unlink(missing_ok=True)
    report = (folder / REPORT).read_text(encoding="utf-8")
    for path in (*job.run.options.photographs().values(), *job.run.options.calib):
        report = report.replace(str(path), path.name)
    (folder / REPORT).write_text(report, encoding="utf-8")
    wanted = f"depth_mm.png depth.npy depth.png confidence.npy cloud.ply cloud.glb mesh.glb {REPORT}".split()
    others = sorted({path.name for path in folder.iterdir()} - {*wanted, EVERYTHING, SCENE})
    paths = [folder / name for name in (*wanted, *others) if (folder / name).is_file()]
    with ZipFile(folder / EVERYTHING, "w", ZIP_STORED) as archive:
        for path in paths:
            archive.write(path, path.name)
    return [folder / EVERYTHING, *paths]
