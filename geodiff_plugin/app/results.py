"""Contents of the result panels of the page, and the files to take home."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from PIL import Image

from geodiff_plugin.app import look
from geodiff_plugin.app.job import Result
from geodiff_plugin.app.measure import Reading, distance_m, read_pixel
from geodiff_plugin.app.pictures import colour_relative, marked, metres
from geodiff_plugin.cli.exports import cameras_of, write_maps
from geodiff_plugin.cli.report import plain, result_entries
from geodiff_plugin.formats import flying_points, make_cloud, write_glb
from geodiff_plugin.plotting import colour_depth, colour_share

#: Pictures on the page are no larger than this; files to take home have every pixel.
LARGEST_SIDE = 1600
#: More points than this make a browser slow; the files to take home hold all.
MOST_POINTS_SHOWN = 250_000
NAMES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
Pixels = list[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Shown:
    """A result and where its files lie, for one visitor.

    Attributes:
        result: of the job.
        folder: of its own.
    """

    result: Result
    folder: Path

    @property
    def scale(self) -> float:
        """Size of the pictures on the page / size of the maps."""
        return min(1.0, LARGEST_SIDE / max(self.result.depth_m.shape))

    def picture(self, name: str) -> np.ndarray | None:
        """``(h, w, 3)`` uint8, as large as the page shows it; ``None`` where the result has no such map."""
        full = self._full(name)
        if full is None or self.scale == 1:
            return full
        size = (round(full.shape[1] * self.scale), round(full.shape[0] * self.scale))
        return np.asarray(Image.fromarray(full).resize(size, Image.Resampling.LANCZOS))

    def _full(self, name: str) -> np.ndarray | None:
        result = self.result
        if name == "photograph" or (name == "prior" and result.prior_map is None):
            return np.rint(np.clip(result.views.left, 0, 1) * 255).astype(np.uint8)
        if name == "prior":
            assert result.prior_map is not None
            return colour_relative(result.prior_map, result.depth_m)
        if name == "depth":
            return colour_depth(result.depth_m)
        values = result.map(name)
        most = self.most_error if name == "photometric_error" else 1.0
        return None if values is None else colour_share(values, most)

    @property
    def most_error(self) -> float:
        """The error at the upper end of its colours."""
        error = self.result.map("photometric_error")
        return 1.0 if error is None else max(float(np.percentile(error, 99)), 1e-3)

    def reading(self, pixel: tuple[int, int]) -> Reading:
        """What the map says at a pixel of a picture on the page."""
        result = self.result
        height, width = result.depth_m.shape
        x, y = (round((value + 0.5) / self.scale - 0.5) for value in pixel)
        inside = (min(max(x, 0), width - 1), min(max(y, 0), height - 1))
        return read_pixel(
            result.depth_m, result.K, inside, result.map("confidence"), result.map("uncertainty")
        )


def measurement(shown: Shown, pixels: Pixels, under: str) -> tuple[np.ndarray, str]:
    """The picture with the points of these pixels, and what they say as HTML; every two are a segment."""
    readings = [shown.reading(pixel) for pixel in pixels]
    picture = shown.picture(under)
    assert picture is not None
    picture = marked(picture, list(zip(pixels, NAMES, readings, strict=False)))
    return picture, _words(readings) if readings else look.HOW_TO_MEASURE


def _words(readings: list[Reading]) -> str:
    rows = "".join(
        f"<tr><td><b>{name}</b></td><td>{metres(reading.depth_m, reading.spread_m)}</td>"
        f"<td>{'unknown' if reading.confidence is None else f'{100 * reading.confidence:.0f} %'}</td></tr>"
        for name, reading in zip(NAMES, readings, strict=False)
    )
    table = f'<table class="readings"><tr><th></th><th>depth</th><th>confidence</th></tr>{rows}</table>'
    segments = "".join(
        f'<div>Distance {names}</div><div class="distance">{metres(*distance_m(a, b))}</div>'
        for names, a, b in _segments(readings)
    )
    note = (
        "± is one standard deviation of the depth, from its confidence and the spread of the members. Errors "
        "have heavier tails than a normal distribution: one in ten may be beyond twice that."
    )
    more = "<p>Choose a second point for the distance.</p>" if len(readings) % 2 else ""
    return f'<div class="say">{segments}{table}{more}<p class="legend-caption">{note}</p></div>'


def _segments(readings: list[Reading]) -> list[tuple[str, Reading, Reading]]:
    named = list(zip(NAMES, readings, strict=False))
    pairs = zip(named[::2], named[1::2], strict=False)
    return [(f"{a} to {b}", first, second) for (a, first), (b, second) in pairs]


def readings_csv(shown: Shown, pixels: Pixels) -> str:
    """The points and segments as CSV: pixels of the photograph, metres."""
    readings = [shown.reading(pixel) for pixel in pixels]
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(("name", "x_px", "y_px", "x_m", "y_m", "z_m", "spread_m", "confidence", "distance_m"))
    for name, each in zip(NAMES, readings, strict=False):
        point = (f"{value:.4f}" for value in each.point_m)
        writer.writerow((name, *each.pixel, *point, each.spread_m, each.confidence, ""))
    for name, a, b in _segments(readings):
        length, spread = distance_m(a, b)
        writer.writerow((name, *[""] * 5, spread, "", f"{length:.4f}"))
    return text.getvalue()


def write_scene(path: Path, result: Result, least_confidence: float, most: int = MOST_POINTS_SHOWN) -> int:
    """Cloud and cameras as GLB, by default light enough for a browser; how many points there are in all."""
    keep, confidence = ~flying_points(result.depth_m), result.map("confidence")
    if confidence is not None:
        keep &= confidence >= least_confidence
    cloud = make_cloud(result.depth_m, result.views.left, result.K, keep)
    write_glb(path, cloud.thinned(most), cameras_of(result.output, result.guidance))
    return len(cloud.points_m)


def write_files(folder: Path, result: Result) -> list[Path]:
    """Write everything that can be downloaded.

    Returns:
        The files, most wanted first: ``everything.zip`` has all.
    """
    counts = write_maps(folder, result.output, result.views.left)
    write_scene(folder / "cloud.glb", result, 0.0, result.depth_m.size)
    rigs = result.guidance.rigs
    report = result_entries(result.output, result.guidance) | {
        "warnings": result.warnings,
        "cameras": [
            {"K": rig.K_right, "E": E}
            for rig, (_, E, _) in zip(rigs, cameras_of(result.output, result.guidance)[1:], strict=True)
        ],
        "photographs": [Path(name).name for name in result.views.names],
        "settings": result.request.run.as_json(),
        "seconds": {name: round(value, 3) for name, value in result.seconds.items()},
        "files": counts,
    }
    text = json.dumps(plain(report), indent=2, allow_nan=False, default=str)
    (folder / "report.json").write_text(f"{text}\n", encoding="utf-8")
    first = [
        "depth_mm.png",
        "depth.npy",
        "depth.png",
        "confidence.npy",
        "cloud.ply",
        "cloud.glb",
        "report.json",
    ]
    others = sorted(path.name for path in folder.iterdir() if path.name not in first)
    paths = [folder / name for name in (*first, *others) if (folder / name).is_file()]
    with ZipFile(folder / "everything.zip", "w", ZIP_STORED) as archive:
        for path in paths:
            archive.write(path, path.name)
    return [folder / "everything.zip", *paths]
