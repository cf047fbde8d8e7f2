"""Disparities in the layouts that the benchmarks of Middlebury and ETH3D take."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.depth import write_pfm
from geodiff_plugin.formats.out import write_text

__all__ = ["BENCHMARKS", "disparity_of_depth", "write_submission"]

#: Benchmarks by name, and where their files lie below the folder of a submission.
BENCHMARKS = {
    "middlebury": "SET/SCENE/disp0METHOD.pfm (disp0METHOD_s.pfm with holes), timeMETHOD.txt",
    "eth3d": "low_res_two_view/SCENE.pfm, SCENE.txt",
}


def disparity_of_depth(
    depth_m: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """Disparity in pixels of a rectified rig, ``fx baseline / Z - doffs``; infinity where depth is unknown.

    ``depth_m`` is ``(H, W)`` in the unit of ``E``; the intrinsics are in its pixels.

    Raises:
        ValueError: a rig that is not rectified.
    """
    others = E - np.eye(4)
    others[0, 3] = 0.0
    if E[0, 3] <= 0 or np.abs(others).max() > 1e-3 * max(E[0, 3], 1.0):
        bad_value("a submission", "of rectified pairs", "a pair with another pose")
    known = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.where(known, 1.0 / np.where(known, depth_m, 1.0), np.inf)
    return (K_left[0, 0] * E[0, 3] * inverse - (K_right[0, 2] - K_left[0, 2])).astype(np.float32)


def write_submission(
    folder: Path, benchmark: str, scene: Path, method: str, disparity: np.ndarray, seconds: float
) -> Path:
    """Write the disparity and the time of one pair.

    Args:
        folder: of the submission.
        benchmark: of ``BENCHMARKS``.
        scene: the data set's folder of the pair; its name, and for Middlebury that of its parent
            (``trainingH``), say where the files lie.
        method: name of the method in Middlebury's file names, letters and digits.
        disparity: ``(H, W)`` pixels, infinity where unknown.
        seconds: that it took.

    Returns:
        The map's file.

    Source: upload-format.html of Middlebury's evaluation, version 3; ETH3D's documentation, "Result
        submission".
    """
    if benchmark == "middlebury":
        if not method.isalnum():
            bad_value("--method", "letters and digits", repr(method))
        place = folder / scene.parent.name / scene.name
        holes = "_s" if np.isinf(disparity).any() else ""
        files, text = (f"disp0{method}{holes}.pfm", f"time{method}.txt"), f"{seconds:.2f}\n"
    else:
        place = folder / "low_res_two_view"
        files, text = (f"{scene.name}.pfm", f"{scene.name}.txt"), f"runtime {seconds:.2f}\n"
    place.mkdir(parents=True, exist_ok=True)
    write_pfm(place / files[0], disparity)
    write_text(place / files[1], text)
    return place / files[0]
