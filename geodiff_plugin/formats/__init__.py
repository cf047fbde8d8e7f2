"""File formats: calibrations, images, depth maps, point clouds (S5.1, the layouts of the data sets)."""

from __future__ import annotations

import importlib
from typing import Any

#: What other programs use, by module; imported on first use, since some of them need torch.
_NAMES = {
    "clouds": ("Cloud", "flying_points", "make_cloud", "make_mesh", "write_glb", "write_ply"),
    "colmap": ("write_colmap",),
    "depth": ("read_depth_png", "write_depth_mm", "write_depth_npy", "write_pfm"),
    "files": ("check_file", "read_matrix", "read_text"),
    "images": ("as_image_01", "picture_size", "read_image"),
    "lidar": ("read_lidar",),
    "maps": ("read_pfm",),
    "out": ("atomic_path",),
    "points": ("read_points",),
    "reading": ("CALIBRATION_FORMATS", "read_calibration"),
    "rigs": ("rig_from_parameters",),
}

__all__ = sorted(name for names in _NAMES.values() for name in names)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    module = next((module for module, names in _NAMES.items() if name in names), None)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)
