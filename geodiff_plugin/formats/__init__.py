"""File formats: calibrations, images, depth maps, point clouds (S5.1, the layouts of the data sets)."""

from __future__ import annotations

from geodiff_plugin._lazy import importer, modules_of

#: What other programs use, by module; imported on first use, since some of them need torch.
_NAMES_OF = {
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

_MODULE_OF = modules_of(__name__, _NAMES_OF)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)
