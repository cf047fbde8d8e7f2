"""Fit the coefficients of confidence on pairs with ground truth, and evaluate them on other pairs.

It also measures confidence by the texture around pixels, and on walls whose depth is wrong.

python -m tests.benchmarks.confidence --data DIR --strengths exact,5%,20%
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from rich.console import Console
from rich.table import Table
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata
from torch import Tensor
from tqdm import tqdm

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.cli.commands import new_command
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, posed_views
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.experiment import DENSE
from geodiff_plugin.evaluation.metrics import RiskCoverage, risk_coverage
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.matching import consistency
from geodiff_plugin.matching.constants import AGREEMENT_PLANES, CONTRAST_RADIUS, LOG_ODDS, MIN_CONTRAST
from geodiff_plugin.options import Command
from geodiff_plugin.result import confidence, finish
from geodiff_plugin.result.constants import DEPTH_LOG_ODDS
from geodiff_plugin.settings import check_settings, setting
from tests.lab.options import STRENGTHS
from tests.lab.strength import EmulatedPrior
from tests.lab.surfaces import PLANES, guided_stages, marked_planes, of_polygon, plane_of

__all__ = [
    "Decile",
    "Observed",
    "OfTexture",
    "OnWalls",
    "Wall",
    "by_texture",
    "calibrate",
    "coverage_of_sigma",
    "deciles",
    "fit_log_odds",
    "observe_capture",
    "observe_depth",
    "observe_emulated",
    "observe_matches",
    "observe_planes",
    "of_walls",
    "off_plane",
    "promised",
    "risk_by_coverage",
    "texture_of",
]

#: Which sign each coefficient of ``LOG_ODDS``, and of ``DEPTH_LOG_ODDS``, may have; 0 for any.
MATCH_SIGNS, SIGNS = (0, 1, -1, -1), (0, 1, 1, 1, 1, -1)


def promised(evidence: np.ndarray, coefficients: Sequence[float] | np.ndarray) -> np.ndarray:
    """Probability ``(N,)`` of evidence ``(N, F)`` under coefficients ``(F,)``."""
    return expit(evidence @ np.asarray(coefficients, np.float64))


def fit_log_odds(
    evidence: np.ndarray, right: np.ndarray, weights: np.ndarray, signs: Sequence[int]
) -> np.ndarray:
    """Coefficients of greatest weighted likelihood, each within its sign.

    Args:
        evidence: ``(N, F)`` float; a column that never varies next to the constant gets 0.
        right: ``(N,)`` bool.
        weights: ``(N,)`` >= 0.
        signs: ``(F,)``: 1 for a coefficient >= 0, -1 for <= 0, 0 for any.

    Returns:
        ``(F,)`` float64.
    """
    x, y = np.asarray(evidence, np.float64), np.asarray(right, np.float64)
    w = np.asarray(weights, np.float64) / np.sum(weights)
    scale = np.maximum(np.sqrt(w @ x**2), 1e-12)
    unit = x / scale

    def loss(c: np.ndarray) -> tuple[float, np.ndarray]:
        z = unit @ c
        value = w @ (np.logaddexp(0.0, z) - y * z)
        return float(value), unit.T @ (w * (expit(z) - y))

    bounds = [{1: (0.0, None), -1: (None, 0.0), 0: (None, None)}[sign] for sign in signs]
    found = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds)
    return found.x / scale


class Decile(NamedTuple):
    """One tenth of the promises: their mean ``promised``, the part ``kept``, their ``fraction`` of all."""

    promised: float
    kept: float
    fraction: float


def deciles(probability: np.ndarray, right: np.ndarray, weights: np.ndarray) -> list[Decile]:
    """Promised against kept, by tenths of the probability (0 to .1, .1 to .2, ...) that are not empty."""
    found, total = [], weights.sum()
    index = np.minimum((probability * 10).astype(int), 9)
    for tenth in range(10):
        own = index == tenth
        mass = weights[own].sum()
        if mass > 0:
            found.append(
                Decile(
                    float(weights[own] @ probability[own] / mass),
                    float(weights[own] @ right[own] / mass),
                    float(mass / total),
                )
            )
    return found


#: Pixels of a pair that are looked at; more say nothing new.
PIXELS = 5000
#: Half width in px of the window over which the texture of an image is measured: that of the contrast.
TEXTURE_REACH = CONTRAST_RADIUS
#: Upper bounds of the classes of texture but the last: mean horizontal step of brightness, share of white.
TEXTURES = (0.005, 0.01, 0.02, 0.04)
#: Minimum confidence of a pixel that is assumed correct.
SURE = 0.9
#: Relative error above which the depth of a wall is off.
OFF = 0.05
#: Texture below which a wall is plain.
PLAIN = TEXTURES[2]
#: Distance of the inverse depth of a wall from the best plane of a window, root mean square over its mean.
FLAT = 0.005
#: Known share of such a window from which on there is a plane.
MIN_KNOWN = 0.3
#: Frames of a capture that are looked at, each with its best neighbour.
FRAMES = 6


class Observed(NamedTuple):
    """Pixels of one pair: what is known of each, and whether it was right."""

    evidence: np.ndarray  # (N, F) float64
    right: np.ndarray  # (N,) bool
    stated: np.ndarray | None = None  # (N,) the confidence of the output
    texture: np.ndarray | None = None  # (N,) ``texture_of`` the left image
    error: np.ndarray | None = None  # (N,) relative error of the depth, >= 0
    wall: np.ndarray | None = None  # (N,) 1 on plain walls, else 0
    sigma: np.ndarray | None = None  # (N,) standard deviation of the output relative to the depth
    deviation: np.ndarray | None = None  # (N,) error of the depth in these standard deviations, >= 0


class Wall(NamedTuple):
    """Pixels of the plain walls of one pair."""

    error: np.ndarray  # (N,) relative error of the depth, >= 0
    stated: np.ndarray  # (N,) the confidence of the output
    sigma: np.ndarray  # (N,) standard deviation of the output relative to the depth


def texture_of(image: np.ndarray) -> np.ndarray:
    """``(H, W)`` mean step of brightness between neighbours of a row around a pixel, of white.

    What a match of a rectified pair can hold on to; noise counts like paint.

    Args:
        image: ``(H, W, 3)`` uint8.
    """
    grey = image.astype(np.float64).mean(-1) / 255.0
    steps = np.abs(np.diff(grey, axis=1, prepend=grey[:, :1]))
    return uniform_filter(steps, 2 * TEXTURE_REACH + 1, mode="nearest")


def off_plane(depth_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``(H, W)`` distance of inverse depth from its best plane around a pixel, RMS over the mean.

    Infinite where ground truth is unknown in most of the window, of half width ``TEXTURE_REACH``.
    """
    row, column = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]] / max(depth_m.shape)
    inverse = np.where(valid, 1.0 / np.where(valid, depth_m, 1.0), 0.0)

    def mean(values: np.ndarray) -> np.ndarray:
        return uniform_filter(values * valid, 2 * TEXTURE_REACH + 1, mode="constant")

    known = mean(np.ones(depth_m.shape))
    fraction = np.maximum(known, 1e-9)
    y, x, q = (mean(values) / fraction for values in (row, column, inverse))
    yy, xx, yx = (
        mean(row * row) / fraction - y * y,
        mean(column**2) / fraction - x * x,
        mean(row * column) / fraction - y * x,
    )
    yq, xq, qq = (
        mean(one * inverse) / fraction - other * q for one, other in ((row, y), (column, x), (inverse, q))
    )
    determinant = np.maximum(yy * xx - yx**2, 1e-14)
    down, across = (xx * yq - yx * xq) / determinant, (yy * xq - yx * yq) / determinant
    rest = np.sqrt(np.maximum(qq - down * yq - across * xq, 0.0)) / np.maximum(q, 1e-9)
    return np.where(known >= MIN_KNOWN, rest, np.inf)


def _drawn(layers: np.ndarray, where: np.ndarray, seed: int) -> np.ndarray:
    """``(F, N)`` of ``layers (F, H, W)`` at random pixels of ``where (H, W)``, ``PIXELS`` at most."""
    at = np.flatnonzero(where)
    if len(at) > PIXELS:
        at = np.random.default_rng(seed).choice(at, PIXELS, replace=False)
    return layers.reshape(len(layers), -1)[:, at].astype(np.float64)


@contextmanager
def _recorded() -> Iterator[list[Tensor]]:
    """The evidence ``(1, F, H, W)`` of every confidence that is made within."""
    found, made = [], finish.depth_confidence

    def recording(*arguments: Any) -> Tensor:
        found.append(confidence.depth_evidence(*arguments))
        return made(*arguments)

    with patch.object(finish, "depth_confidence", recording):
        yield found


def _observe(
    call: Callable[[], Any], left: np.ndarray, depth_m: np.ndarray, valid: np.ndarray, seed: int
) -> Observed:
    """Observe a guided call on an image ``(H, W, 3)`` uint8, with ground truth where ``valid``."""
    with _recorded() as evidence:
        out = call()
    found_m, stated, sigma_m = (
        np.asarray(values).squeeze() for values in (out.prediction, out.confidence, out.sigma)
    )
    error = np.abs(found_m / np.where(valid, depth_m, 1.0) - 1.0)
    deviation = np.nan_to_num(np.abs(found_m - depth_m) / sigma_m)  # no sigma: there is no depth
    texture = texture_of(left)
    wall = (texture < PLAIN) & (off_plane(depth_m, valid) < FLAT)
    seen = np.stack([stated, texture, error, wall, sigma_m / found_m, deviation])
    layers = np.concatenate([seen, evidence[0][0].cpu().numpy()])
    seen, drawn = np.split(_drawn(layers, valid & np.isfinite(sigma_m), seed), [len(seen)])
    return Observed(drawn.T, seen[2] < confidence.RIGHT_WITHIN, *seen)


def observe_depth(sample: StereoSample, settings: Settings, priors: PriorCache) -> Observed:
    """Evidence of ``result.confidence`` of a guided call, and where its depth is within 10 %.

    Args:
        sample: with ground truth.
        settings: of the call; with an ensemble the spread of its members is evidence as well.
        priors: where the prior is kept.
    """
    guidance = GeometryGuidance(*posed_views(sample, settings.views))

    def call() -> Any:
        return priors.get(settings)(
            Image.fromarray(sample.left),
            guidance=guidance,
            output_uncertainty=settings.ensemble > 1,
            **call_arguments(settings),
        )

    return _observe(call, sample.left, sample.depth_m, sample.valid, settings.seed)


def observe_capture(root: Path, settings: Settings, priors: PriorCache) -> Iterator[Observed]:
    """As ``observe_depth``, of some frames of a capture, each with its best neighbour, poses as given."""
    capture = Capture.open(root)
    capture.solve("given")
    for i in ((np.arange(FRAMES) + 0.5) * len(capture) / FRAMES).astype(int):
        name = capture.names[i]
        left = np.rint(255.0 * capture.image(name)).astype(np.uint8)
        call = partial(capture.depth, priors.get(settings), name, 1, seed=settings.seed)
        yield _observe(call, left, *capture.measured_depth(name), settings.seed)


def observe_planes(root: Path, settings: Settings, priors: PriorCache) -> Iterator[Wall]:
    """Marked planes of pairs without ground truth; the error is the distance from the best plane."""
    for _, images, rig, planes in marked_planes(root):
        stages = guided_stages(priors.get(settings), images, rig, settings.seed)
        depth_m, stated, sigma_m = (stages.of(name) for name in ("result", "confidence", "sigma"))
        inside = [of_polygon(polygon, depth_m.shape) for polygon in planes.values()]
        error = [np.abs(plane_of(depth_m, each) * depth_m[each] - 1.0) for each in inside]
        further = (np.concatenate([x[each] for each in inside]) for x in (stated, sigma_m / depth_m))
        yield Wall(np.concatenate(error), *further)


def observe_emulated(sample: StereoSample, strengths: Sequence[str]) -> list[Observed]:
    """As ``observe_depth``, with emulated priors of several strengths; empty for sparse ground truth.

    Args:
        sample: with ground truth.
        strengths: keys of ``STRENGTHS``.
    """
    if sample.valid.mean() < DENSE:
        return []
    resolution = 384
    prior, settings = EmulatedPrior(), Settings(steps=4, resolution=resolution)
    found = []
    for name in strengths:
        prior.answer(sample, STRENGTHS[name], resolution, settings.seed)
        found.append(observe_depth(sample, settings, prior))
    return found


def observe_matches(sample: StereoSample, settings: Settings, priors: PriorCache) -> Observed:
    """Evidence of ``matching.consistency`` of checked matches, and which are within 3 planes of ground truth.

    Args:
        sample: with ground truth.
        settings: its device sweeps.
        priors: not used.
    """
    volume = sweep(sample, settings.device)
    with torch.no_grad():
        found, (contrast, _), (other, *_) = consistency.candidates(volume)
        view = consistency.view_evidence(volume.aligned[0], other, found)
    inverse_depth = volume.inverse_depth[0] + found.position * volume.plane_step
    agreed, textured = view.difference <= AGREEMENT_PLANES, contrast >= MIN_CONTRAST
    ground_truth = torch.from_numpy(np.where(sample.valid, sample.depth_m, 0.0)).float()[None, None]
    ground_truth_m = F.interpolate(ground_truth, volume.size, mode="nearest-exact")[0, 0].numpy()
    known = (agreed & textured).cpu().numpy() & (ground_truth_m > 0)
    error = np.abs(inverse_depth.cpu().numpy() - 1.0 / np.where(ground_truth_m > 0, ground_truth_m, 1.0))
    right = error <= 3.0 * float(volume.plane_step)
    layers = np.concatenate([right[None], view.features.cpu().numpy()])
    drawn = _drawn(layers, known, settings.seed)
    return Observed(drawn[1:].T, drawn[0] > 0)


def _stack(pairs: Sequence[Observed]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evidence, outcome and weight of all pixels; every pair weighs the same."""
    evidence, right = ([getattr(pair, name) for pair in pairs] for name in ("evidence", "right"))
    return np.concatenate(evidence), np.concatenate(right), _weights(pairs)


def _joined(parts: Sequence[Observed]) -> Observed:
    """The pixels of all parts; of matches, nothing is stated."""
    fields = {name: [getattr(part, name) for part in parts] for name in Observed._fields}
    known = {name: each for name, each in fields.items() if all(values is not None for values in each)}
    return Observed(**{name: np.concatenate(each) for name, each in known.items()})


def calibrate(
    pairs: Sequence[Observed], signs: Sequence[int]
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Fit on all pairs, and on each half of them to see what it promises for the other.

    Args:
        pairs: in the order of the data, so that every second one makes a half that has something of each set.
        signs: as for ``fit_log_odds``.

    Returns:
        Coefficients of all pairs; of each half; and of every pair the probabilities of its pixels by the
        coefficients of the half that it is not in.
    """
    fitted = [fit_log_odds(*_stack(half), signs) for half in (pairs[::2], pairs[1::2])]
    judged = [promised(pair.evidence, fitted[1 - i % 2]) for i, pair in enumerate(pairs)]
    return fit_log_odds(*_stack(pairs), signs), fitted, judged


def _constants(name: str, coefficients: Iterable[float]) -> str:
    return f"{name} = ({', '.join(f'{value:.3g}' for value in coefficients)})"


def _print_deciles(
    console: Console, title: str, pairs: Sequence[Observed], judged: Sequence[np.ndarray]
) -> None:
    """What was promised of some pairs and what was kept."""
    _, right, weights = _stack(pairs)
    table = Table("predicted", "observed", "fraction")
    worst = 0.0
    for decile in deciles(np.concatenate(judged), right, weights):
        table.add_row(*(f"{value:.3f}" for value in (decile.promised, decile.kept, decile.fraction)))
        worst = max(worst, abs(decile.promised - decile.kept))
    console.print(title, highlight=False, soft_wrap=True)
    console.print(table)
    console.print(f"largest gap between predicted and observed: {worst:.3f}", highlight=False)


class OfTexture(NamedTuple):
    """Predicted and observed accuracy in one class of texture; every pair has the same weight."""

    fraction: float  # of all pixels
    within: float  # of these, share within ``confidence.RIGHT_WITHIN``
    stated: float  # their mean confidence
    sure: float  # fraction of these with a confidence of ``SURE`` or more
    kept: float  # of the sure ones, share within ``confidence.RIGHT_WITHIN``; NaN where none is


def by_texture(pairs: Sequence[Observed]) -> list[OfTexture]:
    """One row for each class of ``TEXTURES``; NaN in a class without pixels."""
    _, right, weights = _stack(pairs)
    stated, texture = (np.concatenate([getattr(p, name) for p in pairs]) for name in ("stated", "texture"))
    rows = []
    for k in range(len(TEXTURES) + 1):
        own = np.digitize(texture, TEXTURES) == k
        sure = own & (stated >= SURE)
        mass, of_sure = weights[own].sum(), weights[sure].sum()
        within, said = (weights[own] @ values[own] for values in (right, stated))
        with np.errstate(invalid="ignore"):
            parts = np.array([within, said, of_sure]) / mass
            kept = np.float64(weights[sure] @ right[sure]) / of_sure
        share_within, mean_stated, share_sure = map(float, parts)
        rows.append(
            OfTexture(float(mass / weights.sum()), share_within, mean_stated, share_sure, float(kept))
        )
    return rows


def _print_textures(console: Console, title: str, pairs: Sequence[Observed]) -> None:
    """The table of ``by_texture``."""
    heads = (
        "pixels",
        f"within {confidence.RIGHT_WITHIN:.0%}",
        "mean confidence",
        f"confidence >= {SURE:g}",
        "of these within",
    )
    table = Table("texture, % of white", *heads)
    for name, row in zip(_texture_names(), by_texture(pairs), strict=True):
        table.add_row(name, *(f"{value:.3f}" for value in row))
    console.print(f"{title}: confidence by image texture", highlight=False)
    console.print(table)


#: Probabilities of the intervals whose coverage is shown, and their half widths in standard deviations.
INTERVALS = {0.68: 1.0, 0.95: 1.96}


class OfSigma(NamedTuple):
    """Sigma and its coverage for the pixels of one class of texture; every pair has the same weight."""

    fraction: float  # of all pixels
    sigma: float  # their median standard deviation, relative to the depth
    within: tuple[float, ...]  # fraction whose error is inside each interval of ``INTERVALS``


def _weights(pairs: Sequence[Observed]) -> np.ndarray:
    return np.concatenate([np.full(len(pair.right), 1.0 / len(pair.right)) for pair in pairs])


def coverage_of_sigma(pairs: Sequence[Observed]) -> list[OfSigma]:
    """One row for each class of ``TEXTURES``, then one of all pixels; NaN in a class without pixels."""
    weights = _weights(pairs)
    texture, sigma, deviation = (
        np.concatenate([getattr(pair, name) for pair in pairs]) for name in ("texture", "sigma", "deviation")
    )
    classes = np.digitize(texture, TEXTURES)
    rows = []
    for own in (*(classes == k for k in range(len(TEXTURES) + 1)), np.ones(len(texture), bool)):
        if not own.any():
            rows.append(OfSigma(0.0, float("nan"), (float("nan"),) * len(INTERVALS)))
            continue
        w = weights[own]
        inside = tuple(float(np.average(deviation[own] <= k, weights=w)) for k in INTERVALS.values())
        rows.append(OfSigma(float(w.sum() / weights.sum()), float(np.median(sigma[own])), inside))
    return rows


def _texture_names() -> list[str]:
    bounds = [f"{100.0 * bound:g}" for bound in TEXTURES]
    return [f"below {bounds[0]}", *map(" to ".join, pairwise(bounds)), f"{bounds[-1]} and more"]


def _print_coverage(console: Console, observed: Mapping[str, Sequence[Observed]]) -> None:
    """The table of ``coverage_of_sigma`` of each data."""
    heads = (f"within {k:g} sigma ({level:.0%})" for level, k in INTERVALS.items())
    table = Table("data", "texture, % of white", "pixels", "median sigma, % of depth", *heads)
    for root, own in observed.items():
        for name, row in zip((*_texture_names(), "all"), coverage_of_sigma(own), strict=True):
            inside = (f"{value:.3f}" for value in row.within)
            table.add_row(root, name, f"{row.fraction:.3f}", f"{100 * row.sigma:.1f}", *inside)
    console.print("coverage of sigma, conditional on the calibration", highlight=False)
    console.print(table)


#: Fractions of the pixels, the most certain ones, whose errors are shown.
KEPT = (1.0, 0.9, 0.75, 0.5, 0.25)


class Sorted(NamedTuple):
    """Errors of the most certain pixels of some pairs; every pair weighs the same."""

    risk: tuple[float, ...]  # AbsRel of the fraction ``KEPT``
    ause: float  # area between the risk-coverage curve and the curve of the best order


def risk_by_coverage(pairs: Sequence[Observed]) -> dict[str, Sorted]:
    """Compare how confidence, sigma, a random and the best order sort the pixels by their error."""
    curves: dict[str, list[RiskCoverage]] = {}
    for pair in pairs:
        assert pair.error is not None and pair.stated is not None  # of depth
        true = np.ones(len(pair.error))
        orders = {"confidence": -pair.stated, "sigma": pair.sigma, "random": None, "error": pair.error}
        for name, order in orders.items():
            curve = risk_coverage(1.0 + pair.error, true, true > 0, order)
            curves.setdefault(name, []).append(curve)
    rows = {}
    for name, own in curves.items():
        risk, oracle = (np.mean([getattr(curve, of) for curve in own], 0) for of in ("risk", "oracle"))
        at = [len(risk) - round(len(risk) * kept) for kept in KEPT]
        rows[name] = Sorted(tuple(map(float, risk[at])), float(np.mean(risk - oracle)))
    return rows


def _print_risks(console: Console, observed: Mapping[str, Sequence[Observed]]) -> None:
    """The table of ``risk_by_coverage`` of each data."""
    table = Table("data", "pixels ordered by", *(f"best {kept:.0%}" for kept in KEPT), "AUSE")
    for root, own in observed.items():
        for name, row in risk_by_coverage(own).items():
            table.add_row(root, name, *(f"{value:.4f}" for value in (*row.risk, row.ause)))
    console.print("risk and coverage: AbsRel of the most certain pixels", highlight=False)
    console.print(table)


class OnWalls(NamedTuple):
    """Confidence on plain walls, for pixels that are off by more than ``OFF`` and for the others.

    Every pair weighs the same.
    """

    off: float  # share that is off
    within: float  # of these, share within ``confidence.RIGHT_WITHIN``
    of_off: float  # their mean confidence
    of_right: float  # that of the others
    spread_off: float  # median standard deviation of those that are off, as a fraction of the depth
    spread_right: float  # that of the others
    auroc: float  # probability that of one of each, the one that is right has the higher confidence


def of_walls(walls: Sequence[Wall]) -> OnWalls:
    """One row of the table of walls; NaN where none, or all, of their pixels are off."""
    error, stated, sigma = (np.concatenate([getattr(wall, name) for wall in walls]) for name in Wall._fields)
    weights = np.concatenate([np.full(len(wall.error), 1.0 / max(len(wall.error), 1)) for wall in walls])
    off = error > OFF
    if off.all() or not off.any():
        return OnWalls(float(off.mean()), *[float("nan")] * 6)
    within = np.average(error[off] < confidence.RIGHT_WITHIN, weights=weights[off])
    said = [float(np.average(stated[own], weights=weights[own])) for own in (off, ~off)]
    spread = [float(np.nanmedian(sigma[own])) for own in (off, ~off)]
    right = rankdata(stated)[~off]
    pairs = len(right) * off.sum()
    apart = (right.sum() - len(right) * (len(right) + 1) / 2.0) / pairs
    return OnWalls(float(np.average(off, weights=weights)), float(within), *said, *spread, float(apart))


def _print_walls(console: Console, walls: Mapping[str, Sequence[Wall]]) -> None:
    """The table of ``of_walls``: a row for each data."""
    table = Table("data", "off", "of these within", "confidence: off", "right", "+-: off", "right", "AUROC")
    for root, own in walls.items():
        if sum(len(wall.error) for wall in own):
            table.add_row(root, *(f"{value:.3f}" for value in of_walls(own)))
    console.print(
        f"plain walls: fraction of pixels off by more than {OFF:.0%}, fraction of these within "
        f"{confidence.RIGHT_WITHIN:.0%}, and confidence and error bars of these and of the other pixels",
        highlight=False,
    )
    console.print(table)


def wall_of(pair: Observed) -> Wall:
    """The walls of a pair with truth."""
    maps = [getattr(pair, name) for name in Wall._fields]
    assert pair.wall is not None and all(each is not None for each in maps)  # of depth
    return Wall(*(each[pair.wall > 0] for each in maps))


def _print_all_textures(console: Console, observed: Mapping[str, Sequence[Observed]]) -> None:
    """The table of each data and of all."""
    for root, own in observed.items():
        _print_textures(console, root, own)
    if len(observed) > 1:
        _print_textures(console, "all", [pair for own in observed.values() for pair in own])


def _print(
    console: Console,
    kind: str,
    where: str,
    name: str,
    observed: Mapping[str, Sequence[Observed]],
    signs: Sequence[int],
    shipped: Sequence[float],
) -> None:
    """Constants to paste, those of the halves, and the deciles of all data and of each of several."""
    pairs = [pair for own in observed.values() for pair in own]
    coefficients, halves, judged = calibrate(pairs, signs)
    # A constant feature (the spread of a single member) is not informative: the shipped number stays.
    varies = np.ptp(np.concatenate([pair.evidence for pair in pairs]), axis=0) > 0
    coefficients = np.where(varies | (np.arange(len(shipped)) == 0), coefficients, shipped)
    _print_deciles(console, f"{kind}, on the half not fitted on", pairs, judged)
    first = 0
    for root, own in observed.items() if len(observed) > 1 else ():
        console.print()
        _print_deciles(console, f"of these, {root}", own, judged[first : first + len(own)])
        first += len(own)
    for half, fitted in zip(("even", "odd"), halves, strict=True):
        console.print(f"# the {half} half alone: {_constants(name, fitted)}", highlight=False)
    console.print(f"# {where}\n{_constants(name, coefficients)}\n", highlight=False, soft_wrap=True)


@dataclass(frozen=True, kw_only=True)
class ConfidenceOptions:
    """What is fitted, on which pairs and priors."""

    data: tuple[str, ...] = setting(MISSING, "Folder with data sets, a capture, or synthetic:N; repeatable.")
    prior: tuple[str, ...] = setting(("bundled",), "Priors to guide; repeatable.")
    ensemble: int = setting(1, "Members; 2 and more also fit the effect of spread.")
    resolution: int | None = setting(None, "Longer side for the prior, pixels.")
    device: str = setting("cpu", "cpu, cuda, cuda:N or mps.")
    strengths: tuple[str, ...] = setting(
        (),
        "Emulated priors (tests.lab strength) in addition: 5%,20%.",
        choices=tuple(STRENGTHS),
        comma_separated=True,
    )
    what: str = setting("both", "depth, matches or both.", choices=("depth", "matches", "both"))


def main(options: ConfidenceOptions) -> None:
    """Print coefficients of confidence, fitted on pairs with ground truth, and evaluate each half."""
    check_settings(options)
    console, priors = Console(width=120), PriorCache()
    settings = [
        Settings(
            prior=one,
            ensemble=options.ensemble,
            resolution=options.resolution,
            device=options.device,
        )
        for one in options.prior
    ]
    if options.what in ("matches", "both"):
        observed = _observed_pairs(
            options.data, lambda sample: [observe_matches(sample, settings[0], priors)]
        )
        _check_count(observed)
        where = "matching/constants.py", "LOG_ODDS"
        _print(console, "matches", *where, observed, MATCH_SIGNS, LOG_ODDS)
    if options.what in ("depth", "both"):
        _depth(console, options.data, settings, options.strengths, priors)


def _observed_pairs(
    data: Sequence[str], observe: Callable[[StereoSample], list[Observed]]
) -> dict[str, list[Observed]]:
    """Pairs with ground truth by their data; what one shows under several priors stays in one half."""
    observed: dict[str, list[Observed]] = {}
    for root, ref in tqdm([(one, ref) for one in data for ref in find_pairs(one)]):
        pair = _joined(observe(load(ref)))
        if len(pair.right):
            observed.setdefault(root, []).append(pair)
    return observed


def _check_count(observed: Mapping[str, Sequence[Observed]]) -> None:
    """Each half is judged by the other: there must be two."""
    count = sum(map(len, observed.values()))
    if count < 2:
        bad_value("data", "folders with at least two pairs with truth", f"{count} in {', '.join(observed)}")


def _depth(
    console: Console,
    data: Sequence[str],
    settings: Sequence[Settings],
    emulated: Sequence[str],
    priors: PriorCache,
) -> None:
    """Fit the constants of confidence, and measure it by texture and on walls."""
    marked = [root for root in data if (Path(root) / PLANES).is_file()]
    captures = [root for root in data if (Path(root) / "transforms.json").is_file()]
    with_truth = [root for root in data if root not in (*marked, *captures)]
    observed = _observed_pairs(
        with_truth,
        lambda sample: [
            *(observe_depth(sample, one, priors) for one in settings),
            *(observe_emulated(sample, emulated) if emulated else ()),
        ],
    )
    observed |= {root: list(observe_capture(Path(root), settings[0], priors)) for root in captures}
    _check_count(observed)
    where = "result/constants.py", "DEPTH_LOG_ODDS"
    _print(console, "depth", *where, observed, SIGNS, DEPTH_LOG_ODDS)
    _print_all_textures(console, observed)
    _print_coverage(console, observed)
    _print_risks(console, observed)
    walls = {root: list(map(wall_of, own)) for root, own in observed.items()}
    walls |= {root: list(observe_planes(Path(root), settings[0], priors)) for root in marked}
    _print_walls(console, walls)


if __name__ == "__main__":
    about = "Fit what the confidence promises, on pairs with truth."
    new_command("confidence", Command(ConfidenceOptions, main, about)).main()
