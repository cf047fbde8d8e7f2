"""Files in, files out: calibrations, images, depth maps, point clouds.

Hop: what lies on disk -> ``Rig``, arrays; arrays -> what lies on disk, whole or not at all.
Paper: S5.1 (the layouts of the data sets).
"""

from geodiff_plugin.formats.atomic import atomic_path
from geodiff_plugin.formats.depth import (
    read_depth_mm_png,
    read_disparity_kitti_png,
    read_pfm,
    write_depth_mm_png,
    write_depth_npy,
    write_pfm,
)
from geodiff_plugin.formats.files import check_file, read_text
from geodiff_plugin.formats.images import MIN_SIDE, as_image_01, read_image
from geodiff_plugin.formats.matrices import read_matrix
from geodiff_plugin.formats.pointcloud import flying_points, write_ply
from geodiff_plugin.formats.points import read_points
from geodiff_plugin.formats.reading import CALIBRATION_FORMATS, read_calibration
from geodiff_plugin.formats.rigs import rig_from_parameters

__all__ = [
    "CALIBRATION_FORMATS",
    "MIN_SIDE",
    "as_image_01",
    "atomic_path",
    "check_file",
    "flying_points",
    "read_calibration",
    "read_depth_mm_png",
    "read_disparity_kitti_png",
    "read_image",
    "read_matrix",
    "read_pfm",
    "read_points",
    "read_text",
    "rig_from_parameters",
    "write_depth_mm_png",
    "write_depth_npy",
    "write_pfm",
    "write_ply",
]
