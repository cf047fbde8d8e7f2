"""Implement ``geodiff demo`` and ``geodiff bench``, which run on the bundled pairs."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, example_name, read_demo_pair
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats import OutFolder, atomic_path
from geodiff_plugin.jobs import (
    DepthOptions,
    collected_warnings,
    depth_pair,
    depth_pairs,
    figure_range,
    load_guided_prior,
    prior_of_options,
    say,
    silent,
    single_map,
    start_many,
    start_pair,
    summary_line,
)
from geodiff_plugin.plotting import colour_depth, depth_range, grid
from geodiff_plugin.runtime.guided_call import count_guided_steps, enable_geometry_guidance
from geodiff_plugin.runtime.machine import pick_device, timed

CELL_WIDTH = 360
COMPARISON = "comparison.png"
#: Number of timed calls, of which the fastest counts.
CALLS = 3
#: Number of pairs in the folder whose throughput is measured.
PAIRS = 4


def run_demo(options: DepthOptions, out: OutFolder) -> None:
    """Write the output of ``geodiff depth`` and ``comparison.png``, and print errors against ground truth."""
    notify = silent if options.quiet else say
    with collected_warnings():
        pipe = prior_of_options(options, pick_device(options.device), None if options.quiet else say)
        result = depth_pair(options, pipe, folder=out, notify=notify, progress=not options.quiet)
    pair = read_demo_pair()
    plain = pipe(pair.left, generator=torch.Generator("cpu").manual_seed(options.seed))
    aligned_m = align(single_map(plain.prediction), pair.depth_m, pair.valid, pipe.config.prediction_type)
    guided_m = single_map(result.run.output.prediction)
    table = new_table(("", "AbsRel", "delta1", "RMSE, m"))
    rows = {"prior, aligned to ground truth": aligned_m, "guided (metric, no alignment)": guided_m}
    for name, depth_m in rows.items():
        scores = evaluate_depth(depth_m, pair.depth_m, pair.valid)
        table.add_row(name, *(f"{scores[metric]:.3f}" for metric in ("abs_rel", "delta1", "rmse")))
    show(table)
    near, far = depth_range(pair.depth_m)
    maps = [colour_depth(depth_m, near=near, far=far) for depth_m in (aligned_m, guided_m, pair.depth_m)]
    titles = ["left image", "prior, aligned to ground truth", "guided", "ground truth"]
    _write_comparison(out.path, [pair.left, *maps], titles, [(near, far)])
    print(summary_line(result.report, f"{out.path}/"))
    print(f"Open {out.path / COMPARISON} first: prior, guided depth and ground truth side by side.")


def _write_comparison(
    folder: Path,
    images: Sequence[np.ndarray],
    titles: Sequence[str],
    depth_ranges: Sequence[tuple[float, float]],
    columns: int | None = None,
) -> None:
    """Write images next to each other, each row with the colour bar of its depths."""
    try:
        with atomic_path(folder / COMPARISON) as temporary:
            sheet = grid(images, titles, columns=columns, cell_width=CELL_WIDTH, depth_ranges=depth_ranges)
            sheet.save(temporary)
    except OSError as error:  # the results are already written
        say(f"geodiff: {COMPARISON} could not be written ({error.strerror or error}).")


def run_real_demo(pairs: Sequence[DepthOptions], out: Path) -> None:
    """Write the output of ``geodiff depth`` for every pair to ``out/NAME``, and one ``comparison.png``."""
    first = pairs[0]
    cells = list[np.ndarray]()
    titles = list[str]()
    ranges = list[tuple[float, float]]()
    notify = silent if first.quiet else say
    with collected_warnings():
        pipe = prior_of_options(first, pick_device(first.device), None if first.quiet else say)
        for pair in pairs:
            name = example_name(pair.left.parent)
            options = replace(pair, out=out / name.lower())
            with start_pair(options) as folder:
                result = depth_pair(options, pipe, folder=folder, notify=notify, progress=not options.quiet)
            print(summary_line(result.report, f"{folder.path}/"))
            ends = figure_range(result.run.output)
            cells += [result.run.inputs.left, colour_depth(single_map(result.run.output.prediction), *ends)]
            ranges.append(ends)
            titles += [name, "depth"]
    _write_comparison(out, cells, titles, ranges, columns=2)
    print(f"Open {out / COMPARISON} first: each left image next to its depth.")


def run_bench(options: Any) -> None:
    """Print the seconds of a plain and a guided call, the throughput, and the stages of a command."""
    place = pick_device(options.device)
    pair = read_demo_pair()
    where = f"{place}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    pipe = load_guided_prior(options.prior, place, options.space, options.dtype)
    enable_geometry_guidance(pipe, cuda_graphs=options.cuda_graphs, kernels=not options.no_triton)
    guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
    count, _ = count_guided_steps(pipe, guidance, options.steps)
    generator = torch.Generator("cpu").manual_seed(options.seed)
    table = new_table(("", "seconds", "ratio"))
    fastest = list[float]()
    for name, given in (("plain", None), ("guided", guidance)):
        call = partial(pipe, pair.left, guidance=given, num_inference_steps=count, generator=generator)
        fastest.append(min(timed(call, place) for _ in range(CALLS)))
        table.add_row(name, f"{fastest[-1]:.2f}", f"{fastest[-1] / fastest[0]:.2f}")
    title = f"prior {options.prior}, {count} steps, default guidance; {where}; demo pair"
    show(title, table, _throughput(options, pipe, count, place), _command_timings(options, place))


def _write_plain(pipe: Any, steps: int, folder: Path) -> None:
    """Make plain calls on every image of a folder, and write and remove their depth."""
    for path in sorted(folder.iterdir()):
        with Image.open(path) as image:
            depth = pipe(image.convert("RGB"), num_inference_steps=steps).prediction
        np.save(path.with_suffix(".npy"), depth)
        path.with_suffix(".npy").unlink()


def _throughput(options: Any, pipe: Any, steps: int, place: torch.device) -> str:
    """Measure the throughput on a folder of demo pairs, including file access, guided and plain."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent)
        for side, number in product(("left", "right"), range(PAIRS)):
            (folder / side).mkdir(exist_ok=True)
            shutil.copyfile(DEMO_PAIR_FOLDER / f"{side}.png", folder / side / f"{number}.png")

        many = DepthOptions(
            left=folder / "left",
            right=folder / "right",
            calib=(DEMO_PAIR_FOLDER / "calib.txt",),
            steps=options.steps,
            device=str(place),
            out=folder / "out",
            overwrite=True,
            quiet=True,
        )
        refs = start_many(many)
        guided = PAIRS / timed(lambda: depth_pairs(many, refs, pipe=pipe), place)
        plain = PAIRS / timed(lambda: _write_plain(pipe, steps, folder / "left"), place)
    ratio = f"ratio {guided / plain:.2f}"
    return f"throughput on a folder: guided {guided:.2f} pairs/s, plain {plain:.2f} pairs/s ({ratio})"


def _command_timings(options: Any, place: torch.device) -> str:
    """Run ``geodiff depth`` in a separate process and return a line with the seconds of its stages."""
    left, right, calib = (str(DEMO_PAIR_FOLDER / name) for name in ("left.png", "right.png", "calib.txt"))
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--calib", calib, "--device", str(place), "--json", "--quiet", "--out", f"{folder}/out"]
        for name in ("prior", "space", "steps", "seed"):
            value = getattr(options, name)
            flags += [] if value is None else [f"--{name}", str(value)]
        flags += ["--cuda-graphs"] if options.cuda_graphs else []
        flags += ["--no-triton"] if options.no_triton else []
        command = [sys.executable, "-m", "geodiff_plugin", "depth", left, right, *flags]
        started = time.perf_counter()
        process = subprocess.run(command, check=True, capture_output=True, text=True)
        total = time.perf_counter() - started
    stages: dict[str, float] = json.loads(process.stdout)["seconds"]
    stages["python"] = total - sum(stages.values())  # the time outside all stages
    reported = ", ".join(f"{name} {seconds:.1f}" for name, seconds in stages.items())
    return f"geodiff depth: {sum(stages.values()):.1f} s ({reported})"
