"""Solves for the poses of a whole capture: tracks over all frames, bundle adjustment, and one scale.

A tracker's single baselines are off by 5 to 30 %, its whole trajectory and the scene depth under its poses by
a few per cent. The frames are therefore adjusted together with the given positions as robust priors, and one
factor scales the result to the best agreement with trajectory and scene.
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

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin._internal.statistics import MAX_SCALE_SPREAD
from geodiff_plugin.cameras import Camera
from geodiff_plugin.findings import Finding, some_names
from geodiff_plugin.pose.conventions import find_convention, median_px, reported_convention, residuals_px
from geodiff_plugin.pose.reconstruction import MIN_FRAMES_FOR_FOCAL, Match, Reconstruction, pycolmap
from geodiff_plugin.pose.refine import DEPTH_SPREAD, LENGTH_SPREAD

#: Number of following frames that a frame is matched with.
FOLLOWING = 6
#: Number of other frames with the same view that a frame is also matched with.
SAME_VIEW = 5
#: Maximum rotation between those frames, degrees.
MAX_ROTATION_DEG = 50.0
#: Minimum number of observations that connect a frame.
MIN_OBSERVATIONS = 25
#: Frames with less than this fraction of the median number of features count as blurred.
BLURRED_FRACTION = 0.15
#: Rounds of triangulation and adjustment: maximum reprojection error and scale of the Cauchy loss, pixels.
ROUNDS = ((20.0, 4.0), (8.0, 2.0), (3.0, 1.0))
#: Maximum relative change of the focal length.
MAX_FOCAL_CHANGE = 0.15
#: Maximum ratio of the solve's residual to the residual of the given poses; otherwise these are kept.
MIN_GAIN = 0.9
#: Minimum number of matches for comparing the fit of a frame's poses.
MIN_PER_FRAME = 50
#: Minimum relative error of a scale from the trajectory: frames share errors that no spread shows.
SCALE_FLOOR_TRAJECTORY = 0.02
#: Minimum relative error of a scale from the scene's depth.
SCALE_FLOOR_DEPTH = 0.015
#: Log ratio of both scales above which they are reported as inconsistent.
MAX_LOG_RATIO = 0.1
#: Multiple of the median displacement beyond which a given position is reported as wrong.
FAR_TIMES = 10.0
#: Fraction of the trajectory's size that the displacement must also exceed, so that accurate poses are not
#: reported.
FAR_FRACTION = 0.1
#: Pixels ``(n, 2)`` at which one frame sees points of the solve, and the indices ``(n,)`` of these points.
Observations = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class SolvedCapture:
    """Poses of all frames after the solve."""

    status: str  # "given" (not refined), "kept" (no better poses), "solved", or "estimated" (none given)
    E: np.ndarray  # (N, 4, 4) camera-to-world in the given poses' unit, NaN for a frame without pose
    E_given: np.ndarray | None  # the same, as given
    K: np.ndarray  # (N, 3, 3) pixels
    connected: np.ndarray  # (N,) frames in the solve; the others keep their given pose
    points: np.ndarray  # (M, 3) world
    seen: tuple[Observations, ...]  # one entry per frame
    residual_px_given: float = math.nan  # median epipolar distance under the given poses
    residual_px: float = math.nan  # the same under the solved poses
    scale_trajectory: float = 1.0  # factor from the adjusted lengths to the lengths of the given positions
    scale_depth: float = 1.0  # factor to the depth of the scene under the given poses
    scale_rel_std: float = math.nan  # relative standard deviation of the applied scale
    findings: tuple[Finding, ...] = ()
    overlays: np.ndarray | None = None  # (h, w) bool, static pixels of every frame, downscaled

    def pose(self, of: int, other: int) -> np.ndarray:
        """Return the pose ``(4, 4)`` of frame ``other`` in frame ``of``: both solved, or both as given."""
        E = self.E
        if self.E_given is not None and not (self.connected[of] and self.connected[other]):
            E = self.E_given
        return np.linalg.inv(E[of]) @ E[other]

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Return each camera's displacement from its given pose, ``(N,)``, and rotation, ``(N,)`` degrees."""
        if self.E_given is None:
            return np.zeros(len(self.E)), np.zeros(len(self.E))
        given, solved = (Rotation.from_matrix(E[:, :3, :3]) for E in (self.E_given, self.E))
        distances = np.linalg.norm(self.E[:, :3, 3] - self.E_given[:, :3, 3], axis=1)
        return distances, np.degrees((given.inv() * solved).magnitude())


@dataclass(frozen=True, eq=False)
class GivenFrames:
    """The given cameras of all frames, and the frames' names for findings."""

    names: Sequence[str]
    cameras: Sequence[Camera]
    E: np.ndarray | None  # (N, 4, 4) camera-to-world; ``None``: poses are estimated


def solve_capture(
    images: Iterable[np.ndarray], given: GivenFrames, *, poses: str = "refined", threads: int = 1
) -> SolvedCapture:
    """Solve for the poses of all frames.

    Args:
        images: grey ``(H, W)`` uint8 without distortion, masked arrays if some pixels are not valid; read
            once, in order.
        given: the cameras of the images.
        poses: ``"refined"``, or ``"given"`` to keep the given ones and triangulate points with them.
        threads: number of threads for features, matching and adjustment.
    """
    pycolmap()
    with tempfile.TemporaryDirectory(prefix="geodiff-capture-") as work:
        base = Reconstruction(Path(work), given.cameras, threads)
        base.extract(images)
        base.match(candidate_pairs(given.E, len(given.cameras)))
        blurred = np.flatnonzero(base.features < BLURRED_FRACTION * np.median(base.features))
        findings: list[Finding] = []
        if len(blurred):
            these = some_names([given.names[int(i)] for i in blurred])
            sentence = f"{these}: blurred or without texture, so they match other frames poorly."
            findings.append(Finding("capture.blurred", sentence))
        if given.E is None:
            result = _from_nothing(base, findings)
        else:
            E = _in_convention(base, np.asarray(given.E, float), findings)
            result = _from_given(base, E, findings, poses == "refined")
        return _with_findings(result, findings, given.names)


def candidate_pairs(E: np.ndarray | None, count: int) -> list[tuple[int, int]]:
    """Return the pairs of frames to match: consecutive ones, and those with the same view by their poses."""
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + FOLLOWING + 1))}
    if E is None:  # overlap unknown: growing steps, and all pairs of a small capture
        steps = range(1, count) if count <= 40 else [FOLLOWING * 2**k for k in range(1, 6)]
        pairs |= {(i, i + step) for step in steps for i in range(0, count - step)}
        return sorted(pairs)
    centres, axes = E[:, :3, 3], E[:, :3, 2]
    angles = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    for i in range(count):
        distances = np.linalg.norm(centres - centres[i], axis=1)
        cost = angles[i] / 30 + distances / max(float(np.median(distances)), 1e-9)
        order = [j for j in np.argsort(cost) if abs(i - j) > FOLLOWING and angles[i, j] < MAX_ROTATION_DEG]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order[:SAME_VIEW]}
    return sorted(pairs)


def _of_frames(matches: Sequence[Match], distances: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Compute the median distance of every frame's matches, ``(N,)``; NaN for too few."""
    parts: list[list[np.ndarray]] = [[] for _ in range(count)]
    for (i, j, *_), distance in zip(matches, distances, strict=True):
        parts[i].append(distance)
        parts[j].append(distance)
    return np.array([median_px(p) if sum(map(len, p)) >= MIN_PER_FRAME else math.nan for p in parts])


def _in_convention(base: Reconstruction, E: np.ndarray, findings: list[Finding]) -> np.ndarray:
    """Convert the given poses from the convention detected by the matches' residuals."""
    if not base.matches:
        sentence = "No two frames match, so the poses were not checked. Are they sharp and of one scene?"
        findings.append(Finding("capture.no-matches", sentence))
        return E
    found = find_convention(E, base.K_given, base.matches)
    findings += reported_convention(found)
    return found.E


def _from_given(
    base: Reconstruction, given: np.ndarray, findings: list[Finding], refine: bool
) -> SolvedCapture:
    """Triangulate with the given poses, adjust, and triangulate again; keep the better pose of each frame."""
    matches = base.matches
    before = residuals_px(given, base.K_given, matches)
    as_given = (median_px(before),) * 2

    def triangulate_given() -> Any:
        return base.triangulated(base.model(given), ROUNDS[0][0])

    start = triangulate_given()
    if not refine or start.num_points3D() < MIN_OBSERVATIONS:
        return replace(_result(base, start, "given", given, as_given), E=given)
    by_given = base.depths(start)
    focal = len(base) >= MIN_FRAMES_FOR_FOCAL
    model = _adjust(base, start, given, focal)
    if focal and np.abs(base.K(model)[:, 0, 0] / base.K_given[:, 0, 0] - 1).max() > MAX_FOCAL_CHANGE:
        sentence = "The best-fitting focal length is far from the given one, so the given one is kept."
        findings.append(Finding("capture.focal", sentence))
        model = _adjust(base, triangulate_given(), given, False)
    after = residuals_px(base.poses(model), base.K(model), matches)
    if not median_px(after) < MIN_GAIN * as_given[0]:
        sentence = f"No better poses were found: the given ones fit within {as_given[0]:.2f} px and are kept."
        findings.append(Finding("capture.kept", sentence))
        return replace(_result(base, triangulate_given(), "kept", given, as_given), E=given)
    result = _result(base, model, "solved", given, (as_given[0], median_px(after)))
    worse = _of_frames(matches, after, len(base)) > _of_frames(matches, before, len(base))
    result = replace(result, connected=result.connected & ~worse)
    return _rescale(result, by_given, base.depths(model))


def _adjust(base: Reconstruction, model: Any, given: np.ndarray, focal: bool) -> Any:
    """Run all rounds on the model; the focal length is refined in the last."""
    for number, (error_px, loss_px) in enumerate(ROUNDS):
        if number:
            model = base.triangulated(model, error_px)
        base.adjust(model, given, loss_px, focal and number == len(ROUNDS) - 1)
    return model


def _rescale(
    result: SolvedCapture, by_given: list[dict[int, float]], solved: list[dict[int, float]]
) -> SolvedCapture:
    """Scale the capture to the trajectory and to the depth of the scene under the given poses."""
    assert result.E_given is not None
    centres, given = result.E[:, :3, 3], result.E_given[:, :3, 3]
    ratios = np.full(len(centres), np.nan)
    for i, (a, b) in enumerate(zip(by_given, solved, strict=True)):
        logs = [math.log(a[k] / b[k]) for k in a.keys() & b.keys()]
        if len(logs) >= MIN_OBSERVATIONS:
            ratios[i] = np.median(logs)

    def middle(kept: np.ndarray) -> float:
        known = ratios[kept][np.isfinite(ratios[kept])]
        return float(np.median(known)) if len(known) else 0.0

    def of_trajectory(kept: np.ndarray) -> float:
        return math.log(_similarity(centres[kept], given[kept])[0])

    blocks = np.array_split(np.arange(len(centres)), min(8, len(centres)))
    depth = _Estimate(0.0, math.inf)
    if np.isfinite(ratios).any():
        depth = _jackknife(middle, blocks, DEPTH_SPREAD).not_below(SCALE_FLOOR_DEPTH)
    trajectory = _jackknife(of_trajectory, blocks, LENGTH_SPREAD).not_below(SCALE_FLOOR_TRAJECTORY)
    both = _combine(depth, trajectory)
    return replace(
        _align(result, result.E_given, math.exp(both.value)),
        scale_trajectory=math.exp(trajectory.value),
        scale_depth=math.exp(depth.value),
        scale_rel_std=both.spread,
    )


def _align(result: SolvedCapture, E_given: np.ndarray, scale: float) -> SolvedCapture:
    """Scale the capture, and rotate and shift it to the given poses ``(N, 4, 4)``."""
    centres = result.E[:, :3, 3]
    given = E_given[:, :3, 3]
    # Viewing directions count three times as much as positions: positions on a line leave a rotation
    # undetermined.
    radius = 3.0 * float(np.median(np.linalg.norm(given - np.median(given, axis=0), axis=1)))

    def with_directions(places: np.ndarray, E: np.ndarray) -> np.ndarray:
        """Append to positions ``(N, 3)`` the points in front of them along the axes of each camera."""
        return np.concatenate([places, *(places + radius * E[:, :3, axis] for axis in range(3))])

    _, Q = _similarity(with_directions(scale * centres, result.E), with_directions(given, E_given))
    rotated = scale * centres @ Q.T
    shift = np.median(given - rotated, axis=0)
    E = result.E.copy()
    E[:, :3, :3], E[:, :3, 3] = Q @ E[:, :3, :3], rotated + shift
    return replace(result, E=E, points=scale * result.points @ Q.T + shift)


class _Estimate(NamedTuple):
    """The log of a scale and its standard error."""

    value: float
    spread: float

    def not_below(self, floor: float) -> _Estimate:
        return self._replace(spread=math.hypot(self.spread, floor))


def _combine(a: _Estimate, b: _Estimate) -> _Estimate:
    """Average with inverse-variance weights; the standard error includes the disagreement of both values."""
    weights = np.array([a.spread, b.spread]) ** -2.0
    fractions = weights / weights.sum()
    value = float(fractions @ (a.value, b.value))
    disagreement = math.sqrt(float(fractions.prod())) * abs(a.value - b.value)
    return _Estimate(value, math.hypot(float(weights.sum() ** -0.5), disagreement))


def _jackknife(
    statistic: Callable[[np.ndarray], float], blocks: Sequence[np.ndarray], of_two: float
) -> _Estimate:
    """Compute a statistic of all frames and its jackknife standard error, leaving out blocks of frames.

    With two frames, neither of which can be left out, the error is ``of_two``.
    """
    every = np.concatenate(blocks)
    value = statistic(every)
    if len(blocks) < 3:
        return _Estimate(value, of_two)
    left = np.array([statistic(np.setdiff1d(every, block)) for block in blocks])
    variance = (len(blocks) - 1) / len(blocks) * ((left - left.mean()) ** 2).sum()
    return _Estimate(value, math.sqrt(float(variance)))


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Compute scale and rotation from points ``a`` to ``b``, robust against single outliers."""
    weights = np.ones(len(a))
    for _ in range(10):
        fraction = weights / weights.sum()
        mean_a, mean_b = fraction @ a, fraction @ b
        x, y = a - mean_a, b - mean_b
        U, D, V = np.linalg.svd((y * fraction[:, None]).T @ x)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ V))])
        Q = U @ np.diag(signs) @ V
        scale = float((D * signs).sum() / max((fraction * (x**2).sum(1)).sum(), 1e-18))
        off = np.linalg.norm(y - scale * x @ Q.T, axis=1)
        weights = 1 / (1 + (off / max(2.0 * float(np.median(off)), 1e-9)) ** 2)
    return scale, Q


def _result(
    base: Reconstruction, model: Any, status: str, given: np.ndarray | None, residuals: tuple[float, float]
) -> SolvedCapture:
    """Extract the capture from a model, in its world frame."""
    by_number = dict(model.points3D.items())  # every access of the property copies all points
    E = base.poses(model)
    numbers = sorted(by_number)
    rows = {number: row for row, number in enumerate(numbers)}
    seen = []
    for i in range(len(base)):
        image = model.image(i + 1) if model.exists_image(i + 1) else None
        pairs = [(p.xy, rows[p.point3D_id]) for p in image.points2D if p.has_point3D()] if image else []
        px = np.array([xy for xy, _ in pairs]).reshape(-1, 2)
        seen.append((base.pixels(i, px), np.array([row for _, row in pairs], int)))
    enough = np.array([len(points) >= MIN_OBSERVATIONS for _, points in seen])
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


def _with_findings(result: SolvedCapture, findings: list[Finding], names: Sequence[str]) -> SolvedCapture:
    """Add findings about the scale and about unconnected frames to the capture."""
    ratio = result.scale_trajectory / result.scale_depth
    spread = result.scale_rel_std
    if abs(math.log(ratio)) > MAX_LOG_RATIO:
        sentence = (
            "The scales from the given positions and from the scene depth under the given poses differ by "
            f"{100 * abs(ratio - 1):.0f} %; their mean is used. Pass --known-length for an exact one."
        )
        findings.append(Finding("capture.scales", sentence))
    if spread > MAX_SCALE_SPREAD:
        sentence = f"The scale is uncertain by {100 * spread:.0f} %. Pass --known-length for an exact one."
        findings.append(Finding("capture.scale", sentence))
    if result.status == "solved" and result.E_given is not None:
        moved = result.moved()[0]
        size = np.linalg.norm(np.ptp(result.E_given[:, :3, 3], axis=0))
        least = max(FAR_TIMES * float(np.nanmedian(moved)), FAR_FRACTION * float(size))
        far = result.connected & (moved > least)  # the others keep their poses
        if wrong := [name for name, is_far in zip(names, far, strict=True) if is_far]:
            sentence = (
                f"The given poses of {some_names(wrong)} are far from the solved ones and are not used."
            )
            findings.append(Finding("capture.wrong-poses", sentence))
    lost = [name for name, connected in zip(names, result.connected, strict=True) if not connected]
    if lost and result.status != "given":
        kept = "have no pose and are skipped" if result.E_given is None else "keep their given poses"
        kept = f"share too few points or fit worse when refined, and {kept}"
        sentence = f"{len(lost)} of {len(names)} frames {kept}: {some_names(lost)}."
        findings.append(Finding("capture.unconnected", sentence))
    return replace(result, findings=tuple(findings))


def _from_nothing(base: Reconstruction, findings: list[Finding]) -> SolvedCapture:
    """Run structure from motion without given poses and return the largest model."""
    models = base.from_nothing()
    if not models:
        hint = "Take images that overlap by two thirds, of a textured scene, while moving sideways."
        bad_value("the frames", "connected by matches", "no connected pair", hint)
    E, K = base.poses(models[0]), base.K(models[0])
    there = np.isfinite(E).all((1, 2))
    after = median_px(residuals_px(E, K, [m for m in base.matches if there[[m.i, m.j]].all()]))
    if len(models) > 1 and not there.all():  # another model may contain frames of the largest one
        sentence = f"The frames form {len(models)} unconnected parts; the largest is used."
        findings.append(Finding("capture.components", sentence))
    return _result(base, models[0], "estimated", None, (math.nan, after))
