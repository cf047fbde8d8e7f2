"""How time and memory of a guided call grow, and what a million pairs would cost: docs/explanation/cost.md.

Data flow: the demo pair at several sizes, planes, views, steps, members -> CPU seconds, bytes
    -> exponents -> page.
Paper: S5.4 (cost).

    python -m tests.benchmarks.cost --write docs/explanation/cost.md

writes the tables anew between the page's marks. CPU seconds of one thread, not those of a clock: another
process on the machine does not change them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import takewhile
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers.utils import logging as diffusers_logging

from geodiff_plugin._checks import bad_value
from geodiff_plugin.bundled.demo_pair import DemoPair, read_demo_pair
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.geometry import resize_intrinsics
from geodiff_plugin.matching import build
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.machine import PeakMemory
from tests.benchmarks.operations import Size, calls_of_all, count_operations

__all__ = ["AXES", "Axis", "exponent", "main", "resized_pair", "tables", "with_tables"]

BEGIN, END = "<!-- made by tests.benchmarks.cost -->", "<!-- end -->"
#: Operations a second that a GPU is taken to sustain, in TFLOP/s, for the extrapolation.
SUSTAINED = 100
PAIRS = 1_000_000
#: Bytes a pixel of what a call writes: depth and confidence in float32.
BYTES_A_PIXEL = 8


@dataclass(frozen=True)
class Axis:
    """One thing that is varied.

    Attributes:
        name: of the column.
        values: what it is set to, ascending.
        call: value -> arguments of ``measure``.
    """

    name: str
    values: tuple[int, ...]
    call: Callable[[int], dict[str, Any]]


#: The grids of losses and sweep grow with the picture here, which by default they do up to a bound.
AXES = (
    Axis("longer side of the picture, px", (256, 512, 1024), lambda n: {"side": n}),
    Axis("planes of the sweep, at most", (32, 64, 128), lambda n: {"knobs": {"planes": n}}),
    Axis("further views", (1, 2, 4), lambda n: {"views": n}),
    Axis("denoising steps", (4, 8, 16), lambda n: {"options": {"num_inference_steps": n}}),
    Axis("members of the ensemble", (1, 2, 4), lambda n: {"options": {"ensemble_size": n}}),
)
#: Side of the picture on all axes but the first.
SIDE = 512


def resized_pair(pair: DemoPair, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both pictures with that longer side, and the cameras ``(2, 3, 3)`` that go with them."""
    height, width = pair.left.shape[:2]
    size = (round(height * side / max(height, width)), round(width * side / max(height, width)))

    def scaled(image: np.ndarray) -> np.ndarray:
        tensor = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
        large = F.interpolate(tensor, size, mode="bilinear", antialias=True).clamp(0.0, 1.0)
        return large[0].permute(1, 2, 0).numpy()

    K = torch.from_numpy(np.stack([pair.rig.K_left, pair.rig.K_right]))
    return scaled(pair.left), scaled(pair.right), resize_intrinsics(K, (height, width), size).numpy()


def measure(
    side: int = SIDE,
    views: int = 1,
    knobs: dict[str, Any] | None = None,
    options: dict[str, Any] | None = None,
) -> tuple[float, int]:
    """CPU seconds and the most bytes of one guided call, to be run in a process of its own.

    Args:
        side: longer side of both pictures, which the grids of losses and sweep follow.
        views: how often the right view is given.
        knobs: of the guidance.
        options: of the call.
    """
    torch.set_num_threads(1)
    pair = read_demo_pair()
    left, right, (K_left, K_right) = resized_pair(pair, side)
    # The grid and the number of planes follow the bounds that are measured, and nothing else.
    if "planes" in (knobs or {}):
        build.PLANE_STEP_PX = 0.05
    grids = {"sweep_pixels": side * side}
    K = K_left, *[K_right] * views
    E = np.eye(4), *[pair.rig.E] * views
    guidance = GeometryGuidance((right,) * views, K, E, pose="given", **grids | (knobs or {}))
    pipe = enable_geometry_guidance(load_prior("bundled"))
    pipe.set_progress_bar_config(disable=True)
    with PeakMemory(torch.device("cpu")) as memory:
        started = time.process_time()
        pipe(left, guidance=guidance, generator=torch.Generator().manual_seed(0), **options or {})
        seconds = time.process_time() - started
    return seconds, memory.peak_bytes


def exponent(values: Sequence[float], found: Sequence[float]) -> float:
    """The slope of a straight line through both logarithms: 1 is proportional, 0 does not grow."""
    x, y = (np.log(np.asarray(v, float)) for v in (values, found))
    return float(np.polyfit(x, y, 1)[0])


def _head_of(axis: Axis) -> str:
    return f"| {axis.name} | " + " | ".join(map(str, axis.values)) + " | exponent |"


def _axis_table(axis: Axis, found: Sequence[tuple[float, int]]) -> list[str]:
    seconds, peaks = ([one[i] for one in found] for i in (0, 1))
    lines = [_head_of(axis)]
    lines.append("| --- |" + " ---: |" * (len(axis.values) + 1))
    cells = " | ".join(f"{s:.2f}" for s in seconds)
    lines.append(f"| CPU seconds | {cells} | {exponent(axis.values, seconds):.2f} |")
    cells = " | ".join(f"{b / 1e6:.0f}" for b in peaks)
    lines.append(f"| peak MB | {cells} | {exponent(axis.values, peaks):.2f} |")
    return [*lines, ""]


def tables(measured: dict[str, list[tuple[float, int]]], size: Size, page: str = "") -> str:
    """The page's tables as Markdown.

    Args:
        measured: name of an axis -> CPU seconds and bytes of each of its values.
        size: of the prior that the extrapolation counts.
        page: where axes that are not measured keep the table that they have.
    """
    lines, kept = ["### Measured: bundled prior, one CPU thread", ""], page.splitlines()
    for axis in AXES:
        if axis.name in measured:
            lines += _axis_table(axis, measured[axis.name])
        elif _head_of(axis) in kept:
            lines += [*takewhile(bool, kept[kept.index(_head_of(axis)) :]), ""]
    return "\n".join([*lines, *_extrapolated(size)])


def _extrapolated(size: Size) -> list[str]:
    """What a million pairs cost by counted operations: no GPU was there to measure it."""
    operations = count_operations(size)
    sides = [size.resolution // 2, size.resolution, 2 * size.resolution]
    lines = [f"### Counted: Marigold v1-1's configuration, {size.resolution} px, {size.steps} steps", ""]
    lines += [f"| TFLOP of one call at px | {' | '.join(map(str, sides))} | exponent |"]
    lines += ["| --- |" + " ---: |" * (len(sides) + 1)]
    each = [count_operations(Size(size.width, side)) for side in sides]
    for kind in ("network", "decode", "encode"):
        flops = [one[kind] for one in each]
        cells = " | ".join(f"{n / 1e12:.2f}" for n in flops)
        lines.append(f"| {kind} | {cells} | {exponent(sides, flops):.2f} |")
    calls = calls_of_all(size)
    lines += ["", f"| way | TFLOP a pair | x plain | days, {PAIRS:,} pairs, 1 GPU at {SUSTAINED} TFLOP/s |"]
    lines += ["| --- | ---: | ---: | ---: |"]
    plain = None
    for way, counts in calls.items():
        total = sum(n * operations[kind] for kind, n in counts.items()) / 1e12
        plain = plain or total
        days = PAIRS * total / SUSTAINED / 86400
        lines.append(f"| {way} | {total:.1f} | {total / plain:.2f} | {days:.2f} |")
    pixels = size.resolution * round(0.75 * size.resolution)
    written = PAIRS * pixels * BYTES_A_PIXEL / 1e12
    amount = f"{PAIRS:,} pairs of {pixels / 1e6:.2f} megapixels"
    lines += ["", f"Depth and confidence of {amount} in float32: {written:.1f} TB."]
    return [*lines, ""]


def with_tables(page: str, made: str) -> str:
    """A page with the tables between its marks made anew.

    Raises:
        InputError: a page without the marks.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        bad_value("the page", f"one with the marks {BEGIN} and {END}", "one without")
    return f"{before}{BEGIN}\n\n{made}\n{END}{after}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the tables, and write them into a page; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--write", type=Path, help="a page with marks; tables of axes left out stay")
    parser.add_argument("--axes", nargs="*", type=int, help="numbers of AXES, from 0; all by default")
    typed = parser.parse_args(arguments)
    diffusers_logging.set_verbosity_error()
    page = "" if typed.write is None else typed.write.read_text(encoding="utf-8")
    chosen = range(len(AXES)) if typed.axes is None else typed.axes
    measured: dict[str, list[tuple[float, int]]] = {}
    for axis in (AXES[i] for i in chosen):
        for value in axis.values:
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as fresh_process:
                found = fresh_process.submit(measure, **axis.call(value)).result()
            measured.setdefault(axis.name, []).append(found)
    made = tables(measured, Size(), page)
    print(made)
    if typed.write is not None:
        typed.write.write_text(with_tables(page, made), encoding="utf-8")


if __name__ == "__main__":
    main()
