"""On the bundled pairs: ``geodiff demo``, and ``geodiff bench``, what guidance costs."""

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

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.jobs.many import depth_pairs
from geodiff_plugin.jobs.options import DepthOptions, start_pair
from geodiff_plugin.jobs.pair import depth_pair
from geodiff_plugin.jobs.pairs import start_many
from geodiff_plugin.jobs.prior import load_guided_prior, prior_of_options
from geodiff_plugin.jobs.report import single_map, summary_line
from geodiff_plugin.jobs.telling import collected_warnings, say, silent
from geodiff_plugin.plotting import colour_depth, depth_range, grid
from geodiff_plugin.runtime.guided_call import count_guided_steps, enable_geometry_guidance
from geodiff_plugin.runtime.machine import pick_device, timed

CELL_WIDTH = 360
COMPARISON = "comparison.png"
#: Calls of which the fastest counts.
CALLS = 3
#: Pairs of the folder whose throughput is measured.
PAIRS = 4


def run_demo(options: DepthOptions, out: OutFolder) -> None:
    """Write what ``geodiff depth`` writes and ``comparison.png``, and print how far it is from the truth."""
    tell = silent if options.quiet else say
    with collected_warnings():
        pipe = prior_of_options(options, pick_device(options.device), None if options.quiet else say)
        result = depth_pair(options, pipe, folder=out, tell=tell, progress=not options.quiet)
    pair = read_demo_pair()
    plain = pipe(pair.left, generator=torch.Generator("cpu").manual_seed(options.seed))
    aligned_m = align(single_map(plain.prediction), pair.depth_m, pair.valid, pipe.config.prediction_type)
    guided_m = single_map(result.run.output.prediction)
    table = new_table(("", "AbsRel", "delta1", "RMSE, m"))
    rows = {"prior, aligned to the truth": aligned_m, "guided, metric as it comes": guided_m}
    for name, depth_m in rows.items():
        scores = evaluate_depth(depth_m, pair.depth_m, pair.valid)
        table.add_row(name, *(f"{scores[metric]:.3f}" for metric in ("abs_rel", "delta1", "rmse")))
    show(table)
    near, far = depth_range(pair.depth_m)
    maps = [colour_depth(depth_m, near=near, far=far) for depth_m in (aligned_m, guided_m, pair.depth_m)]
    titles = ["left image", "prior, aligned to the truth", "guided", f"truth, {near:.1f} m to {far:.1f} m"]
    _write_comparison(out.path, [pair.left, *maps], titles)
    print(summary_line(result.report, f"{out.path}/"))
    print(f"Open {out.path / COMPARISON} first: prior, guided depth and truth side by side.")


def _write_comparison(
    folder: Path, pictures: Sequence[np.ndarray], titles: Sequence[str], columns: int | None = None
) -> None:
    try:
        with atomic_path(folder / COMPARISON) as temporary:
            sheet = grid(pictures, titles, columns=columns, cell_width=CELL_WIDTH)
            sheet.save(temporary)
    except OSError as error:  # the results themselves are safe
        say(f"geodiff: {COMPARISON} could not be written ({error.strerror or error}).")


def run_real_demo(pairs: Sequence[DepthOptions], out: Path) -> None:
    """Write what ``geodiff depth`` writes of every pair into ``out/NAME``, and ``comparison.png`` of all."""
    first, cells, titles = pairs[0], list[np.ndarray](), list[str]()
    tell = silent if first.quiet else say
    with collected_warnings():
        pipe = prior_of_options(first, pick_device(first.device), None if first.quiet else say)
        for pair in pairs:
            name = pair.left.parent.name
            options = replace(pair, out=out / name)
            with start_pair(options) as folder:
                result = depth_pair(options, pipe, folder=folder, tell=tell, progress=not options.quiet)
            print(summary_line(result.report, f"{folder.path}/"))
            depth_m = single_map(result.run.output.prediction)
            cells += [result.run.inputs.left, colour_depth(depth_m)]
            titles += [name, "{:.1f} m to {:.1f} m".format(*depth_range(depth_m))]
    _write_comparison(out, cells, titles, columns=2)
    print(f"Open {out / COMPARISON} first: every left image beside its depth.")


def run_bench(options: Any) -> None:
    """Print seconds of a plain and of a guided call, pairs a second, and where the time of a command goes."""
    place, pair = pick_device(options.device), read_demo_pair()
    where = f"{place}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    pipe = load_guided_prior(options.prior, place, options.space)
    enable_geometry_guidance(pipe, graphs=options.graphs, kernels=not options.no_kernels)
    guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
    count, _ = count_guided_steps(pipe, guidance, options.steps)
    generator = torch.Generator("cpu").manual_seed(options.seed)
    table, fastest = new_table(("", "seconds", "time x")), list[float]()
    for name, given in (("plain", None), ("guided", guidance)):
        call = partial(pipe, pair.left, guidance=given, num_inference_steps=count, generator=generator)
        fastest.append(min(timed(call, place) for _ in range(CALLS)))
        table.add_row(name, f"{fastest[-1]:.2f}", f"{fastest[-1] / fastest[0]:.2f}")
    title = f"prior {options.prior}, {count} steps, default guidance; {where}; demo pair"
    show(title, table, _pairs_a_second(options, pipe, count, place), _command_seconds(options, place))


def _write_plainly(pipe: Any, steps: int, folder: Path) -> None:
    """Plain calls on every picture of a folder, whose depth is written and removed again."""
    for path in sorted(folder.iterdir()):
        with Image.open(path) as picture:
            depth = pipe(picture.convert("RGB"), num_inference_steps=steps).prediction
        np.save(path.with_suffix(".npy"), depth)
        path.with_suffix(".npy").unlink()


def _pairs_a_second(options: Any, pipe: Any, steps: int, place: torch.device) -> str:
    """Throughput of a folder of demo pairs, read and written: guided by the command, and plain."""
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
        plain = PAIRS / timed(lambda: _write_plainly(pipe, steps, folder / "left"), place)
    of_plain = f"{guided / plain:.2f} of plain's"
    return f"pairs a second of a folder: guided {guided:.2f}, plain {plain:.2f} ({of_plain})"


def _command_seconds(options: Any, place: torch.device) -> str:
    """Where the time of ``geodiff depth`` goes, in a process of its own."""
    left, right, calib = (str(DEMO_PAIR_FOLDER / name) for name in ("left.png", "right.png", "calib.txt"))
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--calib", calib, "--device", str(place), "--json", "--quiet", "--out", f"{folder}/out"]
        for name in ("prior", "space", "steps", "seed"):
            value = getattr(options, name)
            flags += [] if value is None else [f"--{name}", str(value)]
        flags += ["--graphs"] if options.graphs else []
        flags += ["--no-kernels"] if options.no_kernels else []
        words = [sys.executable, "-m", "geodiff_plugin", "depth", left, right, *flags]
        started = time.perf_counter()
        answer = subprocess.run(words, check=True, capture_output=True, text=True)
        whole = time.perf_counter() - started
    stages: dict[str, float] = json.loads(answer.stdout)["seconds"]
    stages["python"] = whole - sum(stages.values())  # what lies around them
    told = ", ".join(f"{name} {seconds:.1f}" for name, seconds in stages.items())
    return f"geodiff depth: {sum(stages.values()):.1f} s ({told})"
