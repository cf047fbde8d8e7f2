"""Files that the page offers for download."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin import __version__
from geodiff_plugin.app.job import Result
from geodiff_plugin.formats import (
    Cloud,
    atomic_path,
    flying_points,
    make_cloud,
    write_depth_mm,
    write_depth_npy,
    write_glb,
    write_ply,
)
from geodiff_plugin.plotting import depth_figure

__all__ = ["cloud_of", "report_of", "write_files", "write_scene"]

#: More points than this make a browser slow; the files to take home hold all.
MOST_POINTS_SHOWN = 250_000


def _kept(result: Result, least_confidence: float) -> np.ndarray:
    keep = ~flying_points(result.depth_m)
    return keep if result.confidence is None else keep & (result.confidence >= least_confidence)


def cloud_of(result: Result, least_confidence: float = 0.0) -> Cloud:
    """The points that are at least so sure, without those that hang between two surfaces."""
    return make_cloud(result.depth_m, result.views.left, result.K, _kept(result, least_confidence))


def _cameras(result: Result) -> list[tuple[np.ndarray, np.ndarray, tuple[int, int]]]:
    rigs, rights = result.guidance.rigs, result.guidance.rights
    cameras = [(result.K, np.eye(4), result.views.size)]
    return cameras + [
        (rig.K_right, E, (image.shape[-1], image.shape[-2]))
        for rig, E, image in zip(rigs, result.Es, rights, strict=True)
    ]


def write_scene(path: Path, result: Result, least_confidence: float) -> int:
    """Cloud and cameras as GLB, light enough for a browser; returns how many points there are in all."""
    cloud = cloud_of(result, least_confidence)
    write_glb(path, cloud.thinned(MOST_POINTS_SHOWN), _cameras(result))
    return len(cloud.points_m)


def report_of(result: Result) -> dict[str, Any]:
    """Cameras, settings, what came out and what to mind, as JSON can hold it."""
    request, depth_m = result.request, result.depth_m
    visible = result.visible
    return {
        "geodiff_plugin": __version__,
        "depth": {
            "min_m": float(depth_m.min()),
            "max_m": float(depth_m.max()),
            "median_m": float(np.median(depth_m)),
            "visible_fraction": None if visible is None else float(visible.mean()),
            "median_confidence": None if result.confidence is None else float(np.median(result.confidence)),
        },
        "warnings": result.warnings,
        "K": result.K.tolist(),
        "cameras": [
            {"K": rig.K_right.tolist(), "E": E.tolist()}
            for rig, E in zip(result.guidance.rigs, result.Es, strict=True)
        ],
        "photographs": [Path(name).name for name in result.views.names],
        "settings": {
            name: getattr(request, name)
            for name in ("prior", "preset", "steps", "members", "resolution", "near", "far", "seed")
        },
        "guidance": result.guidance.as_run().to_dict(),
        "seconds": {name: round(value, 3) for name, value in result.seconds.items()},
    }


def write_files(folder: Path, result: Result, least_confidence: float = 0.0) -> list[Path]:
    """Write everything that can be downloaded.

    Args:
        folder: an existing one.
        result: of a job.
        least_confidence: points of the clouds have at least this.

    Returns:
        The files, most wanted first.
    """
    names = ("depth_mm.png", "depth.npy", "depth.png", "cloud.ply", "cloud.glb", "report.json")
    millimetres, array, picture, ply, glb, report = paths = [folder / name for name in names]
    write_depth_mm(millimetres, result.depth_m)
    write_depth_npy(array, result.depth_m)
    depth_figure(result.depth_m).save(picture)
    keep = _kept(result, least_confidence)
    write_ply(ply, result.depth_m, result.views.left, result.K, keep)
    write_glb(glb, cloud_of(result, least_confidence), _cameras(result))
    with atomic_path(report) as temporary:
        temporary.write_text(json.dumps(report_of(result), indent=2, default=str) + "\n", encoding="utf-8")
    return paths
