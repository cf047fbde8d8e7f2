"""One solve for the poses of a whole capture: tracks over all frames, bundle adjustment, one scale.

A tracker's single baselines are wrong by 5 to 30 %, its whole trajectory and the depth of the scene under
its poses by a few per cent. So the frames are adjusted together with the given positions as robust priors,
and one factor brings the result to the scale on which trajectory and scene agree best.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._certain import MAX_SCALE_SPREAD
from geodiff_plugin._checks import bad_value
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.conventions import find_convention, median_px, noted_convention, residuals_px
from geodiff_plugin.pose.reconstruction import FEWEST_FOR_FOCAL, Match, Reconstruction, pycolmap
from geodiff_plugin.pose.refine import DEPTH_SPREAD, LENGTH_SPREAD

#: A frame is matched with so many frames after it.
AFTER = 6
#: It is also matched with so many others that look at the same place.
ELSEWHERE = 5
#: These are turned by this much against it at most, degrees.
MOST_TURN_DEG = 50.0
#: Fewer observations than this connect no frame.
FEWEST_OBSERVATIONS = 25
#: Frames with less than this share of the usual features are blurred.
BLURRED_SHARE = 0.15
#: Rounds of triangulation and adjustment: most reprojection error, scale of the Cauchy loss, both pixels.
ROUNDS = ((20.0, 4.0), (8.0, 2.0), (3.0, 1.0))
#: The furthest that the focal length may move, as a share of itself.
MOST_FOCAL = 0.15
#: A solve must leave less than this share of the residual of the given poses, or they are kept.
LEAST_GAIN = 0.9
#: Fewest matches of a frame that say which poses fit it.
FEWEST_PER_FRAME = 50
#: A scale from the trajectory is never known better than this: frames share errors that no spread shows.
SCALE_FLOOR_TRAJECTORY = 0.02
#: The same of a scale from the depth of the scene.
SCALE_FLOOR_DEPTH = 0.015
#: Both scales are called in disagreement beyond this.
DISAGREES = 0.1
#: A given position is reported as wrong if the solve moves it this many times as far as the median one.
FAR_TIMES = 10.0
#: It also moves it by this share of the size of the trajectory, so that exact poses are not reported.
FAR_SHARE = 0.1
#: Names that a sentence gives.
MOST_NAMES = 5
#: Where one frame sees points of the solve, ``(n, 2)`` pixels, and the rows ``(n,)`` of these points.
Observations = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class SolvedCapture:
    """Poses of all frames after the solve."""

    status: str  # "given" (switched off), "kept" (no better poses), "solved" or "estimated" (from nothing)
    E: np.ndarray  # (N, 4, 4) camera-to-world in the given poses' unit, NaN for a frame without any pose
    E_given: np.ndarray | None  # the same as given
    K: np.ndarray  # (N, 3, 3) pixels
    connected: np.ndarray  # (N,) frames that the solve holds; the others keep their pose as given
    points: np.ndarray  # (M, 3) world
    seen: tuple[Observations, ...]  # of every frame
    residual_px_given: float = math.nan  # median distance of matches from epipolar lines, poses as given
    residual_px: float = math.nan  # the same with these
    scale_trajectory: float = 1.0  # factor from the adjusted lengths to those of the given positions
    scale_depth: float = 1.0  # the same to the depth of the scene under the given poses
    scale_spread: float = math.nan  # relative standard deviation of the scale in use
    notes: tuple[Message, ...] = ()

    def pose(self, of: int, beside: int) -> np.ndarray:
        """``(4, 4)`` pose of frame ``beside`` in the frame of ``of``: both solved, or both as given."""
        E = self.E
        if self.E_given is not None and not (self.connected[of] and self.connected[beside]):
            E = self.E_given
        return np.linalg.inv(E[of]) @ E[beside]

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """How far each camera moved from its given pose, ``(N,)``, and turned, ``(N,)`` degrees."""
        if self.E_given is None:
            return np.zeros(len(self.E)), np.zeros(len(self.E))
        given, solved = (Rotation.from_matrix(E[:, :3, :3]) for E in (self.E_given, self.E))
        apart = np.linalg.norm(self.E[:, :3, 3] - self.E_given[:, :3, 3], axis=1)
        return apart, np.degrees((given.inv() * solved).magnitude())


@dataclass(frozen=True, eq=False)
class GivenFrames:
    """The cameras of all frames as they are given, and what notes call the frames."""

    names: Sequence[str]
    K: np.ndarray  # (N, 3, 3) pixels
    E: np.ndarray | None  # (N, 4, 4) camera-to-world; ``None``: poses are estimated from nothing
    sizes: Sequence[tuple[int, int]]  # (width, height)


def solve_capture(
    images: Iterable[np.ndarray], given: GivenFrames, *, poses: str = "refined", threads: int = 1
) -> SolvedCapture:
    """Solve for the poses of all frames.

    Args:
        images: grey ``(H, W)`` uint8, free of distortion; read once, in order.
        given: the cameras of the images.
        poses: ``"refined"``, or ``"given"`` to keep the given ones and find points by them.
        threads: of features, matching and adjustment.
    """
    pycolmap()
    with tempfile.TemporaryDirectory(prefix="geodiff-capture-") as work:
        base = Reconstruction(Path(work), np.asarray(given.K, float), given.sizes, threads)
        base.extract(images)
        base.match(candidate_pairs(given.E, len(given.sizes)))
        blurred = np.flatnonzero(base.features < BLURRED_SHARE * np.median(base.features))
        notes: list[Message] = []
        if len(blurred):
            these = _some_names([given.names[int(i)] for i in blurred])
            sentence = f"{these}: blurred or without texture; they are no good neighbours of others."
            notes.append(Message("capture.blurred", sentence))
        if given.E is None:
            result = _from_nothing(base, notes)
        else:
            E = _in_convention(base, np.asarray(given.E, float), notes)
            result = _from_given(base, E, notes, poses == "refined")
        return _noted(result, notes, given.names)


def _some_names(names: Sequence[str]) -> str:
    """Names for a sentence, the first few of many."""
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more


def candidate_pairs(E: np.ndarray | None, count: int) -> list[tuple[int, int]]:
    """Pairs of frames to match: those after each other, and those that look at one place by their poses."""
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + AFTER + 1))}
    if E is None:  # nothing says what else overlaps: ever larger steps, and all pairs of a small capture
        steps = range(1, count) if count <= 40 else [AFTER * 2**k for k in range(1, 6)]
        pairs |= {(i, i + step) for step in steps for i in range(0, count - step)}
        return sorted(pairs)
    centres, axes = E[:, :3, 3], E[:, :3, 2]
    turns = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    for i in range(count):
        apart = np.linalg.norm(centres - centres[i], axis=1)
        cost = turns[i] / 30 + apart / max(float(np.median(apart)), 1e-9)
        order = [j for j in np.argsort(cost) if abs(i - j) > AFTER and turns[i, j] < MOST_TURN_DEG]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order[:ELSEWHERE]}
    return sorted(pairs)


def _of_frames(matches: Sequence[Match], distances: Sequence[np.ndarray], count: int) -> np.ndarray:
    """``(N,)`` median distance over the matches of every frame; NaN where it has too few."""
    parts: list[list[np.ndarray]] = [[] for _ in range(count)]
    for (i, j, *_), distance in zip(matches, distances, strict=True):
        parts[i].append(distance)
        parts[j].append(distance)
    return np.array([median_px(p) if sum(map(len, p)) >= FEWEST_PER_FRAME else math.nan for p in parts])


def _in_convention(base: Reconstruction, E: np.ndarray, notes: list[Message]) -> np.ndarray:
    """The given poses in our convention, found by the residuals of the matches."""
    if not base.matches:
        sentence = "No two frames match: are they of one scene, and sharp? The poses were not checked."
        notes.append(Message("capture.no-matches", sentence))
        return E
    found = find_convention(E, base.K_given, base.matches)
    notes += noted_convention(found)
    return found.E


def _from_given(base: Reconstruction, given: np.ndarray, notes: list[Message], refine: bool) -> SolvedCapture:
    """Triangulate by the given poses, adjust, triangulate again; keep what is better, frame by frame."""
    matches = base.matches
    before = residuals_px(given, base.K_given, matches)
    as_given = (median_px(before),) * 2

    def started() -> Any:
        return base.triangulated(base.model(given), ROUNDS[0][0])

    start = started()
    if not refine or start.num_points3D() < FEWEST_OBSERVATIONS:
        return replace(_result(base, start, "given", given, as_given), E=given)
    by_given = base.depths(start)
    focal = len(base) >= FEWEST_FOR_FOCAL
    model = _adjusted(base, start, given, focal)
    if focal and np.abs(base.K(model)[:, 0, 0] / base.K_given[:, 0, 0] - 1).max() > MOST_FOCAL:
        sentence = "The focal length that fits best is far from the given one, which is kept."
        notes.append(Message("capture.focal", sentence))
        model = _adjusted(base, started(), given, False)
    after = residuals_px(base.poses(model), base.K(model), matches)
    if not median_px(after) < LEAST_GAIN * as_given[0]:
        sentence = f"The given poses fit as well as any ({as_given[0]:.2f} px) and are kept."
        notes.append(Message("capture.kept", sentence))
        return replace(_result(base, started(), "kept", given, as_given), E=given)
    result = _result(base, model, "solved", given, (as_given[0], median_px(after)))
    worse = _of_frames(matches, after, len(base)) > _of_frames(matches, before, len(base))
    result = replace(result, connected=result.connected & ~worse)
    return _scaled(result, by_given, base.depths(model))


def _adjusted(base: Reconstruction, model: Any, given: np.ndarray, focal: bool) -> Any:
    """The model after all rounds; the focal length moves in the last."""
    for number, (error_px, loss_px) in enumerate(ROUNDS):
        if number:
            model = base.triangulated(model, error_px)
        base.adjust(model, given, loss_px, focal and number == len(ROUNDS) - 1)
    return model


def _scaled(
    result: SolvedCapture, by_given: list[dict[int, float]], solved: list[dict[int, float]]
) -> SolvedCapture:
    """The capture at one scale, from the trajectory and from the depth of the scene under the given poses."""
    assert result.E_given is not None
    centres, given = result.E[:, :3, 3], result.E_given[:, :3, 3]
    ratios = np.full(len(centres), np.nan)
    for i, (a, b) in enumerate(zip(by_given, solved, strict=True)):
        logs = [math.log(a[k] / b[k]) for k in a.keys() & b.keys()]
        if len(logs) >= FEWEST_OBSERVATIONS:
            ratios[i] = np.median(logs)

    def middle(kept: np.ndarray) -> float:
        known = ratios[kept][np.isfinite(ratios[kept])]
        return float(np.median(known)) if len(known) else 0.0

    def of_trajectory(kept: np.ndarray) -> float:
        return math.log(_similarity(centres[kept], given[kept])[0])

    blocks = np.array_split(np.arange(len(centres)), min(8, len(centres)))
    depth = _Estimate(0.0, math.inf)
    if np.isfinite(ratios).any():
        depth = _jackknifed(middle, blocks, DEPTH_SPREAD).not_below(SCALE_FLOOR_DEPTH)
    trajectory = _jackknifed(of_trajectory, blocks, LENGTH_SPREAD).not_below(SCALE_FLOOR_TRAJECTORY)
    both = _combined(depth, trajectory)
    return replace(
        _aligned(result, result.E_given, math.exp(both.value)),
        scale_trajectory=math.exp(trajectory.value),
        scale_depth=math.exp(depth.value),
        scale_spread=both.spread,
    )


def _aligned(result: SolvedCapture, E_given: np.ndarray, scale: float) -> SolvedCapture:
    """The capture times a scale, turned and shifted to where the given poses ``(N, 4, 4)`` have it."""
    centres, given = result.E[:, :3, 3], E_given[:, :3, 3]
    # Directions of view count three times as much as places: places on a line leave a turn about it open.
    reach = 3.0 * float(np.median(np.linalg.norm(given - np.median(given, axis=0), axis=1)))

    def with_directions(places: np.ndarray, E: np.ndarray) -> np.ndarray:
        """Places ``(N, 3)``, and the points that lie before them along the axes of each camera."""
        return np.concatenate([places, *(places + reach * E[:, :3, axis] for axis in range(3))])

    _, Q = _similarity(with_directions(scale * centres, result.E), with_directions(given, E_given))
    turned = scale * centres @ Q.T
    shift = np.median(given - turned, axis=0)
    E = result.E.copy()
    E[:, :3, :3], E[:, :3, 3] = Q @ E[:, :3, :3], turned + shift
    return replace(result, E=E, points=scale * result.points @ Q.T + shift)


class _Estimate(NamedTuple):
    """The log of a scale, and its standard error."""

    value: float
    spread: float

    def not_below(self, floor: float) -> _Estimate:
        return self._replace(spread=math.hypot(self.spread, floor))


def _combined(a: _Estimate, b: _Estimate) -> _Estimate:
    """The mean weighted by the inverse variances, and its standard error with what the two disagree by."""
    weights = np.array([a.spread, b.spread]) ** -2.0
    shares = weights / weights.sum()
    value = float(shares @ (a.value, b.value))
    disagreement = math.sqrt(float(shares.prod())) * abs(a.value - b.value)
    return _Estimate(value, math.hypot(float(weights.sum() ** -0.5), disagreement))


def _jackknifed(
    statistic: Callable[[np.ndarray], float], blocks: Sequence[np.ndarray], of_two: float
) -> _Estimate:
    """A statistic of all frames and its standard error, by leaving out one stretch of frames at a time.

    That of two frames, of which none can be left out, is ``of_two``.
    """
    every = np.concatenate(blocks)
    value = statistic(every)
    if len(blocks) < 3:
        return _Estimate(value, of_two)
    left = np.array([statistic(np.setdiff1d(every, block)) for block in blocks])
    variance = (len(blocks) - 1) / len(blocks) * ((left - left.mean()) ** 2).sum()
    return _Estimate(value, math.sqrt(float(variance)))


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Scale and rotation that bring points ``a`` to ``b``, robust against single wrong ones."""
    weights = np.ones(len(a))
    for _ in range(10):
        share = weights / weights.sum()
        mean_a, mean_b = share @ a, share @ b
        x, y = a - mean_a, b - mean_b
        U, D, V = np.linalg.svd((y * share[:, None]).T @ x)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ V))])
        Q = U @ np.diag(signs) @ V
        scale = float((D * signs).sum() / max((share * (x**2).sum(1)).sum(), 1e-18))
        off = np.linalg.norm(y - scale * x @ Q.T, axis=1)
        weights = 1 / (1 + (off / max(2.0 * float(np.median(off)), 1e-9)) ** 2)
    return scale, Q


def _result(
    base: Reconstruction, model: Any, status: str, given: np.ndarray | None, residuals: tuple[float, float]
) -> SolvedCapture:
    """What a model says, in its world's frame."""
    by_number = dict(model.points3D.items())  # every access of the property copies all points
    E, numbers = base.poses(model), sorted(by_number)
    rows, seen = {number: row for row, number in enumerate(numbers)}, []
    for i in range(len(base)):
        image = model.image(i + 1) if model.exists_image(i + 1) else None
        pairs = [(p.xy, rows[p.point3D_id]) for p in image.points2D if p.has_point3D()] if image else []
        px = np.array([xy for xy, _ in pairs]).reshape(-1, 2)
        seen.append((base.pixels(i, px), np.array([row for _, row in pairs], int)))
    enough = np.array([len(points) >= FEWEST_OBSERVATIONS for _, points in seen])
    return SolvedCapture(
        status,
        E,
        given,
        base.K(model),
        np.isfinite(E).all((1, 2)) & enough,
        np.array([by_number[number].xyz for number in numbers]).reshape(-1, 3),
        tuple(seen),
        *residuals,
    )


def _noted(result: SolvedCapture, notes: list[Message], names: Sequence[str]) -> SolvedCapture:
    """The capture with sentences on its scale and on frames that are not connected."""
    ratio, spread = result.scale_trajectory / result.scale_depth, result.scale_spread
    if abs(math.log(ratio)) > DISAGREES:
        sentence = (
            "The given positions, and the depth of the scene under the given poses, give scales that are "
            f"{100 * abs(ratio - 1):.0f} % apart; their mean is used. Give --known-length for an exact one."
        )
        notes.append(Message("capture.scales", sentence))
    if spread > MAX_SCALE_SPREAD:
        sentence = f"The scale is uncertain by {100 * spread:.0f} %: give --known-length for an exact one."
        notes.append(Message("capture.scale", sentence))
    if result.status == "solved" and result.E_given is not None:
        moved, size = result.moved()[0], np.linalg.norm(np.ptp(result.E_given[:, :3, 3], axis=0))
        least = max(FAR_TIMES * float(np.nanmedian(moved)), FAR_SHARE * float(size))
        far = result.connected & (moved > least)  # the others keep their poses
        if wrong := [name for name, is_far in zip(names, far, strict=True) if is_far]:
            sentence = (
                f"The given poses of {_some_names(wrong)} are far from where the pictures put these frames, "
                "and are not used."
            )
            notes.append(Message("capture.wrong-poses", sentence))
    lost = [name for name, connected in zip(names, result.connected, strict=True) if not connected]
    if lost and result.status != "given":
        kept = "have no pose and are skipped" if result.E_given is None else "keep their poses as given"
        kept = f"share too few points or fit worse when moved, and {kept}"
        sentence = f"{len(lost)} of {len(names)} frames {kept}: {_some_names(lost)}."
        notes.append(Message("capture.unconnected", sentence))
    return replace(result, notes=tuple(notes))


def _from_nothing(base: Reconstruction, notes: list[Message]) -> SolvedCapture:
    """Structure from motion without given poses; the largest model."""
    models = base.from_nothing()
    if not models:
        cure = "Take photographs that overlap by two thirds, of a scene with texture, moving sideways."
        bad_value("the frames", "connected by matches", "no two that are", cure)
    E, K = base.poses(models[0]), base.K(models[0])
    there = np.isfinite(E).all((1, 2))
    after = median_px(residuals_px(E, K, [m for m in base.matches if there[[m.i, m.j]].all()]))
    if len(models) > 1 and not there.all():  # another model may hold frames of the largest alone
        sentence = f"The frames form {len(models)} parts that are not connected; the largest is used."
        notes.append(Message("capture.parts", sentence))
    return _result(base, models[0], "estimated", None, (math.nan, after))
