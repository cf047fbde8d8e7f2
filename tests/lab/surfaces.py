"""Planarity of real surfaces and smoothness of rendered ones after every stage of a call: tables, figures.

    python -m tests.lab surfaces --data DIR --data synthetic-plain:8@640x480 --out FOLDER

Data flow: real pairs with hand-marked planes, or pairs with dense ground truth -> stages -> tables, figures.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw
from rich.console import Console
from rich.table import Table
from torch import Tensor

from geodiff_plugin import GeometryGuidance, Rig, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.result import finish
from tests.lab.edges import surface_error
from tests.lab.options import SurfacesOptions
from tests.views import made_rig

__all__ = ["STAGES", "Flatness", "Stages", "draw_stages", "flatness", "guided_stages", "run"]
__all__ += ["marked_planes", "of_polygon", "plane_of", "relief", "specks"]

#: Stages in the order of a call: key, heading.
STAGES = {
    "sure": "confident matches",
    "matches": "all matches",
    "loop": "after the loop",
    "fit": "after the final fit",
    "result": "result",
}
#: Minimum confidence of a confident match.
SURE = 0.5
#: Functions of ``result.finish`` that ``--without`` disables.
PARTS = {"median": "filter_depth", "planar": "flatten"}
#: Minimum number of pixels of a plane.
MIN_PIXELS = 50
#: File with hand-marked planes, and calibration of its pairs in the same folder.
PLANES, CALIBRATION = "planes.json", "stereodemo_calibration.json"


@dataclass
class Stages:
    """The maps ``(H, W)``, metres, after the stages of a guided call, at the image's size.

    ``matches`` has the best match of every pixel, including inconsistent ones; ``sure`` is NaN where no match
    is confident.
    """

    sure: np.ndarray | None = None
    matches: np.ndarray | None = None
    loop: np.ndarray | None = None
    fit: np.ndarray | None = None
    result: np.ndarray | None = None
    confidence: np.ndarray | None = None
    sigma: np.ndarray | None = None
    verdict: str = ""
    trusted: bool = False
    pose: str = ""

    def of(self, stage: str) -> np.ndarray:
        """Return the map of a key of ``STAGES``; all NaN if the call had no such stage."""
        found = getattr(self, stage)
        assert self.result is not None  # the call has ended
        return np.full_like(self.result, np.nan) if found is None else found

    def take_matches(self, matches: Any, size: tuple[int, int]) -> None:
        """Keep the matches of one image."""
        if matches is None:
            return
        inverse, confidence = (
            F.interpolate(part[None].float(), size, mode="nearest-exact")[0, 0].numpy()
            for part in (matches.inverse_depth, matches.confidence)
        )
        self.matches = np.where(inverse > 0, 1.0 / np.where(inverse > 0, inverse, 1.0), np.nan)
        self.sure = np.where(confidence > SURE, self.matches, np.nan)


@contextmanager
def _observed() -> Iterator[Stages]:
    """Record the stages of a guided call with one image and one member."""
    stages, refine, fit = Stages(), finish.refine, finish.fit_depth

    def refining(evidence: Evidence, members: Sequence[Member], depth_m: Tensor, *more: Any) -> Any:
        stages.loop = depth_m[0, 0].numpy().copy()
        stages.take_matches(evidence.matches, tuple(depth_m.shape[-2:]))
        return refine(evidence, members, depth_m, *more)

    def fitting(*arguments: Any) -> Any:
        fitted = fit(*arguments)
        stages.fit = fitted[0][0, 0].numpy().copy()
        return fitted

    with ExitStack() as patches:
        patches.enter_context(patch.object(finish, "refine", refining))
        patches.enter_context(patch.object(finish, "fit_depth", fitting))
        yield stages


@dataclass(frozen=True)
class Flatness:
    """Deviation of a map from a plane, % of the plane's mean inverse depth: root mean square, and MAD.

    The MAD is the median absolute deviation times 1.4826, the standard deviation of a normal distribution.
    """

    rms: float
    mad: float


def flatness(depth_m: np.ndarray, inside: np.ndarray) -> Flatness:
    """Compute the residual of the inverse depth of ``depth_m (H, W)`` from its best plane ``inside (H, W)``.

    A plane in space is a plane in inverse depth over the pixels. Pixels without depth are ignored.
    """
    known = inside & np.isfinite(depth_m)
    if known.sum() < MIN_PIXELS:
        return Flatness(np.nan, np.nan)
    inverse = 1.0 / depth_m[known].astype(np.float64)
    residual = inverse - plane_of(depth_m, known)
    spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
    percent = 100.0 / inverse.mean()
    return Flatness(float(percent * np.sqrt(np.mean(residual**2))), float(percent * spread))


def specks(depth_m: np.ndarray, inside: np.ndarray) -> float:
    """Compute the amplitude of specks, per mille of the inverse depth, at the pixels ``inside (H, W)`` bool.

    This is the 99th percentile of the distance from the median of 5x5 pixels.
    """
    inverse = (1.0 / depth_m).astype(np.float32)
    away = np.abs(inverse / cv2.medianBlur(inverse, 5) - 1.0)
    return float(1e3 * np.quantile(away[inside], 0.99))


def plane_of(depth_m: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Fit a plane ``(N,)`` 1/m to the inverse depth of ``depth_m (H, W)`` at the pixels ``inside``."""
    row, column = np.nonzero(inside)
    terms = np.stack([np.ones(len(row)), row - row.mean(), column - column.mean()], 1)
    inverse = 1.0 / depth_m[inside].astype(np.float64)
    return terms @ np.linalg.lstsq(terms, inverse, rcond=None)[0]


def of_polygon(polygon: Sequence[Sequence[float]], size: tuple[int, int]) -> np.ndarray:
    """Rasterize a polygon of (x, y) as ``(H, W)`` bool."""
    image = Image.new("1", size[::-1])
    ImageDraw.Draw(image).polygon([tuple(corner) for corner in polygon], fill=1)
    return np.array(image)


def guided_stages(pipe: Any, images: tuple[np.ndarray, np.ndarray], rig: Rig, seed: int = 0) -> Stages:
    """Record the stages of a guided call on a left and a right image ``(H, W, 3)`` uint8."""
    left, right = images
    guidance = GeometryGuidance(right, (rig.K_left, rig.K_right), rig.E)
    with _observed() as stages:
        out = pipe(Image.fromarray(left), guidance=guidance, generator=torch.Generator().manual_seed(seed))
    stages.result, stages.confidence, stages.sigma = (
        values[0, ..., 0] for values in (out.prediction, out.confidence, out.sigma)
    )
    stages.verdict, stages.trusted = str(out.verdicts[0].summary or ""), out.verdicts[0].trusted
    stages.pose = out.poses[0].status if out.poses else ""
    return stages


def _planes_table(rows: Mapping[str, tuple[Stages, np.ndarray]]) -> Table:
    """Make a row per plane: RMS / MAD by stage; specks, confident matches and confidence of the result."""
    heads = (*STAGES.values(), "specks", "confident", "confidence")
    table = Table("plane", *heads, title="RMS / MAD from the best plane, %; specks, per mille")
    values, of_result = [], []
    for name, (stages, inside) in rows.items():
        flat = [flatness(stages.of(stage), inside) for stage in STAGES]
        fraction = np.isfinite(stages.of("sure"))[inside].mean()
        stated = float(stages.of("confidence")[inside].mean())
        of_result.append((specks(stages.of("result"), inside), fraction, stated))
        table.add_row(
            name, *(f"{f.rms:.1f} / {f.mad:.1f}" for f in flat), *(f"{v:.2f}" for v in of_result[-1])
        )
        values.append([(f.rms, f.mad) for f in flat])
    mean, most = np.nanmean(values, axis=0), np.nanmax(values, axis=0)
    table.add_row(
        "mean", *(f"{a:.2f} / {b:.2f}" for a, b in mean), *(f"{v:.2f}" for v in np.mean(of_result, 0))
    )
    table.add_row("maximum", *(f"{a:.1f} / {b:.1f}" for a, b in most), f"{max(of_result)[0]:.2f}", "", "")
    return table


def _surfaces_table(rows: Mapping[str, tuple[Stages, Any]]) -> Table:
    """Make a row per pair with ground truth: surface error by stage; AbsRel and confidence of the result."""
    shown = ("loop", "fit", "result")
    heads = (*(STAGES[stage] for stage in shown), "AbsRel", "within 10 %", "confidence")
    table = Table("pair", *heads, title="error of the slope of log depth, per mille per pixel")
    values = []
    for name, (stages, sample) in rows.items():
        ground_truth = sample.depth_m, sample.valid
        result = stages.of("result")
        errors = [surface_error(stages.of(stage), *ground_truth) for stage in shown]
        right = np.abs(result / np.where(sample.valid, sample.depth_m, 1.0) - 1.0) < 0.1
        stated = stages.of("confidence")[sample.valid].mean()
        values.append(
            [*errors, evaluate_depth(result, *ground_truth)["abs_rel"], right[sample.valid].mean(), stated]
        )
        table.add_row(name, *(f"{v:.2f}" for v in values[-1][:3]), *(f"{v:.3f}" for v in values[-1][3:]))
    mean = np.mean(values, axis=0)
    table.add_row("mean", *(f"{v:.2f}" for v in mean[:3]), *(f"{v:.3f}" for v in mean[3:]))
    return table


def draw_stages(left: np.ndarray, stages: Stages, path: Path) -> None:
    """Draw the left image and the inverse depth of every stage side by side, on one colour scale."""
    figure, axes = plt.subplots(2, 4, figsize=(20, 8.5), layout="constrained")
    inverse = {stage: 1.0 / stages.of(stage) for stage in STAGES}
    low, high = np.quantile(inverse["result"], (0.01, 0.99))
    axes.flat[0].imshow(left)
    for axis, (stage, values) in zip(axes.flat[1:], inverse.items(), strict=False):
        axis.imshow(values, vmin=low, vmax=high, cmap="turbo", interpolation="nearest")
        axis.set_title(STAGES[stage])
    axes.flat[6].imshow(relief(stages.of("result")), cmap="grey", vmin=0, vmax=1, interpolation="nearest")
    axes.flat[6].set_title("result, lit from the side")
    axes.flat[7].imshow(stages.of("confidence"), vmin=0, vmax=1, cmap="viridis")
    axes.flat[7].set_title("confidence")
    for axis in axes.flat:
        axis.axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=60)
    plt.close(figure)


#: Relative change of inverse depth per pixel that the relief shows as black or white.
RELIEF = 0.02


def relief(depth_m: np.ndarray) -> np.ndarray:
    """Shade the slope of log depth towards the lower right, ``(H, W)`` in [0, 1]; planes are grey."""
    down, across = np.gradient(np.log(depth_m))
    return np.clip(0.5 + (down + across) / (2.0 * RELIEF), 0.0, 1.0)


def marked_planes(root: Path) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray], Rig, dict[str, Any]]]:
    """Yield name, images, cameras and planes of every pair in a folder with ``PLANES``."""
    rig = read_calibration(root / CALIBRATION)
    for name, planes in json.loads((root / PLANES).read_text()).items():
        if isinstance(planes, dict):
            sides = (Image.open(root / f"{name}_{side}.png").convert("RGB") for side in ("left", "right"))
            yield name, tuple(map(np.asarray, sides)), rig, planes


def _unchanged(depth_m: Tensor, *_: Any) -> Tensor:
    """Replace a disabled stage."""
    return depth_m


def run(_: str, options: SurfacesOptions) -> None:
    """Print planarity and surface errors by stage, and draw the stages."""
    without = options.without
    with patch.object(finish, PARTS[without], _unchanged) if without else nullcontext():
        _run(options.data, options.prior, options.seed, options.out)


def _run(data: Sequence[str], prior: str, seed: int, out: Path | None) -> None:
    pipe = enable_geometry_guidance(load_prior(prior))
    pipe.set_progress_bar_config(disable=True)
    console, planes, surfaces = Console(width=150), {}, {}
    for root in data:
        if (Path(root) / PLANES).is_file():
            for name, images, rig, marked in marked_planes(Path(root)):
                stages = guided_stages(pipe, images, rig, seed)
                _describe(console, name, images[0], stages, out)
                for label, polygon in marked.items():
                    planes[f"{name}, {label}"] = stages, of_polygon(polygon, images[0].shape[:2])
            continue
        for ref in find_pairs(root):
            sample = load(ref)
            rig = made_rig(sample.K_left, sample.K_right, sample.E)
            stages = guided_stages(pipe, (sample.left, sample.right), rig, seed)
            _describe(console, ref.name, sample.left, stages, out)
            surfaces[ref.label] = stages, sample
    for rows, table in ((planes, _planes_table), (surfaces, _surfaces_table)):
        if rows:
            console.print(table(rows))


def _describe(console: Console, name: str, left: np.ndarray, stages: Stages, out: Path | None) -> None:
    verdict = "trusted" if stages.trusted else stages.verdict
    console.print(f"{name}: {verdict}; pose {stages.pose}", highlight=False, soft_wrap=True)
    if out is not None:
        draw_stages(left, stages, out / f"{name}.png")
