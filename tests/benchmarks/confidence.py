"""Refits what the confidence promises, on pairs with truth: coefficients to paste, and how they do elsewhere.

Beside it: what is said of pixels by the texture around them, and of walls where their depth is off.

python -m tests.benchmarks.confidence --data DIR --strengths exact,5%,20%
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import torch.nn.functional as F
import typer
from PIL import Image
from rich.console import Console
from rich.table import Table
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata
from torch import Tensor
from tqdm import tqdm

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, posed_views
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.experiment import DENSE
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.matching import consistency
from geodiff_plugin.result import confidence, finish
from geodiff_plugin.result.readings import read_pixel
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
    "texture_of",
]

#: Which sign each coefficient of ``consistency.LOG_ODDS``, and of ``BY_EVIDENCE``, may have; 0 for any.
MATCH_SIGNS, SIGNS = (0, 1, -1, -1), (0, 1, 1, 1, 1, -1)


def promised(evidence: np.ndarray, coefficients: Sequence[float] | np.ndarray) -> np.ndarray:
    """Probability ``(N,)`` of evidence ``(N, F)`` under coefficients ``(F,)``."""
    return expit(evidence @ np.asarray(coefficients, np.float64))


def fit_log_odds(
    evidence: np.ndarray, right: np.ndarray, weights: np.ndarray, signs: Sequence[int]
) -> np.ndarray:
    """Coefficients of greatest weighted likelihood, each within its sign.

    Args:
        evidence: ``(N, F)`` float; a column that never varies beside the constant gets 0.
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
    """One tenth of the promises: their mean ``promised``, the part ``kept``, their ``share`` of all."""

    promised: float
    kept: float
    share: float


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
TEXTURE_REACH = consistency.CONTRAST_REACH
#: Upper bounds of the classes of texture but the last: mean horizontal step of brightness, share of white.
TEXTURES = (0.005, 0.01, 0.02, 0.04)
#: Confidence from which on a pixel is said to be right.
SURE = 0.9
#: Relative error above which the depth of a wall is off.
OFF = 0.05
#: Texture below which a wall is plain.
PLAIN = TEXTURES[2]
#: Distance of the inverse depth of a wall from the best plane of a window, root mean square over its mean.
FLAT = 0.005
#: Known share of such a window from which on there is a plane.
LEAST_KNOWN = 0.3
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


class Wall(NamedTuple):
    """Pixels of the plain walls of one pair."""

    error: np.ndarray  # (N,) relative error of the depth, >= 0
    stated: np.ndarray  # (N,) the confidence of the output


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

    Infinite where the truth is unknown in most of the window, of half width ``TEXTURE_REACH``.
    """
    row, column = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]] / max(depth_m.shape)
    inverse = np.where(valid, 1.0 / np.where(valid, depth_m, 1.0), 0.0)

    def mean(values: np.ndarray) -> np.ndarray:
        return uniform_filter(values * valid, 2 * TEXTURE_REACH + 1, mode="constant")

    known = mean(np.ones(depth_m.shape))
    share = np.maximum(known, 1e-9)
    y, x, q = (mean(values) / share for values in (row, column, inverse))
    yy, xx, yx = (
        mean(row * row) / share - y * y,
        mean(column**2) / share - x * x,
        mean(row * column) / share - y * x,
    )
    yq, xq, qq = (
        mean(one * inverse) / share - other * q for one, other in ((row, y), (column, x), (inverse, q))
    )
    determinant = np.maximum(yy * xx - yx**2, 1e-14)
    down, across = (xx * yq - yx * xq) / determinant, (yy * xq - yx * yq) / determinant
    rest = np.sqrt(np.maximum(qq - down * yq - across * xq, 0.0)) / np.maximum(q, 1e-9)
    return np.where(known >= LEAST_KNOWN, rest, np.inf)


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
    """What a guided call shows on an image ``(H, W, 3)`` uint8 whose truth is known where ``valid``."""
    with _recorded() as evidence:
        out = call()
    found_m, stated = (np.asarray(values).squeeze() for values in (out.prediction, out.confidence))
    error = np.abs(found_m / np.where(valid, depth_m, 1.0) - 1.0)
    texture = texture_of(left)
    wall = (texture < PLAIN) & (off_plane(depth_m, valid) < FLAT)
    layers = np.concatenate([np.stack([stated, texture, error, wall]), evidence[0][0].cpu().numpy()])
    (stated, texture, error, wall), drawn = np.split(_drawn(layers, valid, seed), [4])
    return Observed(drawn.T, error < confidence.RIGHT_WITHIN, stated, texture, error, wall)


def observe_depth(sample: StereoSample, settings: Settings, priors: PriorCache) -> Observed:
    """Evidence of ``result.confidence`` of a guided call, and where its depth is within 10 %.

    Args:
        sample: with truth.
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
    """Marked planes of pairs without truth; the error is the distance from the best plane of the result."""
    for _, images, rig, planes in marked_planes(root):
        stages = guided_stages(priors.get(settings), images, rig, settings.seed)
        depth_m, stated = stages.of("result"), stages.of("confidence")
        inside = [of_polygon(polygon, depth_m.shape) for polygon in planes.values()]
        error = [np.abs(plane_of(depth_m, each) * depth_m[each] - 1.0) for each in inside]
        yield Wall(np.concatenate(error), np.concatenate([stated[each] for each in inside]))


def observe_emulated(sample: StereoSample, strengths: Sequence[str]) -> list[Observed]:
    """As ``observe_depth``, under emulated priors of several strengths; empty for truth that is sparse.

    Args:
        sample: with truth.
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
    """Evidence of ``matching.consistency`` of checked matches, and which are within 3 planes of the truth.

    Args:
        sample: with truth.
        settings: its device sweeps.
        priors: not used.
    """
    volume = sweep(sample, settings.device)
    with torch.no_grad():
        inverse_depth, contrast, _, views = consistency.candidates(volume, volume.aligned[:1])
        (view,) = views
    agreed, textured = view.difference <= consistency.AGREEMENT_PLANES, contrast >= consistency.LEAST_CONTRAST
    truth = torch.from_numpy(np.where(sample.valid, sample.depth_m, 0.0)).float()[None, None]
    truth_m = F.interpolate(truth, volume.size, mode="nearest-exact")[0, 0].numpy()
    known = (agreed & textured).cpu().numpy() & (truth_m > 0)
    error = np.abs(inverse_depth.cpu().numpy() - 1.0 / np.where(truth_m > 0, truth_m, 1.0))
    right = error <= 3.0 * float(volume.plane_step)
    layers = np.concatenate([right[None], view.features.cpu().numpy()])
    drawn = _drawn(layers, known, settings.seed)
    return Observed(drawn[1:].T, drawn[0] > 0)


def _stack(pairs: Sequence[Observed]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evidence, outcome and weight of all pixels; every pair weighs the same."""
    weights = [np.full(len(pair.right), 1.0 / len(pair.right)) for pair in pairs]
    evidence, right = ([getattr(pair, name) for pair in pairs] for name in ("evidence", "right"))
    return np.concatenate(evidence), np.concatenate(right), np.concatenate(weights)


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
    table = Table("promised", "kept", "share")
    worst = 0.0
    for decile in deciles(np.concatenate(judged), right, weights):
        table.add_row(*(f"{value:.3f}" for value in (decile.promised, decile.kept, decile.share)))
        worst = max(worst, abs(decile.promised - decile.kept))
    console.print(title, highlight=False, soft_wrap=True)
    console.print(table)
    console.print(f"largest gap between promised and kept: {worst:.3f}", highlight=False)


class OfTexture(NamedTuple):
    """What is said of the pixels of one class of texture, and what is so; every pair weighs the same."""

    share: float  # of all pixels
    within: float  # of these, share within ``confidence.RIGHT_WITHIN``
    stated: float  # their mean confidence
    sure: float  # share of these that is said to be right with ``SURE`` or more
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
        f"said >= {SURE:g}",
        "of these within",
    )
    table = Table("texture, % of white", *heads)
    bounds = [f"{100.0 * bound:g}" for bound in TEXTURES]
    names = [f"below {bounds[0]}", *map(" to ".join, pairwise(bounds)), f"{bounds[-1]} and more"]
    for name, row in zip(names, by_texture(pairs), strict=True):
        table.add_row(name, *(f"{value:.3f}" for value in row))
    console.print(f"{title}: what is said of pixels by the texture around them", highlight=False)
    console.print(table)


class OnWalls(NamedTuple):
    """What is said of plain walls, of the pixels that are off by more than ``OFF`` and of those that are not.

    Every pair weighs the same.
    """

    off: float  # share that is off
    within: float  # of these, share within ``confidence.RIGHT_WITHIN``
    of_off: float  # their mean confidence
    of_right: float  # that of the others
    spread_off: float  # median standard error by confidence of those that are off, as a share of the depth
    spread_right: float  # that of the others
    told_apart: float  # probability that of one of each, the one that is right has the higher confidence


def of_walls(walls: Sequence[Wall]) -> OnWalls:
    """One row of the table of walls; NaN where none, or all, of their pixels are off."""
    error, stated = (np.concatenate([getattr(wall, name) for wall in walls]) for name in Wall._fields)
    weights = np.concatenate([np.full(len(wall.error), 1.0 / max(len(wall.error), 1)) for wall in walls])
    off = error > OFF
    if off.all() or not off.any():
        return OnWalls(float(off.mean()), *[float("nan")] * 6)
    within = np.average(error[off] < confidence.RIGHT_WITHIN, weights=weights[off])
    said = [float(np.average(stated[own], weights=weights[own])) for own in (off, ~off)]
    spread = [standard_error(float(np.median(stated[own]))) for own in (off, ~off)]
    right = rankdata(stated)[~off]
    pairs = len(right) * off.sum()
    apart = (right.sum() - len(right) * (len(right) + 1) / 2.0) / pairs
    return OnWalls(float(np.average(off, weights=weights)), float(within), *said, *spread, float(apart))


def standard_error(stated: float) -> float:
    """What a reading says of a depth of this confidence: its standard deviation as a share of it."""
    spread = read_pixel(np.ones((1, 1)), np.eye(3), (0, 0), np.full((1, 1), stated)).spread
    assert spread is not None  # confidence tells
    return spread


def _print_walls(console: Console, walls: Mapping[str, Sequence[Wall]]) -> None:
    """The table of ``of_walls``: a row for each data."""
    table = Table(
        "data", "off", "of these within", "confidence: off", "right", "+-: off", "right", "told apart"
    )
    for root, own in walls.items():
        if sum(len(wall.error) for wall in own):
            table.add_row(root, *(f"{value:.3f}" for value in of_walls(own)))
    console.print(
        f"plain walls: pixels off by more than {OFF:.0%}, how many of these are within "
        f"{confidence.RIGHT_WITHIN:.0%}, and what is said of them and of the others",
        highlight=False,
    )
    console.print(table)


def wall_of(pair: Observed) -> Wall:
    """The walls of a pair with truth."""
    assert pair.wall is not None and pair.error is not None and pair.stated is not None  # of depth
    on_wall = pair.wall > 0
    return Wall(pair.error[on_wall], pair.stated[on_wall])


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
    # What was the same everywhere (the spread, of a single member) tells nothing: the shipped number stays.
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


def main(
    data: Annotated[
        list[str], typer.Option(help="Folder with data sets, a capture, or synthetic:N; repeat it.")
    ],
    prior: Annotated[list[str] | None, typer.Option(help="Priors to guide; repeat it for several.")] = None,
    ensemble: Annotated[int, typer.Option(help="Members; 2 and more also fit the effect of spread.")] = 1,
    resolution: Annotated[int | None, typer.Option(help="Longer side for the prior, pixels.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:N or mps.")] = "cpu",
    strengths: Annotated[
        str, typer.Option(help="Emulated priors (tests.lab strength) besides: 5%,20%.")
    ] = "",
    what: Annotated[str, typer.Option(help="depth, matches or both.")] = "both",
) -> None:
    """Print coefficients of confidence, fitted on pairs with truth, and how they do on the other half."""
    check_choice(what, "what", ("depth", "matches", "both"))
    emulated = [name.strip() for name in strengths.split(",") if name.strip()]
    for name in emulated:
        check_choice(name, "strengths", STRENGTHS)
    console, priors = Console(width=120), PriorCache()
    settings = [
        Settings(prior=one, ensemble=ensemble, resolution=resolution, device=device)
        for one in prior or ["bundled"]
    ]
    if what in ("matches", "both"):
        observed = _observed_pairs(data, lambda sample: [observe_matches(sample, settings[0], priors)])
        _check_count(observed)
        where = "matching/consistency.py", "LOG_ODDS"
        _print(console, "matches", *where, observed, MATCH_SIGNS, consistency.LOG_ODDS)
    if what in ("depth", "both"):
        _depth(console, data, settings, emulated, priors)


def _observed_pairs(
    data: Sequence[str], observe: Callable[[StereoSample], list[Observed]]
) -> dict[str, list[Observed]]:
    """Pairs with truth by their data; what one shows under several priors stays in one half."""
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
    """Constants of the confidence of depth, and what it says by texture and of walls."""
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
    where = "result/confidence.py", "BY_EVIDENCE"
    _print(console, "depth", *where, observed, SIGNS, confidence.BY_EVIDENCE)
    _print_all_textures(console, observed)
    walls = {root: list(map(wall_of, own)) for root, own in observed.items()}
    walls |= {root: list(observe_planes(Path(root), settings[0], priors)) for root in marked}
    _print_walls(console, walls)


if __name__ == "__main__":
    typer.run(main)
