"""Exports a capture with depth for splatting and radiance field trainers: ``transforms.json`` and its files.

Source: ``nerfstudio/data/dataparsers/nerfstudio_dataparser.py`` and ``data/utils/data_utils.py`` of
nerfstudio-project/nerfstudio: depth is ``depth_file_path`` times ``depth_unit_scale_factor`` (default 0.001),
in the length unit of the poses; 0 is unknown; nonzero pixels of masks are used.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin import plotting
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats import (
    MAX_16_BITS,
    NERF_CAMERA,
    CaptureFrame,
    Cloud,
    TransformsFile,
    atomic_path,
    is_reoriented,
    save_png,
    write_depth_npy,
    write_text,
    write_vertices,
)
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.types import DepthFrame

#: Unit of the depth maps in the length unit of the poses: nerfstudio's default.
DEPTH_UNIT = 1e-3
#: Minimum median depth in these units for which whole units are precise enough.
MIN_UNITS = 500
#: Image formats that trainers do not read.
UNREAD = (".heic", ".heif")
#: Maximum number of initial points of a trainer.
MAX_POINTS = 200_000
#: Keys of the original file that list images of a split.
SPLITS = ("train_filenames", "val_filenames", "test_filenames")
#: Keys of the original file that become invalid: lengths are those before ``applied_scale``, and points and
#: depth maps are replaced. points and depth maps are ours.
REPLACED = ("applied_scale", "ply_file_path", "integer_depth_scale", "depth_unit_scale_factor", "is_fisheye")
REPLACED_OF_FRAME = ("depth_path", "applied_scale", "integer_depth_scale", "is_fisheye")


@dataclass(frozen=True, eq=False)
class SplatFrame:
    """One frame of the export: its agreed depth, and the mask of confident pixels."""

    depth: DepthFrame
    sure: np.ndarray


def write_splats(
    folder: Path,
    capture: Capture,
    names: Sequence[str],
    load: Callable[[str], SplatFrame],
    cloud: Cloud,
    original: TransformsFile | None,
) -> None:
    """Write ``transforms.json``, images, depth maps, masks of confidence, and points of a capture.

    Poses are the solved ones, which match the depth, in the original frame and length unit; depth maps are in
    thousandths of it (16-bit PNG, or float32 ``.npy`` if too coarse or out of range). Frames with pixels that
    are not valid have a mask of their image. Other fields of ``original``, the capture's file, are preserved.
    Distorted images are undistorted.
    """
    for name in ("images", "depths"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    entries = [_write_frame(folder, capture, load(name), original) for name in names]
    shared = {key: entries[0][key] for key in NERF_CAMERA if len({entry[key] for entry in entries}) == 1}
    kept = {} if original is None else {k: v for k, v in original.shared.items() if k not in REPLACED}
    renamed = {entry.pop("original_path"): entry["file_path"] for entry in entries}
    for split in SPLITS:
        if isinstance(kept.get(split), list):
            kept[split] = [renamed[path] for path in kept[split] if path in renamed]
    _write_points(folder / "points.ply", capture, cloud.thinned(MAX_POINTS))
    frames = [{key: value for key, value in entry.items() if key not in shared} for entry in entries]
    data = kept | {
        "camera_model": "OPENCV",
        **shared,
        "depth_unit_scale_factor": DEPTH_UNIT,
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    if original is None:  # otherwise nerfstudio assumes the axes of its own COLMAP conversion
        data["applied_transform"] = np.eye(4)[:3].tolist()
    if capture.unit == "m":
        data["metres_per_unit"] = capture.metres_per_unit
    write_text(folder / "transforms.json", json.dumps(data, indent=2) + "\n")


def _write_points(path: Path, capture: Capture, cloud: Cloud) -> None:
    """Write a cloud in metres in the capture's original length unit."""
    points = cloud.points_m / capture.metres_per_unit
    names = (*"xyz", "red", "green", "blue")
    write_vertices(path, "frame of transforms.json", None, len(points), names, [(points, cloud.colours)])


def _write_frame(
    folder: Path, capture: Capture, found: SplatFrame, original: TransformsFile | None
) -> dict[str, Any]:
    """Write the files of a frame, return its entries; ``original_path`` is its path in the original."""
    frame = capture.frame(found.depth.name)
    depth = found.depth
    entries = {} if original is None else dict(original.frames.get(frame.image, {}))
    named = entries.get("file_path", frame.name)
    entries = {key: value for key, value in entries.items() if key not in REPLACED_OF_FRAME}
    entries.pop("mask_path", None)  # of the image before undistortion, and without overlays
    if (valid := capture.valid(frame.name)) is not None:
        entries["mask_path"] = _write_mask(folder, "masks", frame.name, valid * np.uint8(255))
    units = np.where(found.sure, depth.depth / (DEPTH_UNIT * capture.metres_per_unit), 0.0)
    E = depth.camera.E.copy()
    E[:3, 3] /= capture.metres_per_unit
    K, (height, width) = depth.camera.K, depth.depth.shape
    mask_of_depth = np.where(found.sure, np.rint(255 * depth.confidence.clip(1 / 255, 1)), 0).astype(np.uint8)
    return entries | {
        "original_path": named,
        "file_path": _write_image(folder, capture, frame),
        "depth_file_path": _write_units(folder, frame.name, units),
        "depth_mask_path": _write_mask(folder, "depth_masks", frame.name, mask_of_depth),
        "transform_matrix": (E @ OPENGL_FROM_OPENCV).tolist(),
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2] + 0.5),
        "cy": float(K[1, 2] + 0.5),
        "w": width,
        "h": height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def _write_mask(folder: Path, kind: str, name: str, values: np.ndarray) -> str:
    """Write ``(H, W)`` uint8, and return its path in the folder."""
    path = folder / kind / f"{name}.png"
    path.parent.mkdir(exist_ok=True)
    save_png(Image.fromarray(values), path)
    return path.relative_to(folder).as_posix()


def _write_image(folder: Path, capture: Capture, frame: CaptureFrame) -> str:
    """Copy the image, or write it as PNG if undistorted, rotated or from a video."""
    of_camera = frame.index is None and frame.camera.lens is None and frame.image.suffix.lower() not in UNREAD
    if of_camera and (frame.as_stored or not is_reoriented(frame.image)):
        path = f"images/{frame.name}{frame.image.suffix.lower()}"
        with atomic_path(folder / path) as temporary:
            shutil.copyfile(frame.image, temporary)
        return path
    path = f"images/{frame.name}.png"
    save_png(plotting.as_rgb_image(capture.image(frame.name)), folder / path)
    return path


def _write_units(folder: Path, name: str, units: np.ndarray) -> str:
    """Write a map ``(H, W)`` in ``DEPTH_UNIT``, 0 where unknown, as integers if precise enough."""
    known = units[units > 0]
    whole = not known.size or (known.max() <= MAX_16_BITS and np.median(known) >= MIN_UNITS)
    path = f"depths/{name}{'.png' if whole else '.npy'}"
    if whole:
        save_png(Image.fromarray(np.rint(units).astype(np.uint16)), folder / path)
    else:
        write_depth_npy(folder / path, units)
    return path
