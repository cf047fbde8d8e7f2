"""Writes the files of ``geodiff depth`` so that they appear whole or not at all.

Hop: ``MetricDepthOutput`` and report -> a hidden sibling folder -> ``--out`` by renaming.
Paper: none.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin.commands.report import single_map
from geodiff_plugin.formats import flying_points, write_depth_mm_png, write_depth_npy, write_ply
from geodiff_plugin.plotting import depth_figure
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["OUTPUT_FILES", "staged_folder", "write_maps", "write_report"]

#: Everything that a run may write; what an earlier run left of these goes when a new one replaces it.
OUTPUT_FILES = (
    "depth.npy",
    "depth_mm.png",
    "depth.png",
    "visible.png",
    "photometric_error.npy",
    "uncertainty.npy",
    "confidence.npy",
    "normals.npy",
    "cloud.ply",
    "report.json",
)


@contextmanager
def staged_folder(out: Path) -> Iterator[Path]:
    """Give a hidden folder beside ``out`` to write into; its files move to ``out`` when the block ends well.

    A new ``out`` appears by one rename. In one that exists already, each file is replaced by one rename and
    the output files of an earlier run that this one does not write are removed; other files stay. On any
    error, Ctrl-C included, the hidden folder is removed and ``out`` stays as it was.

    Raises:
        OSError: the folder cannot be written.
    """
    target = out.absolute()
    staging = target.parent / f".{target.name}.{secrets.token_hex(4)}"
    try:
        staging.mkdir(parents=True)
    except OSError as error:
        raise OSError(f"--out must be a folder that can be written; got {out} ({error.strerror}).") from error
    try:
        yield staging
        if target.exists():
            written = sorted(staging.iterdir(), key=lambda path: path.name == "report.json")
            for path in written:
                os.replace(path, target / path.name)
            for name in set(OUTPUT_FILES) - {path.name for path in written}:
                (target / name).unlink(missing_ok=True)
        else:
            os.rename(staging, target)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


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
    visible = single_map(output.visible).astype(bool)
    write_depth_npy(folder / "depth.npy", depth_m)
    zeros = write_depth_mm_png(folder / "depth_mm.png", depth_m)
    depth_figure(depth_m).save(folder / "depth.png")
    Image.fromarray(visible.astype(np.uint8) * 255).save(folder / "visible.png")
    np.save(folder / "photometric_error.npy", single_map(output.photometric_error).astype(np.float32))
    if output.uncertainty is not None:
        np.save(folder / "uncertainty.npy", single_map(output.uncertainty).astype(np.float32))
    for name, extra in output.extras.items():
        np.save(folder / f"{name}.npy", np.asarray(extra)[0].astype(np.float32))
    flying, doubtful = flying_points(depth_m), np.zeros(depth_m.shape, dtype=bool)
    if output.confidence is not None:
        confidence = single_map(output.confidence).astype(np.float32)
        np.save(folder / "confidence.npy", confidence)
        doubtful = confidence < min_confidence
    points = write_ply(folder / "cloud.ply", depth_m, left, K, valid=~(flying | doubtful))
    return {
        "depth_mm_zero_pixels": zeros,
        "cloud_points": points,
        "flying_points": int(flying.sum()),
        "doubtful_points": int(doubtful.sum()),
    }


def write_report(folder: Path, report: dict[str, Any]) -> str:
    """Write ``report.json``.

    Returns:
        Its text.
    """
    text = json.dumps(report, indent=2, allow_nan=False)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    return text
