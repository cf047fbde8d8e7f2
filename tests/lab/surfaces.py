"""How flat planes are after every stage of a guided call, and how smooth rendered surfaces: tables, figures.

    python -m tests.lab surfaces --data DIR --data synthetic-plain:8@640x480 --out FOLDER

Data flow: real pairs with hand-marked planes, or pairs with dense truth -> stages -> tables and figures.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
import typer
from PIL import Image, ImageDraw
from rich.console import Console
from rich.table import Table
from torch import Tensor

from geodiff_plugin import GeometryGuidance, Rig, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin._checks import check_choice
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.result import finish
from tests.lab.edges import surface_error

__all__ = ["STAGES", "Flatness", "Stages", "draw_stages", "flatness", "guided_stages", "main"]
__all__ += ["marked_planes", "of_polygon", "plane_of", "relief", "specks"]

#: What is measured, in the order of a call: key, heading.
STAGES = {
    "sure": "sure matches",
    "matches": "all matches",
    "loop": "after the loop",
    "fit": "after the last fit",
    "result": "result",
}
#: Confidence from which on a match is sure.
SURE = 0.5
#: Functions of ``result.finish`` that ``--without`` leaves out, by the word that it takes.
PARTS = {"votes": "vote_depth", "flattening": "flatten"}
#: Fewer pixels make no plane.
FEWEST_PIXELS = 50
#: Name of the file with hand-marked planes, beside the calibration of its pairs.
PLANES, CALIBRATION = "planes.json", "stereodemo_calibration.json"


@dataclass
class Stages:
    """The maps ``(H, W)``, metres, that a guided call passes through, at the image's size.

    ``matches`` are the winners of all pixels, also of those that the views do not agree on; ``sure`` is NaN
    where no match is sure.
    """

    sure: np.ndarray | None = None
    matches: np.ndarray | None = None
    loop: np.ndarray | None = None
    fit: np.ndarray | None = None
    result: np.ndarray | None = None
    confidence: np.ndarray | None = None
    verdict: str = ""
    trusted: bool = False
    pose: str = ""

    def of(self, stage: str) -> np.ndarray:
        """The map of a key of ``STAGES``; all NaN where the call had no such stage."""
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
    """Record the stages of the guided call, of one image and one member, that is made within."""
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
    """How far a map is from a plane, % of the plane's mean inverse depth: root mean square, and MAD.

    The MAD is the median absolute deviation times 1.4826, the standard deviation of a normal distribution.
    """

    rms: float
    mad: float


def flatness(depth_m: np.ndarray, inside: np.ndarray) -> Flatness:
    """Residual of the inverse depth of ``depth_m (H, W)`` from its best plane ``inside (H, W)`` bool.

    A plane in space is a plane in inverse depth over the pixels. Pixels without a depth do not count.
    """
    known = inside & np.isfinite(depth_m)
    if known.sum() < FEWEST_PIXELS:
        return Flatness(np.nan, np.nan)
    inverse = 1.0 / depth_m[known].astype(np.float64)
    residual = inverse - plane_of(depth_m, known)
    spread = 1.4826 * np.median(np.abs(residual - np.median(residual)))
    percent = 100.0 / inverse.mean()
    return Flatness(float(percent * np.sqrt(np.mean(residual**2))), float(percent * spread))


def specks(depth_m: np.ndarray, inside: np.ndarray) -> float:
    """Detail of a pixel or a few, per mille of the inverse depth ``inside (H, W)`` bool of a map ``(H, W)``.

    The 99th percentile of the distance from the median of 5x5 pixels.
    """
    inverse = (1.0 / depth_m).astype(np.float32)
    away = np.abs(inverse / cv2.medianBlur(inverse, 5) - 1.0)
    return float(1e3 * np.quantile(away[inside], 0.99))


def plane_of(depth_m: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """``(N,)`` 1/m, the best plane of the inverse depth of ``depth_m (H, W)`` at the pixels ``inside``."""
    row, column = np.nonzero(inside)
    terms = np.stack([np.ones(len(row)), row - row.mean(), column - column.mean()], 1)
    inverse = 1.0 / depth_m[inside].astype(np.float64)
    return terms @ np.linalg.lstsq(terms, inverse, rcond=None)[0]


def of_polygon(polygon: Sequence[Sequence[float]], size: tuple[int, int]) -> np.ndarray:
    """``(H, W)`` bool of a polygon of (x, y)."""
    image = Image.new("1", size[::-1])
    ImageDraw.Draw(image).polygon([tuple(corner) for corner in polygon], fill=1)
    return np.array(image)


def guided_stages(pipe: Any, images: tuple[np.ndarray, np.ndarray], rig: Rig, seed: int = 0) -> Stages:
    """The stages of a guided call on a left and a right image ``(H, W, 3)`` uint8."""
    left, right = images
    guidance = GeometryGuidance(right, (rig.K_left, rig.K_right), rig.E)
    with _observed() as stages:
        out = pipe(Image.fromarray(left), guidance=guidance, generator=torch.Generator().manual_seed(seed))
    stages.result, stages.confidence = out.prediction[0, ..., 0], out.confidence[0, ..., 0]
    stages.verdict, stages.trusted = out.verdicts[0].sentence, out.verdicts[0].trusted
    stages.pose = out.poses[0].status if out.poses else ""
    return stages


def _planes_table(rows: Mapping[str, tuple[Stages, np.ndarray]]) -> Table:
    """A row for each plane: RMS / MAD by stage; of the result specks, sure matches and stated confidence."""
    heads = (*STAGES.values(), "specks", "sure", "confidence")
    table = Table("plane", *heads, title="RMS / MAD from the best plane, %; specks, per mille")
    values, of_result = [], []
    for name, (stages, inside) in rows.items():
        flat = [flatness(stages.of(stage), inside) for stage in STAGES]
        share = np.isfinite(stages.of("sure"))[inside].mean()
        stated = float(stages.of("confidence")[inside].mean())
        of_result.append((specks(stages.of("result"), inside), share, stated))
        table.add_row(
            name, *(f"{f.rms:.1f} / {f.mad:.1f}" for f in flat), *(f"{v:.2f}" for v in of_result[-1])
        )
        values.append([(f.rms, f.mad) for f in flat])
    mean, most = np.nanmean(values, axis=0), np.nanmax(values, axis=0)
    table.add_row(
        "mean", *(f"{a:.2f} / {b:.2f}" for a, b in mean), *(f"{v:.2f}" for v in np.mean(of_result, 0))
    )
    table.add_row("most", *(f"{a:.1f} / {b:.1f}" for a, b in most), f"{max(of_result)[0]:.2f}", "", "")
    return table


def _surfaces_table(rows: Mapping[str, tuple[Stages, Any]]) -> Table:
    """A row for each pair with truth: surface error by stage, AbsRel of the result, what it is said to be."""
    shown = ("loop", "fit", "result")
    heads = (*(STAGES[stage] for stage in shown), "AbsRel", "within 10 %", "confidence")
    table = Table("pair", *heads, title="error of the slope of log depth, per mille a pixel")
    values = []
    for name, (stages, sample) in rows.items():
        truth = sample.depth_m, sample.valid
        result = stages.of("result")
        errors = [surface_error(stages.of(stage), *truth) for stage in shown]
        right = np.abs(result / np.where(sample.valid, sample.depth_m, 1.0) - 1.0) < 0.1
        stated = stages.of("confidence")[sample.valid].mean()
        values.append(
            [*errors, evaluate_depth(result, *truth)["abs_rel"], right[sample.valid].mean(), stated]
        )
        table.add_row(name, *(f"{v:.2f}" for v in values[-1][:3]), *(f"{v:.3f}" for v in values[-1][3:]))
    mean = np.mean(values, axis=0)
    table.add_row("mean", *(f"{v:.2f}" for v in mean[:3]), *(f"{v:.3f}" for v in mean[3:]))
    return table


def draw_stages(left: np.ndarray, stages: Stages, path: Path) -> None:
    """The left image and the inverse depth of every stage side by side, on one scale of colours."""
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


#: Relative change of inverse depth over a pixel that the relief shows black or white.
RELIEF = 0.02


def relief(depth_m: np.ndarray) -> np.ndarray:
    """``(H, W)`` in [0, 1]: the slope of log depth towards the lower right; a plane has an even grey."""
    down, across = np.gradient(np.log(depth_m))
    return np.clip(0.5 + (down + across) / (2.0 * RELIEF), 0.0, 1.0)


def marked_planes(root: Path) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray], Rig, dict[str, Any]]]:
    """Name, images, cameras and planes of every pair of a folder with ``PLANES``."""
    rig = read_calibration(root / CALIBRATION)
    for name, planes in json.loads((root / PLANES).read_text()).items():
        if isinstance(planes, dict):
            sides = (Image.open(root / f"{name}_{side}.png").convert("RGB") for side in ("left", "right"))
            yield name, tuple(map(np.asarray, sides)), rig, planes


def _unchanged(depth_m: Tensor, *_: Any) -> Tensor:
    """In place of a part that is left out."""
    return depth_m


def main(
    data: Annotated[list[str], typer.Option(help="Folder with planes.json, data sets or synthetic-plain:N.")],
    prior: Annotated[str, typer.Option(help="The prior that is guided.")] = "bundled",
    seed: Annotated[int, typer.Option(help="Of the call.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for a figure of each pair.")] = None,
    without: Annotated[str, typer.Option(help="A part to leave out: votes or flattening.")] = "",
) -> None:
    """Print how flat planes and how smooth rendered surfaces are by stage, and draw the stages."""
    if without:
        check_choice(without, "without", PARTS)
    with patch.object(finish, PARTS[without], _unchanged) if without else nullcontext():
        _run(data, prior, seed, out)


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
            rig = Rig(sample.K_left, sample.K_right, sample.E)
            stages = guided_stages(pipe, (sample.left, sample.right), rig, seed)
            _describe(console, ref.name, sample.left, stages, out)
            surfaces[ref.label] = stages, sample
    for rows, table in ((planes, _planes_table), (surfaces, _surfaces_table)):
        if rows:
            console.print(table(rows))


def _describe(console: Console, name: str, left: np.ndarray, stages: Stages, out: Path | None) -> None:
    said = "trusted" if stages.trusted else stages.verdict
    console.print(f"{name}: {said}; pose {stages.pose}", highlight=False, soft_wrap=True)
    if out is not None:
        draw_stages(left, stages, out / f"{name}.png")
