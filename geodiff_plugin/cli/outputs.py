"""What ``geodiff depth`` writes, the line that sums it up, and what is made of results later."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin import formats, plotting
from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.options import DepthOptions, told_apart
from geodiff_plugin.cli.terminal import say
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats.depth import disparity_of_depth
from geodiff_plugin.formats.files import read_npy
from geodiff_plugin.formats.out import REPORT, check_new_file, write_text
from geodiff_plugin.result.confidence import expected_error
from geodiff_plugin.result.verdict import UNTESTED
from geodiff_plugin.runtime.machine import versions
from geodiff_plugin.types import MetricDepthOutput

#: Benchmarks by name, and where their files lie below the folder of a submission.
BENCHMARKS = {
    "middlebury": "SET/SCENE/disp0METHOD.pfm (disp0METHOD_s.pfm with holes), timeMETHOD.txt",
    "eth3d": "low_res_two_view/SCENE.pfm, SCENE.txt",
}


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a result; empty where there is none, or none that can be read."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def single_map(value: Any) -> np.ndarray:
    """The ``(H, W)`` map of the one image of a call."""
    return np.asarray(value)[0, ..., 0]


def depth_summary(depth_m: np.ndarray, visible: np.ndarray | None) -> dict[str, Any]:
    """Near, far, median of ``(H, W)`` metres over valid pixels; shares and counts over all."""
    valid = np.isfinite(depth_m) & (depth_m > 0)
    kept = depth_m[valid] if valid.any() else np.array([math.nan])
    return {
        "min_m": float(kept.min()),
        "median_m": float(np.median(kept)),
        "mean_m": float(kept.mean()),
        "max_m": float(kept.max()),
        "width": depth_m.shape[1],
        "height": depth_m.shape[0],
        "invalid_pixels": int((~valid).sum()),
        "visible_fraction": 0.0 if visible is None else float(visible.mean()),
    }


def plain(value: Any) -> Any:
    """Tensors and arrays as lists, numbers that JSON has no name for as ``None``."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, torch.Tensor):
        return plain(value.detach().cpu().tolist())
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def used_poses(output: MetricDepthOutput, guidance: GeometryGuidance) -> tuple[np.ndarray, ...]:
    """``(4, 4)`` poses of the further views in the output's unit; the refined ones, which the depth fits."""
    if output.poses and output.poses[0].status == "refined":
        return output.poses[0].E
    return tuple(_rescaled(rig.E, output) for rig in guidance.rigs)


def _rescaled(E: np.ndarray, output: MetricDepthOutput) -> np.ndarray:
    """A pose of the guidance in the unit of the output."""
    return E * np.array([1.0, 1.0, 1.0, output.rescaled])


def verdict_report(output: MetricDepthOutput) -> dict[str, Any]:
    """The verdict as reports have it, with the indicators as ``signs``."""
    verdict: dict[str, Any] = plain(asdict(output.verdict))
    return verdict | {"signs": verdict.pop("indicators")}


def build_report(
    inputs: Inputs, output: MetricDepthOutput, pipe: Any, options: DepthOptions, warnings: list[str]
) -> dict[str, Any]:
    """The report without seconds and files, which are known when everything else is written."""
    rig, guidance = inputs.rig, inputs.guidance
    depth_m, visible, error = single_map(output.prediction), None, math.nan
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        error = float(single_map(output.photometric_error)[visible].mean()) if visible.any() else math.nan
    spread, estimated = output.uncertainty, guidance.estimated
    if estimated is not None:
        measures = ("inliers", "parallax_deg", "residual_px", "depth_spread")
        scale = {"scale_from": output.scale_from, "scale_spread": output.scale_spread}
        pose = {name: getattr(estimated, name) for name in measures} | scale | {"assumed": estimated.notes}
    names = ("K", "scale", "shift", "global_scale", "prior_scale", "prior_error", "unit", "assumed")
    cameras = guidance.inputs[0].K_left, used_poses(output, guidance)
    expected_m = expected_error(depth_m, *cameras, np.nan_to_num(output.verdict.indicators.scale_spread))
    report = {
        "depth": depth_summary(depth_m, visible),
        "verdict": verdict_report(output),
        "photometric_error_mean": error,
        "expected_error_median_m": np.median(expected_m),
        "uncertainty_median_m": None if spread is None else np.median(single_map(spread)),
        **{name: getattr(output, name) for name in names},
        "history": [vars(step) for step in output.history],
        "estimated_pose": None if estimated is None else pose,
        "pose": vars(output.poses[0]) if output.poses else None,
        "guidance": guidance.as_run().to_dict(),
        "versions": versions(),
        "warnings": warnings,
        "undistorted": inputs.undistorted,
        "inputs": {
            "left_size": rig.size_left,
            "right_size": rig.size_right,
            "calibration": rig.source,
            "K_left": rig.K_left,
            "K_right": rig.K_right,
            "E": _rescaled(rig.E, output),
            "baseline_m": output.rescaled * float(np.linalg.norm(rig.E[:3, 3])),
            "further_views": [
                {"K": each.K_right, "E": _rescaled(each.E, output)} for each in guidance.rigs[1:]
            ],
        },
        "prior": {
            "name": options.prior,
            "pipeline": type(pipe).__name__,
            "scheduler": type(pipe.scheduler).__name__,
            "device": str(pipe._execution_device),
            "dtype": options.dtype,
        },
        "arguments": options.as_json(),
    }
    return plain(report)


def _length(value: float, unit: str | None) -> str:
    """Two decimals, or two digits of what is too small for them."""
    number = f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"
    return number if unit is None else f"{number} {unit}"


def summary_line(report: dict[str, Any], where: str) -> str:
    """One line for people: near, far, median and what they rest on; where not trusted, the verdict first."""
    depth, verdict = report["depth"], report["verdict"]
    end = f"{sum(report['seconds'].values()):.1f} s -> {where}"
    if depth["median_m"] is None:
        return f"no valid depth; {end}"
    near, far, median = (_length(depth[name], report["unit"]) for name in ("min_m", "max_m", "median_m"))
    metres = f"{near} to {far}, median {median}"
    if report["unit"] is None:
        of = "baselines" if report.get("estimated_pose") else "the calibration's lengths"
        metres += f", in {of} (no unit)"
    if verdict["status"] != "trusted":
        reason = verdict["reasons"][0] if verdict["reasons"] else f"{UNTESTED}."
        return f"{verdict['status'].upper()}: {reason} (Unconfirmed: {metres}; {end})"
    signs, error, prior_scale = verdict["signs"], report.get("expected_error_median_m"), report["prior_scale"]
    trusted = ["trusted if what is assumed holds" if report.get("assumed") else "trusted"]
    trusted += [] if signs["confidence"] is None else [f"confidence {signs['confidence']:.2f}"]
    trusted += [] if error is None else [f"expected error {_length(error, report['unit'])}"]
    trusted += [] if signs["matched"] is None else [f"{100 * signs['matched']:.0f} % matched"]
    trusted += [f"{signs['points']} known depths"] if signs["points"] else []
    scale = [] if prior_scale is None else [f"prior's own metres x {prior_scale[0][0]:.2f}"]
    return "; ".join([metres, ", ".join(trusted), *scale, end])


def write_maps(
    folder: Path, output: MetricDepthOutput, left: np.ndarray, min_confidence: float = 0.0
) -> dict[str, Any]:
    """Write every file but exports and the report of the image ``left (H, W, 3)``; counts for the report."""
    depth_m, K = single_map(output.prediction).astype(np.float32), np.asarray(output.K)[0]
    formats.write_depth_npy(folder / "depth.npy", depth_m)
    zeros = formats.write_depth_mm(folder / "depth_mm.png", depth_m)
    plotting.depth_figure(depth_m, unit=output.unit).save(folder / "depth.png")
    maps = {name: np.asarray(extra)[0] for name, extra in output.extras.items()}
    of_call = {name: getattr(output, name) for name in ("photometric_error", "uncertainty", "confidence")}
    maps |= {name: single_map(value) for name, value in of_call.items() if value is not None}
    for name, values in maps.items():
        np.save(folder / f"{name}.npy", values.astype(np.float32))
    flying, doubtful, error = formats.flying_points(depth_m), np.zeros(depth_m.shape, dtype=bool), None
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        Image.fromarray(visible.astype(np.uint8) * 255).save(folder / "visible.png")
        error = np.where(visible, maps["photometric_error"], np.nan)
    if output.confidence is not None:
        plotting.share_figure(maps["confidence"], "confidence", 1.0).save(folder / "confidence.png")
        doubtful = maps["confidence"] < min_confidence
    plotting.overview(left, depth_m, maps.get("confidence"), error, output.unit).save(folder / "overview.png")
    kept = ~(flying | doubtful)
    points = formats.write_ply(folder / "cloud.ply", depth_m, left, K, valid=kept, unit=output.unit)
    return {
        "depth_mm_zero_pixels": zeros,
        "cloud_points": points,
        "flying_points": int(flying.sum()),
        "doubtful_points": int(doubtful.sum()),
    }


def write_undistorted(folder: Path, image_01: np.ndarray, number: int = 1) -> str:
    """Write a view without its lens distortion, 1 for the left one, to which the depth belongs; its name."""
    name = "undistorted.png" if number == 1 else f"undistorted-{number}.png"
    plotting.as_picture(image_01).save(folder / name)
    return name


def cameras_of(
    output: MetricDepthOutput, guidance: GeometryGuidance
) -> tuple[tuple[np.ndarray, np.ndarray, tuple[int, int]], ...]:
    """``(K, E, (width, height))`` of every view of one image, left one first; poses as the call used them."""
    depth_m, K = single_map(output.prediction), np.asarray(output.K)[0].astype(np.float64)
    further = zip(guidance.rigs, used_poses(output, guidance), guidance.rights, strict=True)
    rights = ((rig.K_right, E, (image.shape[-1], image.shape[-2])) for rig, E, image in further)
    return ((K, np.eye(4), (depth_m.shape[1], depth_m.shape[0])), *rights)


def pixels_of(
    output: MetricDepthOutput, left: np.ndarray, least_confidence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What ``make_cloud`` and ``make_mesh`` take: pixels of at least this confidence that do not fly."""
    depth_m = single_map(output.prediction)
    keep = ~formats.flying_points(depth_m)
    if output.confidence is not None:
        keep &= single_map(output.confidence) >= least_confidence
    return depth_m, left, np.asarray(output.K)[0].astype(np.float64), keep


def write_exports(folder: Path, output: MetricDepthOutput, inputs: Inputs, options: DepthOptions) -> None:
    """Write what ``--export`` asks for, and images of a COLMAP model that were undistorted."""
    pixels = pixels_of(output, inputs.left, options.min_confidence)
    cameras = cameras_of(output, inputs.guidance)
    if "glb" in options.export:
        formats.write_glb(folder / "cloud.glb", formats.make_cloud(*pixels), cameras)
    if "mesh" in options.export:
        formats.write_glb(folder / "mesh.glb", formats.make_mesh(*pixels), cameras)
    if "colmap" in options.export:
        names = told_apart(options.photographs().values())
        if inputs.undistorted:
            views = [inputs.left, *(image.permute(1, 2, 0).numpy() for image in inputs.guidance.rights)]
            names = [write_undistorted(folder, image, number) for number, image in enumerate(views, 1)]
        named = [(name, *view) for name, view in zip(names, cameras, strict=True)]
        formats.write_colmap(folder, named, formats.make_cloud(*pixels))


def _map(path: Path) -> np.ndarray:
    """The map of a frame, left in its file: those of a long video exceed the memory."""
    file = formats.check_file(path, "FRAME", "a folder of geodiff depth or a .npy")
    expected = "a depth map (H, W) of floats in metres"
    depth_m = read_npy(file, "FRAME", expected)
    if depth_m.ndim != 2 or depth_m.dtype.kind != "f" or not depth_m.size:
        bad_value("FRAME", expected, f"{file}")
    mapped: np.ndarray = np.load(file, mmap_mode="r")
    return mapped


def run_video(
    frames: Sequence[Path], out: Path, fps: float, near: float | None, far: float | None, overwrite: bool
) -> None:
    """Write the video, whose legend is in metres unless a report says that its map has none."""
    plotting.check_video(out, fps)
    check_new_file(out, overwrite)
    files = [path / "depth.npy" if os.path.isdir(path) else path for path in frames]
    depths_m = [_map(file) for file in files]
    sizes = ["{1}x{0}".format(*depth_m.shape) for depth_m in depths_m]
    for path, size in zip(frames, sizes, strict=True):
        if size != sizes[0]:
            expected = f"all of one shape, {sizes[0]} pixels as {frames[0]}"
            bad_value("FRAME", expected, f"{path} of {size}", "Make a video of each size.")
    metric = all(read_report(file.parent).get("unit", "m") is not None for file in files)
    pictures = plotting.depth_frames(depths_m, near=near, far=far, unit="m" if metric else None)
    plotting.write_depth_video(out, pictures, fps)
    print(f"{len(frames)} frame{'s' * (len(frames) > 1)}, {len(frames) / fps:.1f} s -> {out}")


def run_submit(results: Sequence[Path], to: str, out: Path, method: str) -> None:
    """Write a disparity map and a time for every result; the folder of its left image names the scene.

    Source: upload-format.html of Middlebury's evaluation 3; "Result submission" in ETH3D's documentation.
    """
    if to == "middlebury" and not method.isalnum():
        bad_value("--method", "letters and digits", repr(method))
    folders = [path.parent for folder in results for path in sorted(folder.glob(f"**/{REPORT}"))]
    if not folders:
        bad_value("RESULT", "a folder of geodiff depth", ", ".join(map(str, results)))
    scenes: set[Path] = set()
    for folder in folders:
        report = read_report(folder)
        if "inputs" not in report:
            bad_value("RESULT", "made by geodiff depth", folder)
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
        formats.write_pfm(place / name, disparity)
    say(f"{out}: {len(folders)} pairs for {to} ({BENCHMARKS[to]})")
