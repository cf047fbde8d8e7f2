"""``geodiff bench --points N``: completion from known points, guided against a LoRA fitted at test time.

Data flow: a Marigold V2, the demo pair's left image, N depths of its truth -> seconds and error of each way.
Paper: none; the peer is Marigold V2's own depth completion.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.bundled.demo_pair import DemoPair, read_demo_pair
from geodiff_plugin.cli.tiny_marigold_v2 import tiny_marigold_v2
from geodiff_plugin.evaluation.fitted_lora import FittedLora, complete_by_lora
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import load_prior
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance

__all__ = ["Completion", "compare_completions", "draw_points", "run_bench_points"]

#: Longer side at which the tiny prior works; a folder's own default otherwise.
TINY_RESOLUTION = 192


@dataclass(frozen=True)
class Completion:
    """One way to complete the points.

    Attributes:
        name: of the way.
        seconds: of its call.
        passes: through the transformer; each of a fitted LoRA's steps goes back through it as well.
        mae_m: metres, mean absolute error over the truth that was not given.
        abs_rel: mean relative error over the same pixels.
    """

    name: str
    seconds: float
    passes: int
    mae_m: float
    abs_rel: float


def draw_points(pair: DemoPair, count: int, seed: int = 0) -> np.ndarray:
    """``(H, W)`` metres with ``count`` pixels of the truth, 0 elsewhere."""
    rows, columns = np.nonzero(pair.valid)
    chosen = np.random.default_rng(seed).choice(len(rows), min(count, len(rows)), replace=False)
    points = np.zeros_like(pair.depth_m)
    points[rows[chosen], columns[chosen]] = pair.depth_m[rows[chosen], columns[chosen]]
    return points


def compare_completions(
    pipe: MarigoldV2Pipeline, pair: DemoPair, points: np.ndarray, resolution: int, options: FittedLora
) -> list[Completion]:
    """Run every way once, after a plain call that takes the first-call costs.

    Args:
        pipe: affine in log depth.
        pair: the image and its truth.
        points: ``(H, W)`` metres, 0 where unknown.
        resolution: longer side for the prior, pixels.
        options: of the fitted LoRA.
    """
    guided_pipe = enable_geometry_guidance(pipe)
    pipe.set_progress_bar_config(disable=True)
    scored = pair.valid & (points == 0)

    def fitted(steps: int) -> Callable[[], np.ndarray]:
        own = FittedLora(**vars(options) | {"steps": steps})
        sparse = torch.from_numpy(points)
        return lambda: complete_by_lora(pipe, pair.left, sparse, own, resolution).cpu().numpy()

    def guided(**knobs: Any) -> Callable[[], np.ndarray]:
        guidance = GeometryGuidance.from_points(points, pair.rig.K_left, **knobs)
        return lambda: guided_pipe(pair.left, guidance=guidance, processing_resolution=resolution).prediction[
            0, ..., 0
        ]

    passes: list[int] = []
    counter = pipe.transformer.register_forward_hook(lambda *_: passes.append(1))
    pipe(pair.left, processing_resolution=resolution)
    ways: dict[str, Callable[[], Any]] = {
        "scale and shift by least squares": fitted(0),
        f"LoRA fitted in {options.steps} steps": fitted(options.steps),
        "GeometryGuidance.from_points": guided(),
        "the same, min_steps=1": guided(min_steps=1),
    }
    found = []
    for name, way in ways.items():
        passes.clear()
        started = time.perf_counter()
        depth_m = way()  # on the CPU, so that the device has finished
        seconds = time.perf_counter() - started
        error = np.abs(depth_m - pair.depth_m)[scored]
        relative = float((error / pair.depth_m[scored]).mean())
        found.append(Completion(name, seconds, len(passes), float(error.mean()), relative))
    counter.remove()
    return found


def run_bench_points(count: int, prior: str | None, device_name: str) -> None:
    """Print the table.

    Args:
        count: points, drawn from the demo pair's truth.
        prior: folder of a Marigold V2 in log depth; ``None`` for a tiny one with random weights.
        device_name: as ``--device``.

    Raises:
        ValueError: no such device; another kind of prior.
    """
    check_number(count, "--points", 10, 1_000_000, integer=True)
    device, resolution = pick_device(device_name), TINY_RESOLUTION
    if prior is None:
        pipe, name = tiny_marigold_v2().to(device), "tiny Marigold V2 with random weights"
    else:
        half = torch.bfloat16 if device.type == "cuda" else torch.float32
        pipe, name = load_prior(prior, device=device, dtype=half), prior
        if not isinstance(pipe, MarigoldV2Pipeline):
            bad_value("--prior", "a Marigold V2 in log depth with --points", prior)
        resolution = pipe.default_processing_resolution
    pair, options = read_demo_pair(), FittedLora()
    print(f"{name}; {count} points of the demo pair's truth; longer side {resolution} px")
    print(f"{device}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print(f"{'':<34}{'seconds':>9}{'passes':>8}{'MAE m':>9}{'AbsRel':>9}", flush=True)
    for way in compare_completions(pipe, pair, draw_points(pair, count), resolution, options):
        print(
            f"{way.name:<34}{way.seconds:>9.2f}{way.passes:>8}{way.mae_m:>9.3f}{way.abs_rel:>9.3f}",
            flush=True,
        )
