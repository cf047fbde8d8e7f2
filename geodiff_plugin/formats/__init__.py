"""File formats: calibrations, images, depth maps, point clouds (S5.1, the layouts of the data sets)."""

from __future__ import annotations

import importlib
from typing import Any

#: Name -> module, imported on first use: some of them need torch, and a file can be looked at without.
_MODULE_OF = {
    "CALIBRATION_FORMATS": "reading",
    "Cloud": "clouds",
    "MIN_SIDE": "images",
    "as_image_01": "images",
    "atomic_path": "out",
    "check_file": "files",
    "depth_mm": "depth",
    "flying_points": "clouds",
    "make_cloud": "clouds",
    "picture_size": "images",
    "read_calibration": "reading",
    "read_depth_png": "depth",
    "read_image": "images",
    "read_matrix": "files",
    "read_pfm": "depth",
    "read_points": "depth",
    "read_text": "files",
    "rig_from_parameters": "rigs",
    "write_colmap": "sfm",
    "write_depth_mm": "depth",
    "write_depth_npy": "depth",
    "write_glb": "clouds",
    "write_pfm": "depth",
    "write_ply": "clouds",
}

__all__ = sorted(_MODULE_OF)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value
