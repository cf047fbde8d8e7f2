"""A finished result as the page shows it, of a job or of a file that was made beforehand."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodiff_plugin._reprojection import PosedCamera
from geodiff_plugin.formats import read_image
from geodiff_plugin.formats.clouds import flying_points, in_8_bits
from geodiff_plugin.formats.out import REPORT
from geodiff_plugin.jobs.records import PairResult
from geodiff_plugin.jobs.report import depth_summary, single_map
from geodiff_plugin.jobs.writing import cameras_of
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.result.standing import Standing, Tone, standing_of

Pixels = list[tuple[int, int]]
#: Depth in a stored result: whole millimetres.
MM = 1000.0
#: A 3D view ends at so many times the median depth.
BEYOND_MEDIAN = 4.0
#: And at so many times the depth that 95 % of the pixels have at most.
BEYOND_FAR = 1.3


@dataclass(frozen=True)
class Figure:
    """A number of the banner, and what it is."""

    value: str
    name: str


@dataclass(frozen=True, eq=False)
class Shown:
    """A result; maps are ``(H, W)``, and ``views`` has the left camera first."""

    photograph: np.ndarray  # (H, W, 3) uint8
    depth_m: np.ndarray  # float32
    views: tuple[PosedCamera, ...]
    standing: Standing
    messages: tuple[Message, ...]  # beside those of the standing
    figures: tuple[Figure, ...]
    cameras: str  # as they were understood
    confidence: np.ndarray | None = None  # in [0, 1]
    uncertainty_m: np.ndarray | None = None  # median absolute deviation of the members
    folder: Path | None = None  # of the files to take home
    title: str = ""  # what a result that was made beforehand is of

    @property
    def K(self) -> np.ndarray:
        """``(3, 3)`` of the left camera, pixels of the maps."""
        return self.views[0].K


def shown_of(job: PairResult) -> Shown:
    """The result of a job, whose report then names files without the server's folders."""
    output, inputs = job.run.output, job.run.inputs
    report = (job.folder / REPORT).read_text(encoding="utf-8")
    for path in (*job.run.options.photographs().values(), *job.run.options.calib):
        report = report.replace(str(path), path.name)
    (job.folder / REPORT).write_text(report, encoding="utf-8")
    standing = standing_of(output.verdict, output.assumed, (*inputs.notes, *job.run.log.warnings))
    of_verdict = output.verdict.message  # which only sums up the others
    summed_up = () if of_verdict is None else (of_verdict,)
    messages = distinct(output.verdict.remarks, inputs.notes, job.run.log.warnings)
    maps = {
        name: None if (value := getattr(output, name)) is None else single_map(value)
        for name in ("confidence", "uncertainty")
    }
    return Shown(
        photograph=in_8_bits(inputs.left),
        depth_m=single_map(output.prediction).astype(np.float32),
        views=cameras_of(output, inputs.guidance),
        standing=standing,
        messages=tuple(m for m in messages if m not in (*standing.reasons, *summed_up)),
        figures=_figures(job),
        cameras=_cameras(job),
        confidence=maps["confidence"],
        uncertainty_m=maps["uncertainty"],
        folder=job.folder,
    )


def _figures(job: PairResult) -> tuple[Figure, ...]:
    """Numbers for the banner; of a result that is not trusted only what is there, not how good it is."""
    output = job.run.output
    visible = None if output.visible is None else single_map(output.visible)
    depth = depth_summary(single_map(output.prediction * output.valid), visible)
    seconds = Figure(f"{sum(job.run.log.seconds.values()):.1f} s", "computing")
    if not output.verdict.trusted:
        return Figure(f"{depth['median_m']:.2f} m, unconfirmed", "median depth"), seconds
    figures = [
        Figure(f"{depth['min_m']:.2f} m to {depth['max_m']:.2f} m", "nearest and farthest"),
        Figure(f"{depth['median_m']:.2f} m", "median depth"),
    ]
    if visible is not None:
        figures.append(Figure(f"{100 * visible.mean():.0f} %", "seen by both cameras"))
    if output.confidence is not None:
        figures.append(Figure(f"{100 * np.median(output.confidence):.0f} %", "median confidence"))
    return (*figures, seconds)


def _cameras(job: PairResult) -> str:
    """The cameras as understood."""
    (fx, _, cx), (_, fy, cy), _ = np.asarray(job.run.output.K)[0].astype(np.float64)
    x, y, z = apart = job.run.inputs.guidance.rigs[0].E[:3, 3]
    ways = {"right": x, "left": -x, "below": y, "above": -y, "before": z, "behind": -z}
    way, away = max(ways, key=lambda side: ways[side]), np.linalg.norm(apart)
    lens = f"fx {fx:.1f}, fy {fy:.1f}, cx {cx:.1f}, cy {cy:.1f} px"
    return f"Left camera: {lens}; the right one {away:.3g} m away, {way}."


def kept_in_view(shown: Shown) -> np.ndarray:
    """``(H, W)`` of what a 3D view draws: no points that fly, and none far behind all others, like a sky."""
    depth_m = shown.depth_m
    known = np.isfinite(depth_m) & (depth_m > 0)
    most_m = 0.0
    if known.any():
        median_m, far_m = np.percentile(depth_m[known], (50, 95))
        most_m = min(BEYOND_MEDIAN * median_m, BEYOND_FAR * far_m)
    return known & (depth_m <= most_m) & ~flying_points(depth_m)


def save(path: Path, shown: Shown, pixels: Pixels) -> None:
    """Write a result without its photograph and files, with the pixels that were measured in it."""
    assert shown.confidence is not None
    words = {
        "pixels": pixels,
        "views": [[view.K.tolist(), view.E.tolist(), list(view.size)] for view in shown.views],
        "standing": [shown.standing.status, shown.standing.tone.value, shown.standing.words],
        "reasons": [[message.code, str(message)] for message in shown.standing.reasons],
        "messages": [[message.code, str(message)] for message in shown.messages],
        "figures": [[figure.value, figure.name] for figure in shown.figures],
        "cameras": shown.cameras,
    }
    np.savez_compressed(
        path,
        depth_mm=np.rint(shown.depth_m * MM).astype(np.uint16),
        confidence=np.rint(shown.confidence * 255).astype(np.uint8),
        words=np.frombuffer(json.dumps(words).encode(), np.uint8),
    )


def load(path: Path, photograph: Path, title: str) -> tuple[Shown, Pixels]:
    """A result of ``save`` and the photograph that it is of, and the pixels that were measured in it."""
    with np.load(path, allow_pickle=False) as file:
        words = json.loads(file["words"].tobytes())
        depth_m = (file["depth_mm"] / MM).astype(np.float32)
        confidence = (file["confidence"] / 255).astype(np.float32)
    status, tone, said = words["standing"]
    shown = Shown(
        photograph=in_8_bits(read_image(photograph)[0]),
        depth_m=depth_m,
        views=tuple(PosedCamera(np.array(K), np.array(E), tuple(size)) for K, E, size in words["views"]),
        standing=Standing(status, Tone(tone), said, _messages(words["reasons"])),
        messages=_messages(words["messages"]),
        figures=tuple(Figure(*figure) for figure in words["figures"]),
        cameras=words["cameras"],
        confidence=confidence,
        title=title,
    )
    return shown, [tuple(pixel) for pixel in words["pixels"]]


def _messages(stored: Sequence[Sequence[str]]) -> tuple[Message, ...]:
    return tuple(Message(code, text) for code, text in stored)
