"""Files of ``geodiff depth``: maps, cloud, GLB and COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.cli.inputs import Inputs
from geodiff_plugin.cli.options import DepthOptions, told_apart, undistorted_name
from geodiff_plugin.cli.report import single_map, used_poses
from geodiff_plugin.formats import (
    flying_points,
    make_cloud,
    write_colmap,
    write_depth_mm,
    write_depth_npy,
    write_glb,
    write_ply,
)
from geodiff_plugin.formats.sfm import check_colmap_names
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.plotting import depth_figure, overview, share_figure
from geodiff_plugin.types import MetricDepthOutput


def write_maps(
    folder: Path, output: MetricDepthOutput, left: np.ndarray, min_confidence: float = 0.0
) -> dict[str, Any]:
    """Write every file but exports and the report of one image, at its resolution; counts for the report.

    The image ``left (H, W, 3)`` in [0, 1] colours the cloud, which pixels of less confidence are not part of.
    """
    depth_m, K = single_map(output.prediction).astype(np.float32), np.asarray(output.K)[0]
    write_depth_npy(folder / "depth.npy", depth_m)
    zeros = write_depth_mm(folder / "depth_mm.png", depth_m)
    depth_figure(depth_m, unit=output.unit).save(folder / "depth.png")
    maps = {name: np.asarray(extra)[0] for name, extra in output.extras.items()}
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        Image.fromarray(visible.astype(np.uint8) * 255).save(folder / "visible.png")
        maps["photometric_error"] = single_map(output.photometric_error)
    if output.uncertainty is not None:
        maps["uncertainty"] = single_map(output.uncertainty)
    flying, doubtful = flying_points(depth_m), np.zeros(depth_m.shape, dtype=bool)
    if output.confidence is not None:
        maps["confidence"] = single_map(output.confidence)
        share_figure(maps["confidence"], "confidence", 1.0).save(folder / "confidence.png")
        doubtful = maps["confidence"] < min_confidence
    for name, values in maps.items():
        np.save(folder / f"{name}.npy", values.astype(np.float32))
    error = np.where(visible, maps["photometric_error"], np.nan) if output.visible is not None else None
    overview(left, depth_m, maps.get("confidence"), error, output.unit).save(folder / "overview.png")
    points = write_ply(folder / "cloud.ply", depth_m, left, K, valid=~(flying | doubtful), unit=output.unit)
    return {
        "depth_mm_zero_pixels": zeros,
        "cloud_points": points,
        "flying_points": int(flying.sum()),
        "doubtful_points": int(doubtful.sum()),
    }


def write_undistorted(folder: Path, image_01: np.ndarray, number: int = 1) -> None:
    """Write a view without its lens distortion; the depth belongs to the first, which is the left one."""
    image = Image.fromarray(np.rint(image_01.clip(0, 1) * 255).astype(np.uint8))
    image.save(folder / undistorted_name(number))


Cameras = tuple[tuple[np.ndarray, np.ndarray, tuple[int, int]], ...]


def cameras_of(output: MetricDepthOutput, guidance: GeometryGuidance) -> Cameras:
    """``(K, E, (width, height))`` of every view of one image, left one first; poses as the call used them."""
    depth_m, K = single_map(output.prediction), np.asarray(output.K)[0].astype(np.float64)
    further = zip(guidance.rigs, used_poses(output, guidance), guidance.rights, strict=True)
    rights = ((rig.K_right, E, (image.shape[-1], image.shape[-2])) for rig, E, image in further)
    return ((K, np.eye(4), (depth_m.shape[1], depth_m.shape[0])), *rights)


def check_image_names(options: DepthOptions, inputs: Inputs) -> None:
    """Refuse photographs whose names an export cannot hold, before the work that would be lost."""
    if "colmap" in options.export and not inputs.undistorted:
        check_colmap_names(told_apart(options.photographs().values()))


def write_exports(folder: Path, output: MetricDepthOutput, inputs: Inputs, options: DepthOptions) -> None:
    """Write what ``--export`` asks for, into a folder with the maps.

    The cloud has points of at least the least confidence, without those that hang between two surfaces. The
    images of a COLMAP model are the photographs, or where lens distortion was taken out written here.
    """
    depth_m, cameras = single_map(output.prediction), cameras_of(output, inputs.guidance)
    keep = ~flying_points(depth_m)
    if output.confidence is not None:
        keep &= single_map(output.confidence) >= options.min_confidence
    cloud = make_cloud(depth_m, inputs.left, cameras[0][0], keep)
    if "glb" in options.export:
        write_glb(folder / "cloud.glb", cloud, cameras)
    if "colmap" in options.export:
        names = told_apart(options.photographs().values())
        if inputs.undistorted:
            names = [undistorted_name(number) for number in range(1, 1 + len(cameras))]
            for number, image in enumerate(inputs.guidance.rights, 2):  # the left one is always written
                write_undistorted(folder, image.permute(1, 2, 0).numpy(), number)
        write_colmap(folder, [(name, *view) for name, view in zip(names, cameras, strict=True)], cloud)
