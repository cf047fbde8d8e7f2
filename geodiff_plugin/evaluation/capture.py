"""``geodiff eval capture``: depth of a capture with the poses as given, by pairs, and solved together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.capture.agreement import DepthFrame
from geodiff_plugin.capture.capture import Capture
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.table import Table
from geodiff_plugin.formats.depth import read_depth_mm_png
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runner import Item, Journal, Runner, fingerprint
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance

__all__ = ["ROWS", "CaptureEvalOptions", "f_score", "run_capture_eval", "temporal_error"]

#: Rows: title, poses of the capture, knob ``pose`` of every call.
ROWS = {
    "given": ("poses as given", "given", "given"),
    "pairs": ("refined by pairs", "given", "refine"),
    "capture": ("solved over the capture", "refined", "given"),
}
#: Distance within which a point of a cloud counts as right, metres, and the clouds' grid.
RIGHT_M, CELL_M = 0.05, 0.02


@dataclass(frozen=True)
class CaptureEvalOptions:
    """What to measure.

    Attributes:
        command: as typed, for the page.
        data: a capture that names depth maps in millimetres.
        frames: ``NAME,NAME`` or ``FIRST:LAST:STEP``.
        neighbours: numbers of right views, a column each.
        rows: keys of ``ROWS``.
        prior: ``"bundled"``, a hub id or a folder.
        seed: of the noise.
        device: as ``--device``.
        out: folder of the records; a run goes on where it was stopped.
        results: where the Markdown page is written as well.
        quiet: no progress bar.
    """

    command: str
    data: Path
    frames: str | None = None
    neighbours: tuple[int, ...] = (2, 3, 5)
    rows: tuple[str, ...] = tuple(ROWS)
    prior: str = "bundled"
    seed: int = 0
    device: str = "auto"
    out: Path = Path("geodiff-eval")
    results: Path | None = None
    quiet: bool = False


def f_score(points: np.ndarray, truth: np.ndarray, right_m: float = RIGHT_M) -> tuple[float, float, float]:
    """Accuracy, completeness and their harmonic mean: shares of points nearer than this to the other cloud.

    Args:
        points: ``(N, 3)``.
        truth: ``(M, 3)``.
        right_m: the distance.

    Source: Knapitsch et al. 2017 (Tanks and Temples), S4.
    """
    if not len(points) or not len(truth):
        return 0.0, 0.0, 0.0
    accuracy = float((cKDTree(truth).query(points, distance_upper_bound=right_m)[0] < np.inf).mean())
    complete = float((cKDTree(points).query(truth, distance_upper_bound=right_m)[0] < np.inf).mean())
    return accuracy, complete, 2 * accuracy * complete / max(accuracy + complete, 1e-12)


def temporal_error(frames: Sequence[DepthFrame]) -> float:
    """TAE of frames in order, per cent: depth moved into the next frame's view beside the depth there.

    Source: Chen et al. 2025 (Video Depth Anything), S4.1; both directions, AbsRel over what both see.
    """
    errors = [_moved_error(a, b) for a, b in zip(frames, frames[1:], strict=False)]
    errors += [_moved_error(b, a) for a, b in zip(frames, frames[1:], strict=False)]
    return 100 * float(np.nanmean(errors)) if errors and not np.isnan(errors).all() else float("nan")


def _moved_error(frame: DepthFrame, other: DepthFrame) -> float:
    points = world_points(frame, np.ones(frame.depth.shape, bool))
    T = np.linalg.inv(other.E)
    x, y, z = _project(points, T, other.K)
    height, width = other.depth.shape
    u, v = np.rint(x).astype(int), np.rint(y).astype(int)
    seen = (z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    if seen.sum() < 100:
        return float("nan")
    there = other.depth[v[seen], u[seen]]
    off = np.abs(z[seen] / there - 1)
    return float(off[off < 0.3].mean())  # beyond it another surface hides the point


def _project(points: np.ndarray, T: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    at = points @ T[:3, :3].T + T[:3, 3]
    z = np.where(np.abs(at[:, 2]) < 1e-9, 1e-9, at[:, 2])
    return K[0, 0] * at[:, 0] / z + K[0, 2], K[1, 1] * at[:, 1] / z + K[1, 2], at[:, 2]


def world_points(frame: DepthFrame, mask: np.ndarray) -> np.ndarray:
    """``(N, 3)`` points of a frame in the world."""
    v, u = np.nonzero(mask)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(frame.K).T
    return rays * frame.depth[v, u][:, None] @ frame.E[:3, :3].T + frame.E[:3, 3]


def _thin(points: np.ndarray) -> np.ndarray:
    return points[np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_index=True)[1]]


def run_capture_eval(options: CaptureEvalOptions) -> Page:
    """Measure every row and number of neighbours, and write the page.

    Raises:
        InputError: a capture without depth maps, bad options.
        OSError: missing or unreadable files.
    """
    captures = {poses: Capture.open(options.data) for _, poses, _ in (ROWS[row] for row in options.rows)}
    names = next(iter(captures.values())).choose(options.frames)
    if any(next(iter(captures.values())).frame(name).depth is None for name in names):
        bad_value("DIR", "a capture that names depth maps of its frames", f"{options.data}")
    for poses, capture in captures.items():
        capture.solve(poses)
    device = pick_device(options.device)
    pipe = enable_geometry_guidance(load_prior(options.prior).to(device))
    pipe.set_progress_bar_config(disable=True)
    asked = fingerprint(__version__, str(options.data.resolve()), options.prior, options.seed, names)
    cells = [(row, count) for row in options.rows for count in options.neighbours]
    items = [
        Item(f"{row} {count} {name}", (row, count, name), asked) for row, count in cells for name in names
    ]

    def work(item: Item) -> dict[str, Any]:
        row, count, name = item.payload
        _, poses, pose = ROWS[row]
        capture = captures[poses]
        with torch.no_grad():
            out = capture.depth(pipe, name, count, seed=options.seed, knobs={"pose": pose})
        depth = np.asarray(out.prediction)[0, ..., 0]
        file = options.out / "depth" / row / str(count) / f"{name}.npy"
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, depth.astype(np.float32))
        return {"row": row, "neighbours": count, "frame": name, **_scores(depth, *_truth(capture, name))}

    journal = Journal(options.out / "capture.jsonl")
    records = Runner(items, journal, noun="frame", progress=not options.quiet).run(work)
    rows = []
    for row, count in cells:
        own = [r for r in records if (r["row"], r["neighbours"]) == (row, count)]
        folder = options.out / "depth" / row / str(count)
        rows.append(_row(captures[ROWS[row][1]], ROWS[row][0], count, own, folder))
    if "refined" in captures:
        rows.append(_row_of_points(captures["refined"], names))
    header = (
        *("poses", "views", "AbsRel", "worst", "scaled", "scale"),
        *("within 3 %", "within 25 %", "F 5 cm", "TAE %"),
    )
    note = (
        "AbsRel in metres, without alignment, mean and worst over the frames; scaled: each frame by its "
        "median. Scale: median of depth over truth. F: of the fused cloud beside that of the true depth "
        "under the same poses. TAE: of frames one after the other, as chosen."
    )
    title = f"{options.data.name}, {len(names)} frames"
    page = Page("Captures", run_facts(options.command), (Table(title, header, tuple(rows), note),), ())
    write_page(page, options.out, "capture", options.results)
    return page


def _truth(capture: Capture, name: str) -> tuple[np.ndarray, np.ndarray]:
    file = capture.frame(name).depth
    assert file is not None
    return read_depth_mm_png(file, f"the depth map of {name}")


def _scores(depth: np.ndarray, truth: np.ndarray, known: np.ndarray) -> dict[str, float]:
    d, t = depth[known], truth[known]
    ratio, factor = np.maximum(d / t, t / d), float(np.median(t / d))
    return {
        "abs_rel": float(np.mean(np.abs(d / t - 1))),
        "scaled": float(np.mean(np.abs(factor * d / t - 1))),
        "scale": 1 / factor,
        "delta_103": float((ratio < 1.03).mean()),
        "delta_125": float((ratio < 1.25).mean()),
    }


def _row(
    capture: Capture, title: str, count: int, records: Sequence[dict[str, Any]], folder: Path
) -> tuple[str, ...]:
    solved = capture.solve()
    frames, points, true_points = [], [], []
    for record in records:
        i = capture.names.index(record["frame"])
        truth, known = _truth(capture, record["frame"])
        depth = np.load(folder / f"{record['frame']}.npy")
        frames.append(DepthFrame(record["frame"], depth, np.ones_like(depth), solved.K[i], solved.E[i]))
        points.append(_thin(world_points(frames[-1], known)))
        true = DepthFrame(record["frame"], truth, np.ones_like(depth), solved.K[i], solved.E[i])
        true_points.append(_thin(world_points(true, known)))
    score = f_score(_thin(np.concatenate(points)), _thin(np.concatenate(true_points)))[2]
    means = {
        n: float(np.mean([r[n] for r in records])) for n in records[0] if isinstance(records[0][n], float)
    }
    worst = max(record["abs_rel"] for record in records)
    shown = [f"{v:.4f}" for v in (means["abs_rel"], worst, means["scaled"])]
    shown += [f"{v:.3f}" for v in (means["scale"], means["delta_103"], means["delta_125"], score)]
    return (title, str(1 + count), *shown, f"{temporal_error(frames):.2f}")


def _row_of_points(capture: Capture, names: Sequence[str]) -> tuple[str, ...]:
    """The solve's own sparse points, at their pixels."""
    solved, scores = capture.solve(), []
    for name in names:
        i = capture.names.index(name)
        truth, known = _truth(capture, name)
        seen, T = solved.seen[i], np.linalg.inv(solved.E[i])
        z = solved.points[seen.point] @ T[2, :3] + T[2, 3]
        u, v = np.rint(seen.px).astype(int).T.clip(0, np.array(truth.shape[::-1])[:, None] - 1)
        there = known[v, u] & (z > 0)
        if there.any():
            scores.append(_scores(z[there], truth[v, u][there], np.ones(int(there.sum()), bool)))
    if not scores:
        return ("COLMAP's sparse points", *["-"] * 9)
    means = {n: float(np.mean([s[n] for s in scores])) for n in scores[0]}
    worst = max(s["abs_rel"] for s in scores)
    shown = [f"{v:.4f}" for v in (means["abs_rel"], worst, means["scaled"])]
    shown += [f"{v:.3f}" for v in (means["scale"], means["delta_103"], means["delta_125"])]
    return ("COLMAP's sparse points", "all", *shown, "-", "-")
