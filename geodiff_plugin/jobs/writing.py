"""The folder of a result: maps, pictures, clouds, exports and the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from geodiff_plugin import formats, plotting
from geodiff_plugin._reprojection import PosedCamera, depth_in_camera
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats.clouds import in_8_bits
from geodiff_plugin.formats.files import save_png
from geodiff_plugin.formats.out import REPORT, HeldPlace, OutFolder
from geodiff_plugin.formats.target import read_target_camera
from geodiff_plugin.jobs.finished import Row, row_of
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.options import DepthOptions, unique_names
from geodiff_plugin.jobs.reading import PairInputs
from geodiff_plugin.jobs.records import PairResult, PairRun
from geodiff_plugin.jobs.report import build_report, report_text, single_map, used_poses
from geodiff_plugin.result.output import MetricDepthOutput

#: Depth as the camera of ``--into`` sees it: floats, and whole millimetres.
INTO = ("depth_into.npy", "depth_into_mm.png")


def write_pair(folder: OutFolder | HeldPlace, run: PairRun, **entries: Any) -> PairResult:
    """Fill an output folder: every map, what ``--export`` asks for, and last the report.

    ``entries`` of the report are those that only the caller knows. The folder appears whole or not at all.
    """
    options, inputs, output = run.options, run.inputs, run.output
    height, width = inputs.left.shape[:2]
    with fitting_memory("The result", (width, height)):
        report = build_report(run) | entries

    def fill(place: Path) -> None:
        with run.log.stage("write"):
            report["files"] = write_maps(place, output, inputs.left, options.min_confidence)
            if inputs.undistorted:
                write_undistorted(place, inputs.left)
            if options.into is not None:
                depth_m = single_map(output.prediction * output.valid)
                K = np.asarray(output.K)[0].astype(np.float64)
                report["into"] = write_into(place, depth_m, K, options.into)
            if options.export:
                write_exports(place, output, inputs, options)
        report["files"]["names"] = [*sorted(path.name for path in place.iterdir()), REPORT]
        report["seconds"] = {stage: round(seconds, 3) for stage, seconds in run.log.seconds.items()}
        (place / REPORT).write_text(report_text(report) + "\n", encoding="utf-8")

    with fitting_memory("The result", (width, height)):
        folder.write(fill)
    return PairResult(run, folder.path, report)


def write_row(folder: OutFolder | HeldPlace, run: PairRun, entries: dict[str, Any]) -> Row:
    """``write_pair``, and the row of a table that says what it wrote."""
    return row_of(write_pair(folder, run, **entries).report)


def write_maps(
    folder: Path, output: MetricDepthOutput, left: np.ndarray, min_confidence: float = 0.0
) -> dict[str, Any]:
    """Write every file but exports and the report of the image ``left (H, W, 3)``; counts for the report."""
    depth_m, K = single_map(output.prediction).astype(np.float32), np.asarray(output.K)[0]
    formats.write_depth_npy(folder / "depth.npy", depth_m)
    valid = single_map(output.valid)
    zeros = formats.write_depth_mm(folder / "depth_mm.png", depth_m * valid)
    depth = _save_figure(plotting.depth_figure(depth_m, unit=output.unit), folder / "depth.png")
    maps = {name: np.asarray(extra)[0] for name, extra in output.extras.items()}
    of_call = {name: getattr(output, name) for name in ("photometric_error", "uncertainty", "confidence")}
    maps |= {name: single_map(value) for name, value in of_call.items() if value is not None}
    for name, values in maps.items():
        np.save(folder / f"{name}.npy", values.astype(np.float32))
    flying, doubtful = formats.flying_points(depth_m), np.zeros(depth_m.shape, dtype=bool)
    confidence = error = None
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        save_png(Image.fromarray(visible.astype(np.uint8) * 255), folder / "visible.png")
        error = np.where(visible, maps["photometric_error"], np.nan)
    if output.confidence is not None:
        figure = plotting.share_figure(maps["confidence"], "confidence", 1.0)
        confidence = _save_figure(figure, folder / "confidence.png")
        doubtful = maps["confidence"] < min_confidence
    left = in_8_bits(left)
    save_png(plotting.overview(left, depth, confidence, error), folder / "overview.png")
    kept = valid & ~(flying | doubtful)
    points = formats.write_ply(folder / "cloud.ply", depth_m, left, K, valid=kept, unit=output.unit)
    return {
        "depth_mm_zero_pixels": zeros,
        "cloud_points": points,
        "flying_points": int(flying.sum()),
        "doubtful_points": int(doubtful.sum()),
        "points_out_of_reach": int((~valid).sum()),
    }


def _save_figure(figure: Image.Image, path: Path) -> Image.Image:
    """Save a figure; what the overview shows of it, as it may be large."""
    save_png(figure, path)
    return plotting.shrunk(figure)


def write_into(folder: Path, depth_m: np.ndarray, K: np.ndarray, path: Path) -> dict[str, Any]:
    """Write a depth map ``(H, W)`` as the camera of ``--into`` sees it; what the report says of it."""
    camera = read_target_camera(path)
    seen_m = depth_in_camera(depth_m, K, camera)
    formats.write_depth_npy(folder / INTO[0], seen_m)
    formats.write_depth_mm(folder / INTO[1], seen_m)
    known = round(float((seen_m > 0).mean()), 4)
    return {"K": camera.K.tolist(), "E": camera.E.tolist(), "size": list(camera.size), "known_share": known}


def write_undistorted(folder: Path, image_01: np.ndarray, number: int = 1) -> str:
    """Write a view without its lens distortion, 1 for the left one, to which the depth belongs; its name."""
    name = "undistorted.png" if number == 1 else f"undistorted-{number}.png"
    save_png(plotting.as_picture(image_01), folder / name)
    return name


def cameras_of(output: MetricDepthOutput, guidance: GeometryGuidance) -> tuple[PosedCamera, ...]:
    """The camera of every view of one image, left one first; poses as the call used them."""
    depth_m, K = single_map(output.prediction), np.asarray(output.K)[0].astype(np.float64)
    further = zip(guidance.rigs, used_poses(output, guidance), guidance.rights, strict=True)
    rights = (PosedCamera(rig.K_right, E, (image.shape[-1], image.shape[-2])) for rig, E, image in further)
    return (PosedCamera(K, np.eye(4), (depth_m.shape[1], depth_m.shape[0])), *rights)


class ShownPixels(NamedTuple):
    """What ``make_cloud`` and ``make_mesh`` take."""

    depth_m: np.ndarray  # (H, W)
    image_01: np.ndarray  # (H, W, 3)
    K: np.ndarray  # (3, 3)
    valid: np.ndarray  # (H, W) bool, the pixels to be shown


def pixels_of(output: MetricDepthOutput, left: np.ndarray, least_confidence: float) -> ShownPixels:
    """The pixels of a result that a cloud shows: valid ones of this confidence or more that do not fly."""
    depth_m = single_map(output.prediction)
    keep = single_map(output.valid) & ~formats.flying_points(depth_m)
    if output.confidence is not None:
        keep &= single_map(output.confidence) >= least_confidence
    return ShownPixels(depth_m, left, np.asarray(output.K)[0].astype(np.float64), keep)


def write_exports(folder: Path, output: MetricDepthOutput, inputs: PairInputs, options: DepthOptions) -> None:
    """Write what ``--export`` asks for, and images of a COLMAP model that were undistorted."""
    pixels = pixels_of(output, inputs.left, options.min_confidence)
    cameras = cameras_of(output, inputs.guidance)
    if "glb" in options.export:
        formats.write_glb(folder / "cloud.glb", formats.make_cloud(*pixels), cameras)
    if "mesh" in options.export:
        formats.write_glb(folder / "mesh.glb", formats.make_mesh(*pixels), cameras)
    if "colmap" in options.export:
        names = unique_names(options.photographs().values())
        if inputs.undistorted:
            views = [inputs.left, *(image.permute(1, 2, 0).numpy() for image in inputs.guidance.rights)]
            names = [write_undistorted(folder, image, number) for number, image in enumerate(views, 1)]
        named = [(name, *view) for name, view in zip(names, cameras, strict=True)]
        formats.write_colmap(folder, named, formats.make_cloud(*pixels))
