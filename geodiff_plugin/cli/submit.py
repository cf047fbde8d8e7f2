"""``geodiff submit``: results of rectified pairs as the files of a benchmark's submission."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.cli.terminal import say
from geodiff_plugin.formats.files import check_file, read_npy
from geodiff_plugin.formats.submissions import BENCHMARKS, disparity_of_depth, write_submission

__all__ = ["run_submit"]


def run_submit(results: Sequence[Path], benchmark: str, out: Path, method: str) -> None:
    """Write one disparity map and one time for every result.

    Args:
        results: folders of ``geodiff depth``, of one pair or of many each; the folder of a pair's left image
            names the scene.
        benchmark: of ``formats.submissions.BENCHMARKS``.
        out: folder of the submission.
        method: name of the method in Middlebury's files.

    Raises:
        InputError: no such benchmark, a folder without results, or a pair that is not rectified.
    """
    check_choice(benchmark, "--to", BENCHMARKS)
    reports = [path for folder in results for path in sorted(Path(folder).glob("**/report.json"))]
    if not reports:
        bad_value("RESULT", "a folder of geodiff depth", ", ".join(map(str, results)))
    scenes: set[Path] = set()
    for path in reports:
        report = json.loads(check_file(path, "RESULT").read_text(encoding="utf-8"))
        given = report["inputs"]
        K_left, K_right, E = (np.array(given[name], np.float64) for name in ("K_left", "K_right", "E"))
        depth_m = read_npy(path.parent / "depth.npy", "RESULT", "a depth map")
        disparity = disparity_of_depth(depth_m, K_left, K_right, E)
        scene = Path(report["arguments"]["left"]).absolute().parent
        if scene in scenes:
            got = f"two of {scene}"
            bad_value("RESULT", "one pair of every scene, whose folder its left image lies in", got)
        scenes.add(scene)
        write_submission(out, benchmark, scene, method, disparity, report["seconds"]["guided call"])
    say(f"{out}: {len(reports)} pairs for {benchmark} ({BENCHMARKS[benchmark]})")
