"""A capture with depth for trainers of splats and radiance fields: ``transforms.json`` and what it names.

Source: ``nerfstudio/data/dataparsers/nerfstudio_dataparser.py`` and ``data/utils/data_utils.py`` of
nerfstudio-project/nerfstudio: depth is ``depth_file_path`` times ``depth_unit_scale_factor``, 0.001 unless
told otherwise, in lengths of the poses; 0 is unknown; pixels of masks are used where they are not 0.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin import plotting
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.clouds import Cloud, write_vertices
from geodiff_plugin.formats.files import is_turned, save_png
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.formats.out import atomic_path, write_text
from geodiff_plugin.formats.transforms import NERF_CAMERA, TransformsFile, named_in_transforms
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.types import DepthFrame

#: A unit of the depth maps in lengths of the poses: what nerfstudio takes without being told.
DEPTH_UNIT = 1e-3
#: The largest value that fits 16 bits.
LARGEST = 65535
#: Whole units are fine enough for a map whose median depth is at least so many of them.
FEWEST_UNITS = 500
#: Images that trainers do not read.
UNREAD = (".heic", ".heif")
#: Points from which a trainer starts, at most.
MOST_POINTS = 200_000
#: Lists of the original file that name images of a split.
SPLITS = ("train_filenames", "val_filenames", "test_filenames")
#: Entries of the original file that hold no longer: lengths are those before ``applied_scale``, and the
#: points and depth maps are ours.
REPLACED = ("applied_scale", "ply_file_path", "integer_depth_scale", "depth_unit_scale_factor", "is_fisheye")
REPLACED_OF_FRAME = ("depth_path", "applied_scale", "integer_depth_scale", "is_fisheye")


@dataclass(frozen=True, eq=False)
class SplatFrame:
    """One frame of the export: its depth as agreed, and which pixels are sure enough to be used."""

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
    """Write ``transforms.json``, images, depth maps, masks of their confidence, and points of a capture.

    Poses are those of the solve, which the depth fits, in the frame and the lengths that the capture came
    with; so are the depth maps, in thousandths (16-bit PNG, or float32 ``.npy`` where that is too coarse or
    too short). What ``original``, the file of the capture, says beside cameras and depth is kept. Images with
    lens distortion are written without it.
    """
    for name in ("images", "depths", "depth_masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    entries = [_write_frame(folder, capture, load(name), original) for name in names]
    shared = {key: entries[0][key] for key in NERF_CAMERA if len({entry[key] for entry in entries}) == 1}
    kept = {} if original is None else {k: v for k, v in original.shared.items() if k not in REPLACED}
    renamed = {entry.pop("original_path"): entry["file_path"] for entry in entries}
    for split in SPLITS:
        if isinstance(kept.get(split), list):
            kept[split] = [renamed[path] for path in kept[split] if path in renamed]
    _write_points(folder / "points.ply", capture, cloud.thinned(MOST_POINTS))
    frames = [{key: value for key, value in entry.items() if key not in shared} for entry in entries]
    data = kept | {
        "camera_model": "OPENCV",
        **shared,
        "depth_unit_scale_factor": DEPTH_UNIT,
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    if original is None:  # else nerfstudio takes the poses for those that it made of COLMAP's
        data["applied_transform"] = np.eye(4)[:3].tolist()
    if capture.unit == "m":
        data["metres_per_unit"] = capture.metres_per_unit
    write_text(folder / "transforms.json", json.dumps(data, indent=2) + "\n")


def _write_points(path: Path, capture: Capture, cloud: Cloud) -> None:
    """Write a cloud in metres with the lengths that the capture came with."""
    points, names = cloud.points_m / capture.metres_per_unit, (*"xyz", "red", "green", "blue")
    write_vertices(path, "frame of transforms.json", None, len(points), names, [(points, cloud.colours)])


def _write_frame(
    folder: Path, capture: Capture, found: SplatFrame, original: TransformsFile | None
) -> dict[str, Any]:
    """The files of a frame, and its entries; ``original_path`` is what the original calls its image."""
    frame, depth = capture.frame(found.depth.name), found.depth
    entries = {} if original is None else dict(original.frames.get(frame.image, {}))
    named = entries.get("file_path", frame.name)
    entries = {key: value for key, value in entries.items() if key not in (*REPLACED_OF_FRAME, *NERF_CAMERA)}
    if "mask_path" in entries:
        mask = named_in_transforms(original, entries["mask_path"]) if frame.lens is None else None
        entries.pop("mask_path")
        if mask is not None:
            entries["mask_path"] = Path(os.path.relpath(mask, folder)).as_posix()
    units = np.where(found.sure, depth.depth / (DEPTH_UNIT * capture.metres_per_unit), 0.0)
    E = depth.E.copy()
    E[:3, 3] /= capture.metres_per_unit
    height, width = depth.depth.shape
    mask_of_depth = np.where(found.sure, np.rint(255 * depth.confidence.clip(1 / 255, 1)), 0).astype(np.uint8)
    mask_path = f"depth_masks/{frame.name}.png"
    with atomic_path(folder / mask_path) as temporary:
        save_png(Image.fromarray(mask_of_depth), temporary)
    return entries | {
        "original_path": named,
        "file_path": _write_image(folder, capture, frame),
        "depth_file_path": _write_units(folder, frame.name, units),
        "depth_mask_path": mask_path,
        "transform_matrix": (E @ OPENGL_FROM_OPENCV).tolist(),
        "fl_x": float(depth.K[0, 0]),
        "fl_y": float(depth.K[1, 1]),
        "cx": float(depth.K[0, 2] + 0.5),
        "cy": float(depth.K[1, 2] + 0.5),
        "w": width,
        "h": height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def _write_image(folder: Path, capture: Capture, frame: CaptureFrame) -> str:
    """The image as it is where it may stay so, else without its distortion, turn or video, as PNG."""
    of_camera = frame.index is None and frame.lens is None and frame.image.suffix.lower() not in UNREAD
    if of_camera and (frame.as_stored or not is_turned(frame.image)):
        path = f"images/{frame.name}{frame.image.suffix.lower()}"
        with atomic_path(folder / path) as temporary:
            shutil.copyfile(frame.image, temporary)
        return path
    path = f"images/{frame.name}.png"
    with atomic_path(folder / path) as temporary:
        save_png(plotting.as_picture(capture.image(frame.name)), temporary)
    return path


def _write_units(folder: Path, name: str, units: np.ndarray) -> str:
    """A map ``(H, W)`` in ``DEPTH_UNIT``, 0 where unknown, as whole numbers where those do."""
    known = units[units > 0]
    whole = not known.size or (known.max() <= LARGEST and np.median(known) >= FEWEST_UNITS)
    path = f"depths/{name}{'.png' if whole else '.npy'}"
    with atomic_path(folder / path) as temporary:
        if whole:
            save_png(Image.fromarray(np.rint(units).astype(np.uint16)), temporary)
        else:
            with open(temporary, "wb") as file:
                np.save(file, units.astype(np.float32), allow_pickle=False)
    return path
