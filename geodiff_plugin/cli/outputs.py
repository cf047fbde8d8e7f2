"""Writes the files of ``geodiff depth``, all of them or none.

Data flow: ``MetricDepthOutput`` and report -> files in a folder that ``out_folder`` puts in its place.
Paper: none.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.cli.arguments import undistorted_name
from geodiff_plugin.cli.report import single_map
from geodiff_plugin.formats import flying_points, write_depth_mm, write_depth_npy, write_ply
from geodiff_plugin.plotting import depth_figure, overview, share_figure
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["write_maps", "write_report", "write_undistorted"]


def write_maps(
    folder: Path, output: MetricDepthOutput, left: np.ndarray, min_confidence: float = 0.0
) -> dict[str, Any]:
    """Write every file but the report.

    Args:
        folder: an existing one.
        output: of the guided call, at the left image's resolution.
        left: ``(H, W, 3)`` image in [0, 1], colours of the cloud.
        min_confidence: pixels below it are no points of the cloud, [0, 1].

    Returns:
        Counts for the report.
    """
    depth_m, K = single_map(output.prediction).astype(np.float32), np.asarray(output.K)[0]
    write_depth_npy(folder / "depth.npy", depth_m)
    zeros = write_depth_mm(folder / "depth_mm.png", depth_m)
    depth_figure(depth_m, unit=output.unit).save(folder / "depth.png")
    error = None
    if output.visible is not None:
        visible = single_map(output.visible).astype(bool)
        Image.fromarray(visible.astype(np.uint8) * 255).save(folder / "visible.png")
        error = single_map(output.photometric_error).astype(np.float32)
        np.save(folder / "photometric_error.npy", error)
        error = np.where(visible, error, np.nan)
    if output.uncertainty is not None:
        np.save(folder / "uncertainty.npy", single_map(output.uncertainty).astype(np.float32))
    for name, extra in output.extras.items():
        np.save(folder / f"{name}.npy", np.asarray(extra)[0].astype(np.float32))
    flying, doubtful = flying_points(depth_m), np.zeros(depth_m.shape, dtype=bool)
    confidence = None
    if output.confidence is not None:
        confidence = single_map(output.confidence).astype(np.float32)
        np.save(folder / "confidence.npy", confidence)
        share_figure(confidence, "confidence", 1.0).save(folder / "confidence.png")
        doubtful = confidence < min_confidence
    overview(left, depth_m, confidence, error, output.unit).save(folder / "overview.png")
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


def write_report(folder: Path, report: dict[str, Any]) -> str:
    """Write ``report.json``.

    Returns:
        Its text.
    """
    text = json.dumps(report, indent=2, allow_nan=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    return text
