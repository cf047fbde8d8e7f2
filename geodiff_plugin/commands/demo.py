"""``geodiff demo``: the whole way on a rendered pair whose depth is known, offline.

Hop: the demo pair -> ``geodiff depth`` on it -> files and a table of errors.
Paper: S5.1 (AbsRel, delta1, RMSE).
"""

from __future__ import annotations

from pathlib import Path

import torch

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from geodiff_plugin.commands.arguments import DepthArguments
from geodiff_plugin.commands.depth import estimate_and_write
from geodiff_plugin.commands.report import single_map, summary_line
from geodiff_plugin.evaluation.alignment import align
from geodiff_plugin.evaluation.metrics import evaluate_depth

__all__ = ["run_demo"]


def run_demo(out: Path, quiet: bool) -> None:
    """Write everything that ``geodiff depth`` writes, and print how far it is from the truth.

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
    maps = {
        "prior, aligned by an oracle": align(single_map(plain.prediction), pair.depth_m, pair.valid),
        "guided, metric as it comes": single_map(run.output.prediction),
    }
    print(f"{'':<28}{'AbsRel':>8}{'delta1':>8}{'RMSE, m':>9}")
    for name, depth_m in maps.items():
        scores = evaluate_depth(depth_m, pair.depth_m, pair.valid)
        print(f"{name:<28}{scores['abs_rel']:>8.3f}{scores['delta1']:>8.3f}{scores['rmse']:>9.3f}")
    print(summary_line(run.report, f"{out}/"))
