"""``geodiff eval capture``: depth of a capture with the poses as given, by pairs, and solved together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from geodiff_plugin import __version__
from geodiff_plugin.capture.agreement import DepthFrame, agreed, seen_in
from geodiff_plugin.capture.capture import Capture
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.experiment import Experiment, Page
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import CaptureEvalOptions
from geodiff_plugin.evaluation.tables import Table
from geodiff_plugin.runner import Item, Record, fingerprint

__all__ = ["ROWS", "f_score", "run_capture_eval", "temporal_error"]

#: Rows: title, poses of the capture, knob ``pose`` of every call.
ROWS = {
    "given": ("poses as given", "given", "given"),
    "pairs": ("refined by pairs", "given", "refine"),
    "capture": ("solved over the capture", "refined", "given"),
}
#: Distance within which a point of a cloud counts as right, metres, and the clouds' grid.
RIGHT_M, CELL_M = 0.05, 0.02
#: A point that the next frame sees this much nearer or further is hidden there.
HIDDEN_SHARE = 0.3
PURPOSE = (
    "Depth of frames of a moving camera, with the bundled prior unless the command says otherwise: poses as "
    "the tracker gave them, refined by the views of each frame alone, and solved over the whole capture."
)
HEADER = (
    *("poses", "views", "AbsRel", "worst", "scaled", "scale"),
    *("within 3 %", "within 25 %", "agreed", "F 5 cm", "TAE %"),
)
NOTE = (
    "AbsRel in metres, without alignment, mean and worst over the frames; scaled: each frame by its median. "
    "Scale: median of depth over truth. Agreed: AbsRel after the frames of the table were checked against "
    "each other. F: of the fused cloud beside that of the true depth under the same poses. TAE: of frames "
    "one after the other, as chosen."
)


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
    errors = []
    for pair in zip(frames, frames[1:], strict=False):
        for frame, other in (pair, pair[::-1]):
            row, column, z, inside = seen_in(frame, other)
            off = np.abs(z[inside] / other.depth[row, column][inside] - 1)
            errors.append(off[off < HIDDEN_SHARE].mean() if (off < HIDDEN_SHARE).sum() >= 100 else np.nan)
    return 100 * float(np.nanmean(errors)) if errors and not np.isnan(errors).all() else float("nan")


def run_capture_eval(name: str, options: CaptureEvalOptions) -> Page | None:
    """Measure every row and number of neighbours, and write the page.

    Raises:
        InputError: a capture without depth maps, bad options.
        OSError: missing or unreadable files.
    """
    priors, settings, cells, titles = PriorCache(), options.settings, [], {}
    for data in options.data:
        captures = {poses: Capture.open(data) for poses in ("given", "refined")}
        names = _chosen(captures["given"], options)
        titles[str(data)] = f"{data.name}, {len(names)} frames"
        how = (str(data.resolve()), names, options.prior, priors.fingerprint(settings), options.steps)
        for row in options.rows:
            for count in options.neighbours:
                work = partial(
                    _measure, captures[ROWS[row][1]], priors.get(settings), row, count, names, options
                )
                head = {"data": str(data), "row": ROWS[row][0], "views": str(1 + count)}
                key = fingerprint(row, count, options.seed, __version__, *how)
                cells.append(Item(key, work, name=f"{data.name}, {row}, {1 + count} views", head=head))
        head = {"data": str(data), "row": "COLMAP's sparse points", "views": "all"}
        key = fingerprint("points", __version__, *how)
        work = partial(_of_points, captures["refined"], names)
        cells.append(Item(key, work, name=f"{data.name}, sparse points", head=head))
    experiment = Experiment(
        name, "Captures", cells, partial(_tables, titles), lambda records: (NOTE,), PURPOSE
    )
    return experiment.run(name, options)


def _chosen(capture: Capture, options: CaptureEvalOptions) -> list[str]:
    """Names of the frames to measure, all of which have a depth map."""
    names = capture.choose(options.frames)
    if options.count is not None:
        at = ((np.arange(options.count) + 0.5) * len(names) / options.count).astype(int)
        names = [names[i] for i in np.unique(at)]
    for name in names:
        capture.measured_depth(name)
    return names


def _measure(
    capture: Capture, pipe: Any, row: str, count: int, names: Sequence[str], options: CaptureEvalOptions
) -> Record:
    """Depth of every frame by one row and number of neighbours, and its scores."""
    solved = capture.solve(ROWS[row][1])
    call: dict[str, Any] = {} if options.steps is None else {"num_inference_steps": options.steps}
    frames, true_frames, known = [], [], []
    for name in names:
        with torch.no_grad():
            knobs = {"pose": ROWS[row][2]}
            out = capture.depth(pipe, name, count, seed=options.seed, knobs=knobs, **call)
        i, depth = capture.names.index(name), np.asarray(out.prediction)[0, ..., 0]
        confidence = np.ones_like(depth) if out.confidence is None else np.asarray(out.confidence)[0, ..., 0]
        truth, valid = capture.measured_depth(name)
        frames.append(DepthFrame(name, depth, confidence, solved.K[i], solved.E[i]))
        true_frames.append(DepthFrame(name, truth, np.ones_like(depth), solved.K[i], solved.E[i]))
        known.append(valid)
    together = [agreed(frame, [other for other in frames if other is not frame]) for frame in frames]
    f = f_score(_thin(together, known), _thin(true_frames, known))[2]
    scores = [
        _scores(frame.depth, true.depth, mask)
        for frame, true, mask in zip(frames, true_frames, known, strict=True)
    ]
    off = [
        _scores(frame.depth, true.depth, mask)["abs_rel"]
        for frame, true, mask in zip(together, true_frames, known, strict=True)
    ]
    more = {"agreed": float(np.mean(off)), "f": f, "tae": temporal_error(together)}
    return _means(scores) | more


def _thin(frames: Sequence[DepthFrame], known: Sequence[np.ndarray]) -> np.ndarray:
    points = np.concatenate([frame.world(mask) for frame, mask in zip(frames, known, strict=True)])
    return points[np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_index=True)[1]]


def _of_points(capture: Capture, names: Sequence[str]) -> Record:
    """The solve's own sparse points, at their pixels."""
    solved, scores = capture.solve(), []
    for name in names:
        i = capture.names.index(name)
        truth, known = capture.measured_depth(name)
        seen, T = solved.seen[i], np.linalg.inv(solved.E[i])
        z = solved.points[seen.point] @ T[2, :3] + T[2, 3]
        u, v = np.rint(seen.px).astype(int).T.clip(0, np.array(truth.shape[::-1])[:, None] - 1)
        there = known[v, u] & (z > 0)
        if there.any():
            scores.append(_scores(z[None], truth[v, u][None], there[None]))
    return _means(scores) if scores else {}


def _scores(depth: np.ndarray, truth: np.ndarray, known: np.ndarray) -> dict[str, float]:
    scores = evaluate_depth(depth, truth, known)
    ratio = depth[known] / truth[known]
    scale = float(np.median(ratio))
    scaled = {"scaled": float(np.mean(np.abs(ratio / scale - 1))), "scale": scale}
    within = {"delta_103": float((np.maximum(ratio, 1 / ratio) < 1.03).mean()), "delta_125": scores["delta1"]}
    return {"abs_rel": scores["abs_rel"]} | scaled | within


def _means(scores: Sequence[dict[str, float]]) -> Record:
    worst = {"worst": max(each["abs_rel"] for each in scores)}
    return {name: float(np.mean([each[name] for each in scores])) for name in scores[0]} | worst


def _tables(titles: dict[str, str], records: Sequence[Record]) -> list[Table]:
    """A table a capture."""
    digits = {"abs_rel": 4, "worst": 4, "scaled": 4, "scale": 3, "delta_103": 3, "delta_125": 3, "agreed": 4}
    digits |= {"f": 3, "tae": 2}
    tables = []
    for data, title in titles.items():
        rows = [
            (r["row"], r["views"], *(f"{r[key]:.{n}f}" if key in r else "-" for key, n in digits.items()))
            for r in records
            if r["data"] == data
        ]
        tables.append(Table(title, HEADER, tuple(rows)))
    return tables
