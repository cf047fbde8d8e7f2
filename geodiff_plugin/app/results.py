"""Content of the result panels: coloured maps with legends, points and distances, and files."""

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
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from PIL import Image

from geodiff_plugin.app import templates
from geodiff_plugin.app.messages import PageError, check_inside
from geodiff_plugin.app.sessions import Result
from geodiff_plugin.app.shown import Shown, visible_in_viewer
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.formats import MAX_16_BITS, REPORT
from geodiff_plugin.formats.clouds import CAMERA_COLOURS, EDGES, PYRAMID_FRACTION, camera_pyramid
from geodiff_plugin.jobs import limit_words
from geodiff_plugin.plotting import colour_depth, colour_fraction, depth_range, ticks
from geodiff_plugin.result.readings import Reading, metres

#: Longest side of images on the page; files have full resolution.
MAX_IMAGE_SIDE = 1600
#: Maximum number of points in the 3D view, for fluent rendering.
MAX_VIEW_POINTS = 160_000
JPEG_QUALITY = 88
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
LEGEND_STOPS = 24
#: Name of the archive with all files but the arrays.
ARCHIVE = "result.zip"
#: Suffix of arrays, which are not in the archive: they hardly compress, and most visitors need none.
ARRAYS = ".npy"
#: Suffixes of files that are compressed in the archive, fast; images are compressed already.
COMPRESSED = (".glb", ".ply")
#: Name of the table with the visitor's measurements.
MEASUREMENTS = "measurements.csv"
#: File for download -> purpose; in the order of the page.
PURPOSES = {
    ARCHIVE: "all files below, except NumPy arrays",
    "depth_mm.png": "depth as 16-bit image, in millimetres; 0 is unknown",
    "depth.png": "coloured depth with a scale in metres",
    "overview.png": "image, depth, confidence and error in one sheet",
    "confidence.png": "coloured confidence with a scale",
    "sigma_mm.png": "standard deviation of the depth as 16-bit image, in millimetres",
    "mesh.glb": "textured surface for 3D viewers and Blender",
    "cloud.glb": "coloured points for 3D viewers and Blender",
    "cloud.ply": "coloured points for CloudCompare and MeshLab",
    "visible.png": "mask of the pixels that both cameras see",
    "undistorted.png": "left image without lens distortion, to which the depth belongs",
    REPORT: "all settings, cameras and findings",
    "depth.npy": "NumPy array of depth, metres",
    "confidence.npy": "NumPy array of confidence, 0 to 1",
    "sigma.npy": "NumPy array of the depth's standard deviation, metres",
    "uncertainty.npy": "NumPy array of the ensemble's spread, metres",
    "photometric_error.npy": "NumPy array of differences between the images",
    # Last: it is added when the tab is opened, and must not move the links before it.
    MEASUREMENTS: "your points and distances as a table",
}
#: Distance in pixels between the lines that mark pixels without depth, and their grey level.
HATCH_PX, HATCH_LEVEL = 12, 90


def point_name(number: int) -> str:
    """Return A to Z, then AA, AB etc."""
    first, last = divmod(number, len(LETTERS))
    return (point_name(first - 1) if first else "") + LETTERS[last]


def shrunk(full: np.ndarray) -> np.ndarray:
    """Return an image ``(h, w, 3)`` uint8 at the size of the page."""
    if (scale := MAX_IMAGE_SIDE / max(full.shape[:2])) >= 1:
        return full
    size = (round(full.shape[1] * scale), round(full.shape[0] * scale))
    return np.asarray(Image.fromarray(full).resize(size, Image.Resampling.LANCZOS))


def map_image(shown: Shown, name: str) -> np.ndarray | None:
    """Return ``image``, ``depth`` or ``confidence`` as ``(h, w, 3)`` uint8; ``None`` without that map."""
    if name == "image":
        full = shown.image
    elif name == "depth":
        full = hatched(colour_depth(shown.depth_m), shown.depth_m > 0)
    elif shown.confidence is None:
        return None
    else:
        full = colour_fraction(shown.confidence)
    return shrunk(full)


def hatched(image: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Draw diagonal lines on an image ``(H, W, 3)`` where it is not ``valid (H, W)``, which has no depth."""
    rows, columns = np.indices(valid.shape)
    lines = ~valid & ((rows + columns) % HATCH_PX < HATCH_PX // 4)
    return np.where(lines[..., None], np.uint8(HATCH_LEVEL), image)


def data_url(pixels: np.ndarray) -> str:
    """Encode an image ``(h, w, 3)`` uint8 as a data URL, so that the server stores no copy."""
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return f"data:image/jpeg;base64,{b64encode(buffer.getvalue()).decode()}"


def check_pixel(shown: Shown, pixel: tuple[int, int]) -> None:
    """Raise ``PageError`` for a pixel outside the image, or without depth."""
    (x, y), (height, width) = pixel, shown.depth_m.shape
    check_inside(pixel, (width, height), f"({x}, {y})")
    if shown.beyond is not None and shown.measurable_m is not None and shown.beyond[y, x]:
        limit = limit_words(shown.measurable_m, "m")
        raise PageError(
            f"({x}, {y}) is too far to be measured: these cameras measure depths up to {limit}. "
            "Choose a nearer point."
        )
    if not (np.isfinite(shown.depth_m[y, x]) and shown.depth_m[y, x] > 0):
        raise PageError(f"({x}, {y}) has no depth. Choose a point on a nearby surface.")


def _drawn_camera(number: int, view: PosedCamera, length_m: float) -> dict[str, Any]:
    """Return the edges of a camera's pyramid in WebGL's axes, and its colour."""
    corners = camera_pyramid(view, length_m)
    edges = (corners[EDGES] * (1.0, -1.0, -1.0)).reshape(-1, 3)
    colour = [value / 255 for value in CAMERA_COLOURS[number % len(CAMERA_COLOURS)]]
    return {"edges": edges.round(4).tolist(), "colour": colour}


def scene_data(shown: Shown) -> str:
    """Return the JSON that ``viewer.js`` draws: subsampled depth and confidence, image and cameras."""
    height, width = shown.depth_m.shape
    stride = max(1, math.ceil(math.sqrt(height * width / MAX_VIEW_POINTS)))
    z = np.where(visible_in_viewer(shown), shown.depth_m, 0)[::stride, ::stride]
    confidence = np.ones_like(z) if shown.confidence is None else shown.confidence[::stride, ::stride]
    unit = max(float(z.max()) / MAX_16_BITS, 1e-6)
    maps = np.rint(z / unit).astype("<u2").tobytes() + np.rint(confidence * 255).astype(np.uint8).tobytes()
    photo = map_image(shown, "image")
    assert photo is not None
    length_m = PYRAMID_FRACTION * float(np.median(z[z > 0])) if (z > 0).any() else 1.0
    cameras = [_drawn_camera(number, view, length_m) for number, view in enumerate(shown.views)]
    lens = {"fx": shown.K[0, 0], "fy": shown.K[1, 1], "cx": shown.K[0, 2], "cy": shown.K[1, 2]}
    size = {"width": width, "height": height, "w": z.shape[1], "h": z.shape[0], "stride": stride}
    encoded = b64encode(zlib.compress(maps, 9)).decode()
    drawn = {"maps": encoded, "unit": unit, "image": data_url(photo), "cameras": cameras}
    return json.dumps(size | lens | drawn)


@dataclass(frozen=True)
class Segment:
    """Two measured points in a row."""

    name: str
    ends: tuple[Reading, Reading]
    length_m: float
    spread_m: float | None

    @property
    def text(self) -> str:
        """The length in words."""
        return metres(self.length_m, self.spread_m)


@dataclass(frozen=True, eq=False)
class Measurement:
    """Readings of the chosen points, and the segments between every two of them."""

    shown: Shown
    readings: list[Reading]
    segments: list[Segment]

    @classmethod
    def of(cls, result: Result) -> Measurement:
        """Measure the pixels of a result."""
        readings = [result.shown.reading(pixel) for pixel in result.pixels]
        segments = []
        for number, pair in enumerate(zip(readings[::2], readings[1::2], strict=False)):
            name = f"{point_name(2 * number)} to {point_name(2 * number + 1)}"
            segments.append(Segment(name, pair, *result.shown.distance(*pair)))
        return cls(result.shown, readings, segments)

    def marks(self) -> str:
        """Return the points and distances as JSON for ``viewer.js``."""
        points = [
            {
                "name": point_name(number),
                "px": list(each.pixel),
                "at": [round(float(value), 4) for value in each.point_m],
            }
            for number, each in enumerate(self.readings)
        ]
        segments = [
            {"ends": [2 * number, 2 * number + 1], "text": segment.text}
            for number, segment in enumerate(self.segments)
        ]
        return json.dumps({"points": points, "segments": segments})

    def headline(self) -> str:
        """Return the line above the 3D view: the last measurement and the next step."""
        if len(self.readings) % 2:
            depth = metres(*self.shown.depth_of(self.readings[-1]))
            return templates.headline(depth, templates.SECOND_POINT)
        hint = templates.CLICK_OR_BRING if self.shown.precomputed else templates.CLICK_TWO
        return templates.headline(self.segments[-1].text if self.segments else "", hint)

    def html(self) -> str:
        """Return all points and distances as HTML."""
        if not self.readings:
            return templates.HOW_TO_MEASURE
        rows = "".join(
            f"<tr><td><b>{point_name(number)}</b></td><td>{metres(*self.shown.depth_of(each))}</td>"
            f"<td>{'unknown' if each.confidence is None else f'{100 * each.confidence:.0f} %'}</td></tr>"
            for number, each in enumerate(self.readings)
        )
        table = f'<table class="readings"><tr><th></th><th>depth</th><th>confidence</th></tr>{rows}</table>'
        segments = "".join(
            f'<div>Distance {each.name}</div><div class="distance">{each.text}</div>'
            for each in self.segments
        )
        more = "<p>Choose a second point to measure the distance.</p>" if len(self.readings) % 2 else ""
        scale = self.shown.scale_rel_std
        scaled = "" if scale is None else templates.scale_note(scale)
        note = f'<p class="legend-caption">{templates.SPREAD_NOTE}{scaled}</p>'
        return f'<div class="box">{segments}{table}{more}{note}</div>'

    def csv(self) -> str:
        """Return points (pixels of the left image, metres) and segments as CSV; empty without points."""
        if not self.readings:
            return ""
        table = StringIO(newline="")
        writer = csv.writer(table)
        writer.writerow(("name", "x_px", "y_px", "x_m", "y_m", "z_m", "spread_m", "confidence", "distance_m"))
        for number, each in enumerate(self.readings):
            point = (f"{value:.4f}" for value in each.point_m)
            spread = self.shown.depth_of(each)[1]
            writer.writerow((point_name(number), *each.pixel, *point, spread, each.confidence, ""))
        for segment in self.segments:
            writer.writerow((segment.name, *[""] * 5, segment.spread_m, "", f"{segment.length_m:.4f}"))
        return table.getvalue()


def _legend(colours: np.ndarray, marks: Sequence[tuple[float, str]], caption: str) -> str:
    places = zip(np.linspace(0, 100, len(colours)), colours, strict=True)
    stops = ", ".join(f"rgb({r},{g},{b}) {place:.1f}%" for place, (r, g, b) in places)
    labels = "".join(f'<span style="left:{100 * fraction:.2f}%">{text}</span>' for fraction, text in marks)
    bar = f"background:linear-gradient(90deg, {stops})"
    return (
        f'<div class="legend"><div class="legend-bar" style="{bar}"></div>'
        f'<div class="legend-ticks">{labels}</div><div class="legend-caption">{caption}</div></div>'
    )


def legend_of_depth(depth_m: np.ndarray) -> str:
    """Return a colour bar from near to far with depths in metres, as HTML."""
    near, far = depth_range(depth_m)
    fractions = np.linspace(0, 1, LEGEND_STOPS)
    colours = colour_depth((near * (far / near) ** fractions)[None], near=near, far=far)[0]
    marks = [(math.log(value / near) / math.log(far / near), f"{value:g} m") for value in ticks(near, far, 7)]
    return _legend(colours, marks, "Depth in metres (logarithmic colour scale)")


def legend_of_confidence() -> str:
    """Return a colour bar with percentages, as HTML."""
    colours = colour_fraction(np.linspace(0, 1, LEGEND_STOPS)[None])[0]
    marks = [(fraction, f"{100 * fraction:.0f} %") for fraction in (0, 0.25, 0.5, 0.75, 1)]
    return _legend(colours, marks, "Confidence: probability that the depth error is below 10 %")


def _write_measurements(path: Path, text: str) -> bool:
    """Write the measurements, or delete the file if there are none; return whether the file changed."""
    now = text.encode()
    if now == (path.read_bytes() if path.exists() else b""):
        return False
    if now:
        path.write_bytes(now)
    else:
        path.unlink()
    return True


def files_of(result: Result) -> list[Path]:
    """Return the files for download: the archive, then each file, with ``measurements.csv``.

    Rebuilds the archive only if the measurements changed.
    """
    folder = result.shown.folder
    if folder is None:
        return []
    with result.writing:
        return _write_files(result, folder)


def _write_files(result: Result, folder: Path) -> list[Path]:
    archive_is_old = _write_measurements(folder / MEASUREMENTS, Measurement.of(result).csv())
    own = {path.name for path in folder.iterdir() if path.is_file()} - {ARCHIVE}
    *wanted, last = PURPOSES
    paths = [folder / name for name in (*wanted, *sorted(own.difference(PURPOSES)), last) if name in own]
    if archive_is_old or not (folder / ARCHIVE).exists():
        with ZipFile(folder / ARCHIVE, "w", compresslevel=1) as archive:
            for path in paths:
                if path.suffix != ARRAYS:
                    kind = ZIP_DEFLATED if path.suffix in COMPRESSED else ZIP_STORED
                    archive.write(path, path.name, kind)
    return [folder / ARCHIVE, *paths]
