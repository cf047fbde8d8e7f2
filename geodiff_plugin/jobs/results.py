"""Converts finished results into a depth video or benchmark files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin import formats, plotting
from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.capture.results import common_range
from geodiff_plugin.formats import (
    REPORT,
    check_new_file,
    disparity_of_depth,
    read_npy,
    read_report,
    write_text,
)

#: File layout of the submission to each benchmark.
BENCHMARKS = {
    "middlebury": "SET/SCENE/disp0METHOD.pfm (disp0METHOD_s.pfm with holes), timeMETHOD.txt",
    "eth3d": "low_res_two_view/SCENE.pfm, SCENE.txt",
}


def _mapped_depth(path: Path) -> np.ndarray:
    """Check and memory-map the depth map of a frame, because the maps of a long video exceed the memory."""
    file = formats.check_file(path, "FRAME", "a folder of geodiff depth or a .npy")
    expected = "a depth map (H, W) of floats in metres"
    depth_m = read_npy(file, "FRAME", expected)
    if depth_m.ndim != 2 or depth_m.dtype.kind != "f" or not depth_m.size:
        bad_value("FRAME", expected, f"{file}")
    mapped: np.ndarray = np.load(file, mmap_mode="r")
    return mapped


def write_video(
    frames: Sequence[Path],
    out: Path,
    fps: float,
    near: float | None = None,
    far: float | None = None,
    overwrite: bool = False,
) -> float:
    """Join depth maps of a sequence into a video; return its duration in seconds.

    The legend is in metres unless a report states that its map has no unit.

    Args:
        frames: folders of ``geodiff depth``, or ``.npy`` maps ``(H, W)`` in metres, all of the same size.
        out: ``.mp4``, ``.webp`` or ``.gif``.
        fps: frames per second.
        near: depth of the last colour, metres (default: from the maps; in folders, depths too far to be
            measured do not count).
        far: depth of the first colour (default: likewise).
        overwrite: whether to replace an existing file.
    """
    plotting.check_video(out, fps)
    check_new_file(out, overwrite)
    files = [path / "depth.npy" if os.path.isdir(path) else path for path in frames]
    depths_m = [_mapped_depth(file) for file in files]
    sizes = ["{1}x{0}".format(*depth_m.shape) for depth_m in depths_m]
    for path, size in zip(frames, sizes, strict=True):
        if size != sizes[0]:
            both = f"{sizes[0]} in {frames[0]}, {size} in {path}"
            raise_input_error(f"The frames have different sizes: {both}. Make a separate video per size.")
    if all(map(os.path.isdir, frames)):
        near, far = common_range(frames, near, far)
    metric = all(read_report(file.parent).get("unit", "m") is not None for file in files)
    images = plotting.depth_frames(depths_m, near=near, far=far, unit="m" if metric else None)
    plotting.write_depth_video(out, images, fps)
    return len(frames) / fps


@dataclass(frozen=True)
class _Submitted:
    """One benchmark result: folder of its scene, disparities ``(H, W)`` in pixels, and seconds."""

    scene: Path
    disparity: np.ndarray
    seconds: float


def write_submission(results: Sequence[Path], to: str, out: Path, method: str = "GeoDiff") -> int:
    """Write a disparity map and runtime for every result in these folders; return their number.

    The folder of the left image is the scene. ``to`` is a key of ``BENCHMARKS``, ``method`` the method name
    in Middlebury's file names.

    Source: upload-format.html of Middlebury's evaluation 3; "Result submission" in ETH3D's documentation.
    """
    if to == "middlebury" and not method.isalnum():
        bad_value("--method", "letters and digits", repr(method))
    folders = [path.parent for folder in results for path in sorted(folder.glob(f"**/{REPORT}"))]
    if not folders:
        raise_input_error(f"No result of geodiff depth found in {', '.join(map(str, results))}.")
    reports = [_report(folder) for folder in folders]
    of_scene: dict[Path, Path] = {}
    for folder, report in zip(folders, reports, strict=True):
        other = of_scene.setdefault(_scene_of(report), folder)
        if other is not folder:
            hint = "The scene is the folder of the left image; pass one result per scene."
            raise_input_error(f"{other} and {folder} are both results of scene {_scene_of(report)}. {hint}")
    for folder, report in zip(folders, reports, strict=True):
        result = _submitted(folder, report)
        if to == "middlebury":
            _write_middlebury(result, out, method)
        else:
            place = out / "low_res_two_view"
            write_text(place / f"{result.scene.name}.txt", f"runtime {result.seconds:.2f}\n")
            formats.write_pfm(place / f"{result.scene.name}.pfm", result.disparity)
    return len(folders)


def _report(folder: Path) -> dict[str, Any]:
    report = read_report(folder)
    if "inputs" not in report:
        raise_input_error(f"{folder / REPORT} is not a report of geodiff depth.")
    return report


def _scene_of(report: dict[str, Any]) -> Path:
    return Path(report["arguments"]["left"]).absolute().parent


def _submitted(folder: Path, report: dict[str, Any]) -> _Submitted:
    K_left, K_right, E = (np.array(report["inputs"][n], np.float64) for n in ("K_left", "K_right", "E"))
    depth_m = read_npy(folder / "depth.npy", "RESULT", "a depth map")
    disparity = disparity_of_depth(depth_m, K_left, K_right, E)
    return _Submitted(_scene_of(report), disparity, report["seconds"]["guided call"])


def _write_middlebury(result: _Submitted, out: Path, method: str) -> None:
    place = out / result.scene.parent.name / result.scene.name
    holes = "_s" if np.isinf(result.disparity).any() else ""
    write_text(place / f"time{method}.txt", f"{result.seconds:.2f}\n")
    formats.write_pfm(place / f"disp0{method}{holes}.pfm", result.disparity)
