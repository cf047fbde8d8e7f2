"""``geodiff demo``: a guided call on a rendered pair whose depth is known, offline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from geodiff_plugin.bundled.demo_pair import DemoPair, read_demo_pair
from geodiff_plugin.cli.depth import estimate_and_write
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.cli.report import single_map, summary_line
from geodiff_plugin.cli.terminal import StopWatch, new_table, say, show
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.plotting import colour_depth, depth_range, grid

CELL_WIDTH = 360


def _write_comparison(path: Path, pair: DemoPair, aligned_m: np.ndarray, guided_m: np.ndarray) -> None:
    """Left image, prior, guided, truth side by side, the three maps in the truth's colours."""
    near, far = depth_range(pair.depth_m)
    maps = [colour_depth(depth_m, near=near, far=far) for depth_m in (aligned_m, guided_m, pair.depth_m)]
    titles = ["left image", "prior, aligned by an oracle", "guided", f"truth, {near:.1f} m to {far:.1f} m"]
    with atomic_path(path) as temporary:
        grid([pair.left, *maps], titles, cell_width=CELL_WIDTH).save(temporary, optimize=True)


def run_demo(options: DepthOptions, out: OutFolder) -> None:
    """Write what ``geodiff depth`` writes and ``comparison.png``, and print how far it is from the truth."""
    pipe, job, report = estimate_and_write(options, out, StopWatch())
    pair = read_demo_pair()
    plain = pipe(pair.left, generator=torch.Generator("cpu").manual_seed(options.seed))
    aligned_m = align(single_map(plain.prediction), pair.depth_m, pair.valid, pipe.config.prediction_type)
    guided_m = single_map(job.output.prediction)
    table = new_table(("", "AbsRel", "delta1", "RMSE, m"))
    for name, depth_m in (
        ("prior, aligned by an oracle", aligned_m),
        ("guided, metric as it comes", guided_m),
    ):
        scores = evaluate_depth(depth_m, pair.depth_m, pair.valid)
        table.add_row(name, *(f"{scores[metric]:.3f}" for metric in ("abs_rel", "delta1", "rmse")))
    show(table)
    try:
        _write_comparison(out.path / "comparison.png", pair, aligned_m, guided_m)
    except OSError as error:  # the result itself is safe
        say(f"geodiff: comparison.png could not be written ({error.strerror or error}).")
    print(summary_line(report, f"{out.path}/"))
    print(f"Open {out.path / 'comparison.png'} first: prior, guided depth and truth side by side.")
