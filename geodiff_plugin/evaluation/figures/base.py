"""Options of a figure, and the depth maps that several figures draw.

Data flow: options -> samples and predictions of methods.
Paper: none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.alignment import align
from geodiff_plugin.evaluation.baselines import NotApplicable, PriorCache, find_method
from geodiff_plugin.evaluation.baselines.base import Settings
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load
from geodiff_plugin.evaluation.datasets.perturbed import perturbed_ref
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import PairsOptions, all_refs, select

__all__ = ["Drawing", "FigureKind", "FigureOptions", "MethodDepth", "depths_of", "references", "samples"]


@dataclass(frozen=True)
class FigureOptions:
    """Options of ``geodiff eval figure``.

    Attributes:
        run: samples, methods and settings, as of ``geodiff eval pairs``; no methods for the figure's own.
        largest: the last g_s of ``gs-sweep``, metres.
        updates: updates per denoising step of ``inner-steps``.
        clouds: whether ``qualitative`` and ``ablation`` show point clouds as well.
    """

    run: PairsOptions
    largest: float
    updates: tuple[int, ...]
    clouds: bool


@dataclass(frozen=True)
class Drawing:
    """A finished figure.

    Attributes:
        figure: of matplotlib.
        numbers: what it shows, JSON values.
    """

    figure: Any
    numbers: dict[str, Any]


@dataclass(frozen=True)
class FigureKind:
    """One entry of ``FIGURES``: its help in one sentence and how it is drawn."""

    summary: str
    draw: Callable[[FigureOptions], Drawing]


@dataclass(frozen=True, eq=False)
class MethodDepth:
    """A method's answer for one sample, ready to be drawn.

    Attributes:
        title: of its column.
        depth_m: ``(H, W)`` metres, ``None`` where the method cannot work on the sample.
        abs_rel: over all pixels with truth; ``None`` without a map, or where it is empty.
    """

    title: str
    depth_m: np.ndarray | None
    abs_rel: float | None


def references(options: FigureOptions) -> list[SampleRef]:
    """The samples that a figure shows, their poses perturbed where the options say so.

    Raises:
        ValueError: none, or bad options.
    """
    run = options.run
    refs = select(all_refs(run), run)
    return refs if run.perturb is None else [perturbed_ref(ref, run.perturb) for ref in refs]


def samples(options: FigureOptions) -> list[StereoSample]:
    """The same, read.

    Raises:
        ValueError: none, a broken one, or one without truth.
        OSError: missing files.
    """
    read = [load(ref) for ref in references(options)]
    for sample in read:
        if not sample.valid.any():
            bad_value(f"the truth of {sample.label}", "known for at least one pixel", "none")
    return read


def depths_of(sample: StereoSample, name: str, settings: Settings, priors: PriorCache) -> MethodDepth:
    """Run one method; relative depth gets scale and shift from the truth, and its title says so."""
    method = find_method(name)
    try:
        prediction = method.run(sample, method.own_settings(settings), priors)
    except NotApplicable as reason:
        return MethodDepth(f"{method.title}:\n{reason}", None, None)
    depth_m = prediction.depth_m
    if depth_m is None:
        depth_m = align(prediction.relative, sample.depth_m, sample.valid, prediction.space)
    abs_rel = evaluate_depth(depth_m, sample.depth_m, sample.valid)["abs_rel"]
    return MethodDepth(method.title, depth_m, None if math.isnan(abs_rel) else abs_rel)
