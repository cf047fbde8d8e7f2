"""``geodiff submit``: results of rectified pairs as the files of a benchmark's submission."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.cli.terminal import say
from geodiff_plugin.formats import write_pfm
from geodiff_plugin.formats.depth import disparity_of_depth
from geodiff_plugin.formats.files import check_file, read_npy
from geodiff_plugin.formats.out import write_text

__all__ = ["run_submit"]

#: Benchmarks by name, and where their files lie below the folder of a submission.
BENCHMARKS = {
    "middlebury": "SET/SCENE/disp0METHOD.pfm (disp0METHOD_s.pfm with holes), timeMETHOD.txt",
    "eth3d": "low_res_two_view/SCENE.pfm, SCENE.txt",
}


def run_submit(results: Sequence[Path], benchmark: str, out: Path, method: str) -> None:
    """Write one disparity map and one time for every result.

    Args:
        results: folders of ``geodiff depth``, of one pair or of many each; the folder of a pair's left image
            names the scene.
        benchmark: of ``BENCHMARKS``.
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
        _write(out, benchmark, scene, method, disparity, report["seconds"]["guided call"])
    say(f"{out}: {len(reports)} pairs for {benchmark} ({BENCHMARKS[benchmark]})")


def _write(
    folder: Path, benchmark: str, scene: Path, method: str, disparity: np.ndarray, seconds: float
) -> None:
    """The disparity, infinity where unknown, and the time of the pair in a data set's folder ``scene``.

    Source: upload-format.html of Middlebury's evaluation, version 3; ETH3D's documentation, "Result
        submission".
    """
    if benchmark == "middlebury":
        if not method.isalnum():
            bad_value("--method", "letters and digits", repr(method))
        place = folder / scene.parent.name / scene.name
        holes = "_s" if np.isinf(disparity).any() else ""
        name, times, text = f"disp0{method}{holes}.pfm", f"time{method}.txt", f"{seconds:.2f}\n"
    else:
        place = folder / "low_res_two_view"
        name, times, text = f"{scene.name}.pfm", f"{scene.name}.txt", f"runtime {seconds:.2f}\n"
    write_text(place / times, text)
    write_pfm(place / name, disparity)
