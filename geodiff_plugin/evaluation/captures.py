"""Implements ``geodiff eval capture``: frames of a moving camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from geodiff_plugin import __version__
from geodiff_plugin.capture.agreement import agreed, seen_in
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.experiment import Experiment, Page, run_experiment
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import CAPTURE_ROWS, CaptureEvalOptions, CaptureRow
from geodiff_plugin.evaluation.tables import CellOf, Table, grouped, mean_of, table_of_groups
from geodiff_plugin.jobs import Item, Record, fingerprint
from geodiff_plugin.types import DepthFrame

#: Relative depth difference in the next frame above which a point is occluded and ignored.
OCCLUDED_FRACTION = 0.3
#: Maximum distance in metres of a correct point in a cloud (order of Tanks and Temples for rooms).
RIGHT_M = 0.05
#: Side in metres of the cells in which one point of a cloud is kept.
CELL_M = 0.02

_CAPTURE_COLUMNS: dict[str, CellOf] = {
    "poses": lambda group: str(group[0]["row"]),
    "views": lambda group: str(group[0]["views"]),
    "AbsRel": mean_of("abs_rel", 4),
    "worst": mean_of("worst", 4),
    "scaled": mean_of("scaled", 4),
    "scale": mean_of("scale"),
    "within 3 %": mean_of("delta_103"),
    "within 25 %": mean_of("delta_125"),
    "agreed": mean_of("agreed", 4),
    "F 5 cm": mean_of("f"),
    "TAE %": mean_of("tae", 2),
}
CAPTURE_NOTE = (
    "Poses are the tracker's, refined per frame from its own views, or solved over the whole capture. "
    "AbsRel in metres without alignment, mean and worst over the frames; scaled: each frame scaled by its "
    "median. Scale: median of depth over ground truth. Agreed: AbsRel after the consistency check between "
    "frames. F: F-score of the fused cloud against the cloud from ground-truth depth under the same poses. "
    "TAE: temporal alignment error between consecutive frames of the selection."
)


#: Minimum number of pixels of a frame that another one must observe for their difference to count.
MIN_SEEN_PIXELS = 100


def f_score(points: np.ndarray, ground_truth: np.ndarray) -> float:
    """F-score of points ``(N, 3)`` with tolerance ``RIGHT_M`` (Tanks and Temples, S4)."""
    if not len(points) or not len(ground_truth):
        return 0.0
    clouds = ((ground_truth, points), (points, ground_truth))
    distances = (cKDTree(to).query(of, distance_upper_bound=RIGHT_M)[0] for to, of in clouds)
    accuracy, complete = (float((near < np.inf).mean()) for near in distances)
    return 2 * accuracy * complete / max(accuracy + complete, 1e-12)


def temporal_error(frames: Sequence[DepthFrame]) -> float:
    """TAE of frames in order, per cent, both directions (Video Depth Anything, Chen et al. 2025, S4.1)."""
    errors = []
    for pair in pairwise(frames):
        for frame, other in (pair, pair[::-1]):
            row, column, z, inside = seen_in(frame, other)
            off = np.abs(z[inside] / other.depth[row, column][inside] - 1)
            off = off[off < OCCLUDED_FRACTION]
            if len(off) >= MIN_SEEN_PIXELS:
                errors.append(off.mean())
    return 100 * float(np.mean(errors)) if errors else float("nan")


def run_capture_eval(name: str, options: CaptureEvalOptions) -> Page | None:
    """Measure every row and number of neighbours, and write the page; errors as in ``run_experiment``."""
    priors = PriorCache()
    settings = options.settings
    cells = list[Item]()
    titles = dict[str, str]()
    for data in options.data:
        captures = {poses: Capture.open(data) for poses in ("given", "refined")}
        names = captures["given"].choose(options.frames)
        if options.count is not None:
            at = ((np.arange(options.count) + 0.5) * len(names) / options.count).astype(int)
            names = [names[i] for i in np.unique(at)]
        for frame in names:
            captures["given"].measured_depth(frame)  # raises if a frame has none
        titles[str(data)] = f"{data.name}, {len(names)} frames"
        pipe = priors.get(settings)
        how = (str(data.resolve()), names, options.prior, priors.fingerprint(settings), options.steps)
        for row, count in product(options.rows, options.neighbours):
            how_posed = CAPTURE_ROWS[row]
            work = partial(_measure_frames, captures[how_posed.poses], pipe, how_posed, count, names, options)
            head = {"data": str(data), "row": how_posed.title, "views": str(1 + count)}
            key = fingerprint(row, count, options.seed, __version__, *how)
            cells.append(Item(key, work, name=f"{data.name}, {row}, {1 + count} views", head=head))
        head = {"data": str(data), "row": "COLMAP's sparse points", "views": "all"}
        work = partial(_of_points, captures["refined"], names)
        key = fingerprint("points", __version__, *how)
        cells.append(Item(key, work, name=f"{data.name}, sparse points", head=head))

    def tables(records: list[Record]) -> list[Table]:
        captures = grouped(records, "data").items()
        return [table_of_groups(titles[data], group, ("key",), _CAPTURE_COLUMNS) for data, group in captures]

    of_captures = Experiment("Captures", cells, tables, lambda _: (CAPTURE_NOTE,))
    return run_experiment(name, options, of_captures)


def _measure_frames(
    capture: Capture,
    pipe: Any,
    row: CaptureRow,
    count: int,
    names: Sequence[str],
    options: CaptureEvalOptions,
) -> Record:
    """Return depth scores of all frames for one row and number of neighbours."""
    capture.solve(row.poses)
    call: dict[str, Any] = {} if options.steps is None else {"num_inference_steps": options.steps}
    frames, true_frames, known = [], [], []
    for name in names:
        with torch.no_grad():
            out = capture.depth(pipe, name, count, seed=options.seed, parameters={"pose": row.pose}, **call)
        camera = capture.camera(name)
        depth = np.asarray(out.prediction)[0, ..., 0]
        confidence = np.ones_like(depth) if out.confidence is None else np.asarray(out.confidence)[0, ..., 0]
        ground_truth, valid = capture.measured_depth(name)
        frames.append(DepthFrame(name, depth, confidence, camera))
        true_frames.append(DepthFrame(name, ground_truth, np.ones_like(depth), camera))
        known.append(valid)
    together = [agreed(frame, [other for other in frames if other is not frame]) for frame in frames]

    def mean_scores(estimated: Sequence[DepthFrame]) -> dict[str, float]:
        of_frames = zip(estimated, true_frames, known, strict=True)
        return _means([_scores(frame.depth, true.depth, mask) for frame, true, mask in of_frames])

    scores, checked = mean_scores(frames), mean_scores(together)
    f = f_score(_thin(together, known), _thin(true_frames, known))
    return scores | {"agreed": checked["abs_rel"], "f": f, "tae": temporal_error(together)}


def _thin(frames: Sequence[DepthFrame], known: Sequence[np.ndarray]) -> np.ndarray:
    points = np.concatenate([frame.world()[mask] for frame, mask in zip(frames, known, strict=True)])
    return points[np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_index=True)[1]]


def _of_points(capture: Capture, names: Sequence[str]) -> Record:
    """Return the solve's sparse points at their pixels."""
    solved = capture.solve()
    scores = []
    for name in names:
        i = capture.names.index(name)
        ground_truth, known = capture.measured_depth(name)
        (px, seen), T = solved.seen[i], np.linalg.inv(solved.E[i])
        z = solved.points[seen] @ T[2, :3] + T[2, 3]
        u, v = np.rint(px).astype(int).T.clip(0, np.array(ground_truth.shape[::-1])[:, None] - 1)
        scored = known[v, u] & (z > 0)
        if scored.any():
            scores.append(_scores(z[None], ground_truth[v, u][None], scored[None]))
    return _means(scores) if scores else {}


def _scores(depth: np.ndarray, ground_truth: np.ndarray, known: np.ndarray) -> dict[str, float]:
    scores = evaluate_depth(depth, ground_truth, known)
    ratio = depth[known] / ground_truth[known]
    scale = float(np.median(ratio))
    scaled = {"scaled": float(np.mean(np.abs(ratio / scale - 1))), "scale": scale}
    within = {"delta_103": float((np.maximum(ratio, 1 / ratio) < 1.03).mean()), "delta_125": scores["delta1"]}
    return {"abs_rel": scores["abs_rel"]} | scaled | within


def _means(scores: Sequence[dict[str, float]]) -> Record:
    worst = {"worst": max(each["abs_rel"] for each in scores)}
    return {name: float(np.mean([each[name] for each in scores])) for name in scores[0]} | worst
