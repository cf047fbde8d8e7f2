"""``geodiff demo``: the whole way on a rendered pair whose depth is known, offline.

Hop: the demo pair -> ``geodiff depth`` on it -> files, a picture and a table of errors.
Paper: S5.1 (AbsRel, delta1, RMSE).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, DemoPair, read_demo_pair
from geodiff_plugin.commands.arguments import DepthArguments
from geodiff_plugin.commands.depth import estimate_and_write
from geodiff_plugin.commands.report import single_map, summary_line
from geodiff_plugin.evaluation.alignment import align
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.plotting import colour_depth, depth_range, grid

__all__ = ["run_demo"]

CELL_WIDTH = 360


def _write_overview(path: Path, pair: DemoPair, aligned_m: np.ndarray, guided_m: np.ndarray) -> None:
    """Left image, prior, guided, truth side by side, the three maps in the truth's colours."""
    near, far = depth_range(pair.depth_m, pair.valid)
    maps = [colour_depth(depth_m, near=near, far=far) for depth_m in (aligned_m, guided_m, pair.depth_m)]
    titles = ["left image", "prior, aligned by an oracle", "guided", f"truth, {near:.1f} m to {far:.1f} m"]
    with atomic_path(path) as temporary:
        grid([pair.left, *maps], titles, cell_width=CELL_WIDTH).save(temporary, optimize=True)


def run_demo(out: Path, quiet: bool) -> None:
    """Write what ``geodiff depth`` writes and ``overview.png``, and print how far it is from the truth.

    Args:
        out: folder; files of an earlier run are replaced, others stay.
        quiet: no progress bar.
    """
    arguments = DepthArguments(
        left=DEMO_PAIR_FOLDER / "left.png",
        right=DEMO_PAIR_FOLDER / "right.png",
        calib=(DEMO_PAIR_FOLDER / "calib.txt",),
        device="cpu",
        out=out,
        overwrite=True,
        quiet=quiet,
    )
    run = estimate_and_write(arguments)
    pair = read_demo_pair()
    plain = run.pipe(pair.left, generator=torch.Generator("cpu").manual_seed(arguments.seed))
    aligned_m = align(single_map(plain.prediction), pair.depth_m, pair.valid, run.pipe.config.prediction_type)
    guided_m = single_map(run.output.prediction)
    print(f"{'':<28}{'AbsRel':>8}{'delta1':>8}{'RMSE, m':>9}")
    for name, depth_m in (
        ("prior, aligned by an oracle", aligned_m),
        ("guided, metric as it comes", guided_m),
    ):
        scores = evaluate_depth(depth_m, pair.depth_m, pair.valid)
        print(f"{name:<28}{scores['abs_rel']:>8.3f}{scores['delta1']:>8.3f}{scores['rmse']:>9.3f}")
    _write_overview(out / "overview.png", pair, aligned_m, guided_m)
    print(summary_line(run.report, f"{out}/"))
