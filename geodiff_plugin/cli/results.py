"""What is made of results of ``geodiff depth``: a video of a sequence, the submission to a benchmark."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.outputs import read_report
from geodiff_plugin.cli.terminal import say
from geodiff_plugin.formats import check_file, write_pfm
from geodiff_plugin.formats.depth import disparity_of_depth
from geodiff_plugin.formats.files import read_npy
from geodiff_plugin.formats.out import REPORT, write_text
from geodiff_plugin.plotting import check_video, depth_frames, write_depth_video

#: Benchmarks by name, and where their files lie below the folder of a submission.
BENCHMARKS = {
    "middlebury": "SET/SCENE/disp0METHOD.pfm (disp0METHOD_s.pfm with holes), timeMETHOD.txt",
    "eth3d": "low_res_two_view/SCENE.pfm, SCENE.txt",
}


def _map(path: Path) -> np.ndarray:
    """The map of a frame, left in its file: those of a long video exceed the memory."""
    file = check_file(path, "FRAME", "a folder of geodiff depth or a .npy")
    expected = "a depth map (H, W) of floats in metres"
    depth_m = read_npy(file, "FRAME", expected)
    if depth_m.ndim != 2 or depth_m.dtype.kind != "f" or not depth_m.size:
        bad_value("FRAME", expected, f"{file}")
    mapped: np.ndarray = np.load(file, mmap_mode="r")
    return mapped


def run_video(frames: Sequence[Path], out: Path, fps: float, near: float | None, far: float | None) -> None:
    """Write the video, whose legend is in metres unless a report says that its map has none."""
    check_video(out, fps)
    files = [path / "depth.npy" if os.path.isdir(path) else path for path in frames]
    depths_m = [_map(file) for file in files]
    sizes = ["{1}x{0}".format(*depth_m.shape) for depth_m in depths_m]
    for path, size in zip(frames, sizes, strict=True):
        if size != sizes[0]:
            expected = f"all of one shape, {sizes[0]} pixels as {frames[0]}"
            bad_value("FRAME", expected, f"{path} of {size}", "Make a video of each size.")
    metric = all(read_report(file.parent).get("unit", "m") is not None for file in files)
    write_depth_video(out, depth_frames(depths_m, near=near, far=far, unit="m" if metric else None), fps)
    print(f"{len(frames)} frames, {len(frames) / fps:.1f} s -> {out}")


def run_submit(results: Sequence[Path], to: str, out: Path, method: str) -> None:
    """Write one disparity map, infinity where unknown, and one time for every result below the folders.

    The folder of a pair's left image names the scene.

    Source: upload-format.html of Middlebury's evaluation, version 3; ETH3D's documentation, "Result
        submission".
    """
    if to == "middlebury" and not method.isalnum():
        bad_value("--method", "letters and digits", repr(method))
    folders = [path.parent for folder in results for path in sorted(folder.glob(f"**/{REPORT}"))]
    if not folders:
        bad_value("RESULT", "a folder of geodiff depth", ", ".join(map(str, results)))
    scenes: set[Path] = set()
    for folder in folders:
        report = read_report(folder)
        K_left, K_right, E = (np.array(report["inputs"][n], np.float64) for n in ("K_left", "K_right", "E"))
        depth_m = read_npy(folder / "depth.npy", "RESULT", "a depth map")
        disparity = disparity_of_depth(depth_m, K_left, K_right, E)
        scene = Path(report["arguments"]["left"]).absolute().parent
        if scene in scenes:
            expected = "one pair of every scene, whose folder its left image lies in"
            bad_value("RESULT", expected, f"two of {scene}")
        scenes.add(scene)
        time = f"{report['seconds']['guided call']:.2f}\n"
        if to == "middlebury":
            place, holes = out / scene.parent.name / scene.name, "_s" if np.isinf(disparity).any() else ""
            name, times = f"disp0{method}{holes}.pfm", f"time{method}.txt"
        else:
            place, time = out / "low_res_two_view", f"runtime {time}"
            name, times = f"{scene.name}.pfm", f"{scene.name}.txt"
        write_text(place / times, time)
        write_pfm(place / name, disparity)
    say(f"{out}: {len(folders)} pairs for {to} ({BENCHMARKS[to]})")
