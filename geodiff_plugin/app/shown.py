"""A finished result as the page shows it, from a job or from the precomputed file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.findings import Finding, dedupe
from geodiff_plugin.formats import MM_PER_METRE, REPORT, flying_points, in_8_bits, read_image, sigma_mm
from geodiff_plugin.jobs import (
    PairResult,
    PairRun,
    cameras_of,
    depth_range_words,
    measurable_limit,
    measured_depth,
    output_summary,
    single_map,
)
from geodiff_plugin.result.readings import Reading, beyond_limit, distance_m, read_pixel
from geodiff_plugin.trust import KINDS, Tone, TrustSummary, summarise

Pixels = list[tuple[int, int]]
#: A length and, if known, its standard deviation, metres.
Length = tuple[float, float | None]
#: The 3D view ends at this multiple of the median depth.
MAX_MEDIAN_RATIO = 4.0
#: The 3D view ends at this multiple of the 95th percentile of depth.
MAX_FAR_RATIO = 1.3


@dataclass(frozen=True)
class Figure:
    """A number of the banner and its label."""

    value: str
    name: str


@dataclass(frozen=True, eq=False)
class Shown:
    """A result; maps are ``(H, W)``, and ``views`` has the left camera first."""

    name: str  # of the pair
    image: np.ndarray  # (H, W, 3) uint8
    depth_m: np.ndarray  # float32; 0 where it is unknown or too far to be measured
    views: tuple[PosedCamera, ...]
    trust: TrustSummary
    messages: tuple[Finding, ...]  # not in the summary
    figures: tuple[Figure, ...]
    cameras: str  # description of the cameras that were used
    confidence: np.ndarray | None = None  # in [0, 1]
    sigma_m: np.ndarray | None = None  # standard deviation of the depth, except for the scale's
    scale_rel_std: float | None = None  # relative standard deviation of the scale
    beyond: np.ndarray | None = None  # bool, pixels too far to be measured
    measurable_m: float | None = None  # the farthest measurable depth
    uploads: tuple[Path, ...] = ()  # folders of the inputs, which messages do not state
    folder: Path | None = None  # of the files for download
    precomputed: bool = False

    @property
    def K(self) -> np.ndarray:
        """``(3, 3)`` intrinsics of the left camera, in pixels of the maps."""
        return self.views[0].K

    def reading(self, pixel: tuple[int, int]) -> Reading:
        """Read the maps at a pixel ``(x, y)``; ``InputError`` outside the image or without depth."""
        return read_pixel(self.depth_m, self.K, pixel, self.confidence, self.sigma_m)

    def depth_of(self, at: Reading) -> Length:
        """Return the depth of a point, with the uncertainty of the scale."""
        return at.depth_m, self._with_scale(at.depth_m, at.spread_m)

    def distance(self, a: Reading, b: Reading) -> Length:
        """Return the distance between two points, with the uncertainty of the scale."""
        length, spread = distance_m(a, b)
        return length, self._with_scale(length, spread)

    def _with_scale(self, length_m: float, spread_m: float | None) -> float | None:
        """Add the scale's standard deviation, which all lengths have in common."""
        if self.scale_rel_std is None:
            return spread_m
        return float(np.hypot(spread_m or 0.0, self.scale_rel_std * length_m))


def shown_of(run: PairRun, name: str, scale_rel_std: float | None = None) -> Shown:
    """Return the result of a job, without files; the scale's uncertainty is by default the job's own."""
    output, inputs = run.output, run.inputs
    trust = summarise(output.verdict, (*output.findings, *run.log.findings))
    overall = output.verdict.summary  # only summarises the other findings
    repeated = () if overall is None else (overall,)
    messages = dedupe(output.findings, run.log.findings)
    maps = {
        each: None if (value := getattr(output, each)) is None else single_map(value)
        for each in ("confidence", "sigma")
    }
    if maps["sigma"] is not None and output.scale_rel_std is not None:  # lengths have it in common
        of_scale = output.scale_rel_std * single_map(output.prediction)
        maps["sigma"] = np.sqrt(np.maximum(maps["sigma"] ** 2 - of_scale**2, 0.0))
    measurable_m = measurable_limit(output)
    return Shown(
        name=name,
        image=in_8_bits(inputs.left),
        depth_m=measured_depth(output).astype(np.float32),
        views=cameras_of(output, inputs.guidance),
        trust=trust,
        messages=tuple(m for m in messages if m not in (*trust.reasons, *repeated)),
        figures=_figures(run),
        cameras=_cameras(run),
        confidence=maps["confidence"],
        sigma_m=maps["sigma"],
        scale_rel_std=output.scale_rel_std if scale_rel_std is None else scale_rel_std,
        beyond=beyond_limit(single_map(output.prediction), measurable_m),
        measurable_m=measurable_m,
        uploads=tuple({path.parent for path in _files(run)}),
    )


def _files(run: PairRun) -> tuple[Path, ...]:
    return (*run.options.image_files().values(), *run.options.calib)


def clean_report(job: PairResult) -> Path:
    """Remove the server's folders from the report of a result; return the folder of its files."""
    report = (job.folder / REPORT).read_text(encoding="utf-8")
    for path in _files(job.run):
        report = report.replace(str(path), path.name)
    (job.folder / REPORT).write_text(report, encoding="utf-8")
    return job.folder


def _figures(run: PairRun) -> tuple[Figure, ...]:
    """Return the figures of the banner; if the result is not trusted, none that suggest its quality."""
    output = run.output
    visible = None if output.visible is None else single_map(output.visible)
    depth = output_summary(output)
    seconds = Figure(f"{sum(run.log.seconds.values()):.1f} s", "compute time")
    if not output.verdict.trusted:
        return Figure(f"{depth['median_m']:.2f} m (unreliable)", "median depth"), seconds
    figures = [
        Figure(depth_range_words(depth, "m"), "depth range"),
        Figure(f"{depth['median_m']:.2f} m", "median depth"),
    ]
    if visible is not None:
        figures.append(Figure(f"{100 * visible.mean():.0f} %", "visible in both views"))
    if output.confidence is not None:
        figures.append(Figure(f"{100 * np.median(output.confidence):.0f} %", "median confidence"))
    return (*figures, seconds)


def _cameras(run: PairRun) -> str:
    """Describe the cameras that were used."""
    (fx, _, cx), (_, fy, cy), _ = np.asarray(run.output.K)[0].astype(np.float64)
    x, y, z = baseline = run.inputs.guidance.rigs[0].E[:3, 3]
    offsets = {"right": x, "left": -x, "below": y, "above": -y, "in front": z, "behind": -z}
    side = max(offsets, key=lambda side: offsets[side])
    distance = np.linalg.norm(baseline)
    lens = f"fx {fx:.1f}, fy {fy:.1f}, cx {cx:.1f}, cy {cy:.1f} px"
    return f"Left camera: {lens}. Right camera: {distance:.3g} m away ({side})."


def visible_in_viewer(shown: Shown) -> np.ndarray:
    """Return the ``(H, W)`` mask of the 3D view: without flying pixels and distant outliers such as sky."""
    depth_m = shown.depth_m
    known = np.isfinite(depth_m) & (depth_m > 0)
    limit_m = 0.0
    if known.any():
        median_m, far_m = np.percentile(depth_m[known], (50, 95))
        limit_m = min(MAX_MEDIAN_RATIO * median_m, MAX_FAR_RATIO * far_m)
    return known & (depth_m <= limit_m) & ~flying_points(depth_m)


def save(path: Path, shown: Shown, pixels: Pixels) -> None:
    """Write a result with its measured pixels, without its image and files.

    All its pixels with a depth are within the measurable range.
    """
    assert shown.confidence is not None and shown.sigma_m is not None
    assert shown.beyond is None or not shown.beyond.any()
    stored = {
        "pixels": pixels,
        "views": [[view.K.tolist(), view.E.tolist(), view.size] for view in shown.views],
        "trust": [shown.trust.status, shown.trust.tone.value, shown.trust.words],
        "reasons": [[message.code, str(message)] for message in shown.trust.reasons],
        "messages": [[message.code, str(message)] for message in shown.messages],
        "figures": [[figure.value, figure.name] for figure in shown.figures],
        "cameras": shown.cameras,
    }
    np.savez_compressed(
        path,
        depth_mm=np.rint(shown.depth_m * MM_PER_METRE).astype(np.uint16),
        confidence=np.rint(shown.confidence * 255).astype(np.uint8),
        sigma_mm=sigma_mm(shown.sigma_m),
        words=np.frombuffer(json.dumps(stored).encode(), np.uint8),
    )


def load(path: Path, image: Path, name: str) -> tuple[Shown, Pixels]:
    """Load a result of ``save`` with its image, and the pixels measured in it."""
    with np.load(path, allow_pickle=False) as file:
        stored = json.loads(file["words"].tobytes())
        depth_m = (file["depth_mm"] / MM_PER_METRE).astype(np.float32)
        confidence = (file["confidence"] / 255).astype(np.float32)
        sigma_m = np.where(file["sigma_mm"] > 0, file["sigma_mm"] / MM_PER_METRE, np.nan).astype(np.float32)
    status, tone, words = stored["trust"]
    shown = Shown(
        name=name,
        image=in_8_bits(read_image(image)[0]),
        depth_m=depth_m,
        views=tuple(PosedCamera(np.array(K), tuple(size), E=np.array(E)) for K, E, size in stored["views"]),
        trust=TrustSummary(status, Tone(tone), words, _messages(stored["reasons"])),
        messages=_messages(stored["messages"]),
        figures=tuple(Figure(*figure) for figure in stored["figures"]),
        cameras=stored["cameras"],
        confidence=confidence,
        sigma_m=sigma_m,
        precomputed=True,
    )
    return shown, [tuple(pixel) for pixel in stored["pixels"]]


def _messages(stored: Sequence[Sequence[str]]) -> tuple[Finding, ...]:
    return tuple(Finding(KINDS[code], text) for code, text in stored)
