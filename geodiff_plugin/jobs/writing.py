"""Writes the folder of a result: maps, images, point clouds, exports and the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from geodiff_plugin import formats, plotting
from geodiff_plugin._internal.checks import warn
from geodiff_plugin._internal.reprojection import maps_in_camera
from geodiff_plugin.cameras import Camera, PosedCamera
from geodiff_plugin.capture.results import EVERY_DEPTH, FinishedFrame, Thresholds, reliable
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import REPORT, HeldFolder, OutFolder, in_8_bits, save_png
from geodiff_plugin.jobs.finished import Row, row_of
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions, LiveOptions, unique_names
from geodiff_plugin.jobs.records import PairInputs, PairResult, PairRun
from geodiff_plugin.jobs.report import build_report, measured_depth, report_text, single_map, used_poses
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.types import DepthFrame

#: Files that ``write_previews`` writes.
PREVIEWS = ("cloud.ply", "confidence.png", "overview.png")
#: Files with depth and sigma in the camera of ``--reproject``, each in metres (float) and whole millimetres.
DEPTH_REPROJECTED = ("depth_reprojected.npy", "depth_reprojected_mm.png")
SIGMA_REPROJECTED = ("sigma_reprojected.npy", "sigma_reprojected_mm.png")


def write_pair(folder: OutFolder | HeldFolder, run: PairRun, max_points: int | None = None) -> PairResult:
    """Fill an output folder: all maps, the files of ``--export``, and the report last.

    The folder appears complete or not at all. Point clouds are subsampled to ``max_points``.
    """
    options, inputs, output = run.options, run.inputs, run.output
    height, width = inputs.left.shape[:2]
    with fitting_memory("The result", (width, height)):
        report = build_report(run)

    def fill(place: Path) -> None:
        with run.log.stage("write"):
            report["files"] = write_maps(
                place, output, inputs.left, *thresholds(options), max_points=max_points
            )
            if inputs.undistorted:
                write_undistorted(place, inputs.left)
            if options.reproject is not None:
                depth_m = single_map(output.prediction * output.valid)
                sigma_m = None if output.sigma is None else single_map(output.sigma)
                camera = Camera(np.asarray(output.K)[0].astype(np.float64))
                report["reproject"] = write_reprojected(
                    place, depth_m, sigma_m, camera, options.target_camera()
                )
            if options.export:
                write_exports(place, output, inputs, options, max_points)
        report["files"]["names"] = [*sorted(path.name for path in place.iterdir()), REPORT]
        report["seconds"] = {stage: round(seconds, 3) for stage, seconds in run.log.seconds.items()}
        (place / REPORT).write_text(report_text(report) + "\n", encoding="utf-8")

    with fitting_memory("The result", (width, height)):
        folder.write(fill)
    return PairResult(run, folder.path, report)


def write_row(folder: OutFolder | HeldFolder, run: PairRun) -> Row:
    """Call ``write_pair``, and return the table row of the result."""
    return row_of(write_pair(folder, run).report)


def thresholds(options: DepthOptions | CaptureOptions | LiveOptions) -> Thresholds:
    """Return the thresholds of ``MetricDepthOutput.reliable`` in the options of a command."""
    return Thresholds(options.min_confidence, options.max_sigma)


def write_maps(
    folder: Path,
    output: MetricDepthOutput,
    left: np.ndarray,
    min_confidence: float = 0.0,
    max_sigma: float | None = None,
    max_points: int | None = None,
) -> dict[str, Any]:
    """Write all files of the image ``left (H, W, 3)`` except exports and report; return report counts.

    The cloud has the points that are ``reliable`` under the thresholds.
    """
    depth_m = single_map(output.prediction).astype(np.float32)
    K = np.asarray(output.K)[0]
    formats.write_depth_npy(folder / "depth.npy", depth_m)
    valid = single_map(output.valid)
    zeros = formats.write_depth_mm(folder / "depth_mm.png", depth_m * valid)
    maps = {name: np.asarray(extra)[0] for name, extra in output.extras.items()}
    names = ("photometric_error", "uncertainty", "confidence", "sigma")
    maps |= {name: single_map(x) for name in names if (x := getattr(output, name)) is not None}
    sigma_m = maps.get("sigma")
    if sigma_m is not None:
        formats.write_sigma_mm(folder / "sigma_mm.png", sigma_m)
    for name, values in maps.items():
        np.save(folder / f"{name}.npy", values.astype(np.float32))
    left = in_8_bits(left)
    _write_figures(folder, output, left, depth_m, maps)
    pixels = ShownPixels(depth_m, left, K, valid)
    kept = single_map(output.reliable(min_confidence, max_sigma))
    counts = _write_cloud(folder, pixels, kept, sigma_m, output.unit, max_points)
    return {"depth_mm_zero_pixels": zeros} | counts


def _write_cloud(
    folder: Path,
    pixels: ShownPixels,
    reliable_px: np.ndarray,
    sigma_m: np.ndarray | None,
    unit: str | None,
    max_points: int | None = None,
) -> dict[str, int]:
    """Write ``cloud.ply`` with the reliable pixels ``(H, W)`` except flying points; return report counts."""
    depth_m, left, K, valid = pixels
    flying = formats.flying_points(depth_m)
    kept = _thinned(reliable_px & ~flying, max_points)
    cloud = folder / "cloud.ply"
    points = formats.write_ply(cloud, depth_m, left, K, valid=kept, unit=unit, sigma_m=sigma_m)
    return {
        "cloud_points": points,
        "flying_points": int(flying.sum()),
        "doubtful_points": int((valid & ~reliable_px).sum()),
        "points_out_of_reach": int((~valid).sum()),
    }


def _write_figures(
    folder: Path,
    output: MetricDepthOutput,
    left: np.ndarray,
    depth_m: np.ndarray,
    maps: dict[str, np.ndarray],
) -> None:
    """Draw depth, visible pixels and confidence of the image ``left (H, W, 3)`` uint8, and an overview."""
    figure = plotting.depth_figure(depth_m, *figure_range(output), unit=output.unit)
    depth = _save_figure(figure, folder / "depth.png")
    confidence = error = None
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        save_png(Image.fromarray(visible.astype(np.uint8) * 255), folder / "visible.png")
        error = np.where(visible, maps["photometric_error"], np.nan)
    if output.confidence is not None:
        figure = plotting.fraction_figure(maps["confidence"], "confidence", 1.0)
        confidence = _save_figure(figure, folder / "confidence.png")
    save_png(plotting.overview(left, depth, confidence, error), folder / "overview.png")


def write_previews(
    frame: FinishedFrame, maps: DepthFrame, left: np.ndarray, limits: Thresholds = EVERY_DEPTH
) -> dict[str, int]:
    """Write cloud, ``confidence.png`` and ``overview.png`` of a frame again after its maps have changed.

    Its ``depth.png`` has been drawn again. The cloud has the points that are reliable under the ``limits``.
    Returns the counts of ``write_maps``.
    """
    folder, left = frame.folder, in_8_bits(left)
    assert maps.sigma is not None  # saved with every frame
    confidence = plotting.fraction_figure(maps.confidence, "confidence", 1.0)
    confidence = _save_figure(confidence, folder / "confidence.png")
    error = None
    if (folder / "visible.png").is_file():
        visible = np.asarray(Image.open(folder / "visible.png")) > 0
        error = np.where(visible, np.load(folder / "photometric_error.npy"), np.nan)
    with Image.open(folder / "depth.png") as figure:
        depth = plotting.shrunk(figure)
    save_png(plotting.overview(left, depth, confidence, error), folder / "overview.png")
    valid = (maps.depth > 0) & (maps.confidence > 0)
    zeros = int((formats.depth_mm(maps.depth * valid) == 0).sum())
    pixels = ShownPixels(maps.depth, left, frame.K, valid)
    kept = valid & reliable(maps, limits)
    return {"depth_mm_zero_pixels": zeros} | _write_cloud(folder, pixels, kept, maps.sigma, frame.unit)


def figure_range(output: MetricDepthOutput) -> tuple[float, float]:
    """Return the depths at the ends of a figure's colours; depths that were not measured do not count."""
    return plotting.measured_range(measured_depth(output), single_map(output.prediction))


def _thinned(kept: np.ndarray, max_points: int | None) -> np.ndarray:
    """Return at most ``max_points`` of the pixels of a mask, evenly subsampled in pixel order."""
    pixels = np.flatnonzero(kept)
    if max_points is None or len(pixels) <= max_points:
        return kept
    thinned = np.zeros(kept.shape, dtype=bool)
    thinned.flat[pixels[np.linspace(0, len(pixels) - 1, max_points).astype(np.intp)]] = True
    return thinned


def _save_figure(figure: Image.Image, path: Path) -> Image.Image:
    """Save a figure; return a smaller copy for the overview."""
    save_png(figure, path)
    return plotting.shrunk(figure)


def write_reprojected(
    folder: Path, depth_m: np.ndarray, sigma_m: np.ndarray | None, camera: Camera, other: PosedCamera
) -> dict[str, Any]:
    """Write depth and sigma ``(H, W)`` as the camera of ``--reproject`` sees them; return a report entry."""
    seen_m, sigma_seen_m = maps_in_camera(depth_m, sigma_m, camera, other)
    formats.write_depth_npy(folder / DEPTH_REPROJECTED[0], seen_m)
    formats.write_depth_mm(folder / DEPTH_REPROJECTED[1], seen_m)
    if sigma_seen_m is not None:
        formats.write_depth_npy(folder / SIGMA_REPROJECTED[0], sigma_seen_m)
        formats.write_sigma_mm(folder / SIGMA_REPROJECTED[1], sigma_seen_m)
    known = round(float((seen_m > 0).mean()), 4)
    if not known:
        hint = "Check that its E is its pose in the left camera's frame (camera-to-world), in metres."
        warn(Finding("depth.reprojected-empty", f"The camera of --reproject sees no depth. {hint}"))
    return {
        "K": other.K.tolist(),
        "E": other.E.tolist(),
        "size": list(other.size),
        "known_fraction": known,
    }


def write_undistorted(folder: Path, image_01: np.ndarray, number: int = 1) -> str:
    """Write an undistorted view (1 is the left one, to which the depth refers); return the file name."""
    name = "undistorted.png" if number == 1 else f"undistorted-{number}.png"
    save_png(plotting.as_rgb_image(image_01), folder / name)
    return name


def cameras_of(output: MetricDepthOutput, guidance: GeometryGuidance) -> tuple[PosedCamera, ...]:
    """Return the camera of every view of one image, left one first, with the poses used by the call."""
    depth_m = single_map(output.prediction)
    K = np.asarray(output.K)[0].astype(np.float64)
    further = zip(guidance.rigs, used_poses(output, guidance), guidance.rights, strict=True)
    rights = (PosedCamera(rig.K_right, (image.shape[-1], image.shape[-2]), E=E) for rig, E, image in further)
    return (PosedCamera(K, (depth_m.shape[1], depth_m.shape[0]), E=np.eye(4)), *rights)


class ShownPixels(NamedTuple):
    """Arguments of ``make_cloud`` and ``make_mesh``."""

    depth_m: np.ndarray  # (H, W)
    image_01: np.ndarray  # (H, W, 3)
    K: np.ndarray  # (3, 3)
    valid: np.ndarray  # (H, W) bool


def pixels_of(
    output: MetricDepthOutput, left: np.ndarray, min_confidence: float = 0.0, max_sigma: float | None = None
) -> ShownPixels:
    """Return the pixels of a point cloud: reliable under the thresholds, and no flying pixels."""
    depth_m = single_map(output.prediction)
    keep = single_map(output.reliable(min_confidence, max_sigma)) & ~formats.flying_points(depth_m)
    return ShownPixels(depth_m, left, np.asarray(output.K)[0].astype(np.float64), keep)


def write_exports(
    folder: Path,
    output: MetricDepthOutput,
    inputs: PairInputs,
    options: DepthOptions,
    max_points: int | None = None,
) -> None:
    """Write the files of ``--export``, and the undistorted images of a COLMAP model."""
    pixels = pixels_of(output, inputs.left, *thresholds(options))
    cameras = [(camera.K, camera.E, camera.size) for camera in cameras_of(output, inputs.guidance)]
    if "glb" in options.export:
        cloud = formats.make_cloud(*pixels._replace(valid=_thinned(pixels.valid, max_points)))
        formats.write_glb(folder / "cloud.glb", cloud, cameras)
    if "mesh" in options.export:
        formats.write_glb(folder / "mesh.glb", formats.make_mesh(*pixels), cameras)
    if "colmap" in options.export:
        names = unique_names(options.image_files().values())
        if inputs.undistorted:
            views = [inputs.left, *(image.permute(1, 2, 0).numpy() for image in inputs.guidance.rights)]
            names = [write_undistorted(folder, image, number) for number, image in enumerate(views, 1)]
        named = [(name, *view) for name, view in zip(names, cameras, strict=True)]
        formats.write_colmap(folder, named, formats.make_cloud(*pixels))
