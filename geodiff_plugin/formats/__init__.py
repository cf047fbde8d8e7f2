"""Reads and writes file formats, independent of how their content is used.

What belongs here:
    - Calibrations of two cameras, ``read_calibration``. ``calibrations`` is the table of formats and
      ``reading`` applies it. A format in which every camera has a pose is a row of keys (``posed``), named
      matrices are dialects (``named``); other formats are readers (``devices``, ``matlab``, ``ros``,
      ``slam``, ``stereo``). ``rigs`` is the only module that builds a ``Rig``.
    - Captures (posed frames of one moving camera), ``read_capture``. ``captures`` is the table of formats;
      ``layouts`` defines the result of a reader, and reads formats with one camera file per image. Readers
      are in ``datasets``, ``phones``, ``photogrammetry``, ``radiance`` and ``sequences``, and in separate
      modules.
    - ``unread``: formats that are recognised but not supported, with alternatives.
    - Images (``images``), depth maps and points (``maps``, ``depth``, ``points``, ``pcd``, ``lidar``), videos
      and bags (``recordings``), clouds and meshes (``clouds``), and models for other programs (``colmap``,
      ``transforms``).
    - Files themselves: opened with concise errors (``files``), written completely or not at all (``out``).

Layer 2: imports ``cameras``, ``geometry`` and below; every higher package may import the names listed here.

To add a format, write one row, or one reader and one row: in ``CALIBRATION_FORMATS``, ``LAYOUTS``,
``named.DIALECTS`` or the tables of ``unread``. Add a function that writes the format to
``tests/contracts/calibrations.py`` or ``captures.py``; the contract tests iterate over the tables
(docs/how-to/extending.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from geodiff_plugin._internal.lazy import declared, importer

if TYPE_CHECKING:  # public names; imported on first use at run time, because some need torch
    from geodiff_plugin.formats.calibrations import CALIBRATION_FORMATS as CALIBRATION_FORMATS
    from geodiff_plugin.formats.captures import read_capture as read_capture
    from geodiff_plugin.formats.clouds import Cloud as Cloud
    from geodiff_plugin.formats.clouds import flying_points as flying_points
    from geodiff_plugin.formats.clouds import in_8_bits as in_8_bits
    from geodiff_plugin.formats.clouds import make_cloud as make_cloud
    from geodiff_plugin.formats.clouds import make_mesh as make_mesh
    from geodiff_plugin.formats.clouds import write_glb as write_glb
    from geodiff_plugin.formats.clouds import write_ply as write_ply
    from geodiff_plugin.formats.clouds import write_vertices as write_vertices
    from geodiff_plugin.formats.colmap import check_colmap_names as check_colmap_names
    from geodiff_plugin.formats.colmap import write_colmap as write_colmap
    from geodiff_plugin.formats.depth import depth_mm as depth_mm
    from geodiff_plugin.formats.depth import depth_of_disparity as depth_of_disparity
    from geodiff_plugin.formats.depth import disparity_of_depth as disparity_of_depth
    from geodiff_plugin.formats.depth import read_confidence as read_confidence
    from geodiff_plugin.formats.depth import read_depth_png as read_depth_png
    from geodiff_plugin.formats.depth import read_map as read_map
    from geodiff_plugin.formats.depth import read_measured as read_measured
    from geodiff_plugin.formats.depth import sigma_mm as sigma_mm
    from geodiff_plugin.formats.depth import write_depth_mm as write_depth_mm
    from geodiff_plugin.formats.depth import write_depth_npy as write_depth_npy
    from geodiff_plugin.formats.depth import write_pfm as write_pfm
    from geodiff_plugin.formats.depth import write_sigma_mm as write_sigma_mm
    from geodiff_plugin.formats.files import MAP_SUFFIXES as MAP_SUFFIXES
    from geodiff_plugin.formats.files import check_file as check_file
    from geodiff_plugin.formats.files import file_digest as file_digest
    from geodiff_plugin.formats.files import find_map as find_map
    from geodiff_plugin.formats.files import is_reoriented as is_reoriented
    from geodiff_plugin.formats.files import natural_order as natural_order
    from geodiff_plugin.formats.files import open_image as open_image
    from geodiff_plugin.formats.files import posix_path as posix_path
    from geodiff_plugin.formats.files import read_intrinsics as read_intrinsics
    from geodiff_plugin.formats.files import read_matrix as read_matrix
    from geodiff_plugin.formats.files import read_npy as read_npy
    from geodiff_plugin.formats.files import read_text as read_text
    from geodiff_plugin.formats.files import save_png as save_png
    from geodiff_plugin.formats.files import upright_size as upright_size
    from geodiff_plugin.formats.frame_packing import Packing as Packing
    from geodiff_plugin.formats.frame_packing import find_packing as find_packing
    from geodiff_plugin.formats.image_files import MASK_SUFFIXES as MASK_SUFFIXES
    from geodiff_plugin.formats.image_files import find_mask as find_mask
    from geodiff_plugin.formats.images import as_image_01 as as_image_01
    from geodiff_plugin.formats.images import has_alpha as has_alpha
    from geodiff_plugin.formats.images import image_size_of as image_size_of
    from geodiff_plugin.formats.images import in_stored_pixels as in_stored_pixels
    from geodiff_plugin.formats.images import intrinsics_from_exif as intrinsics_from_exif
    from geodiff_plugin.formats.images import intrinsics_from_fov as intrinsics_from_fov
    from geodiff_plugin.formats.images import pages_of_both as pages_of_both
    from geodiff_plugin.formats.images import read_alpha as read_alpha
    from geodiff_plugin.formats.images import read_image as read_image
    from geodiff_plugin.formats.images import split_views as split_views
    from geodiff_plugin.formats.images import warn_of_other_lens as warn_of_other_lens
    from geodiff_plugin.formats.jps import read_jps as read_jps
    from geodiff_plugin.formats.layouts import CaptureFrame as CaptureFrame
    from geodiff_plugin.formats.lenses import distortion_from_text as distortion_from_text
    from geodiff_plugin.formats.lenses import undistorted as undistorted
    from geodiff_plugin.formats.lenses import undistorted_points as undistorted_points
    from geodiff_plugin.formats.lidar import LIDAR_SUFFIX as LIDAR_SUFFIX
    from geodiff_plugin.formats.lidar import read_lidar as read_lidar
    from geodiff_plugin.formats.maps import MAX_16_BITS as MAX_16_BITS
    from geodiff_plugin.formats.maps import MM_PER_METRE as MM_PER_METRE
    from geodiff_plugin.formats.maps import read_pfm as read_pfm
    from geodiff_plugin.formats.out import REPORT as REPORT
    from geodiff_plugin.formats.out import HeldFolder as HeldFolder
    from geodiff_plugin.formats.out import OutFolder as OutFolder
    from geodiff_plugin.formats.out import atomic_path as atomic_path
    from geodiff_plugin.formats.out import check_new as check_new
    from geodiff_plugin.formats.out import check_new_file as check_new_file
    from geodiff_plugin.formats.out import check_out as check_out
    from geodiff_plugin.formats.out import created_folder as created_folder
    from geodiff_plugin.formats.out import files_of_report as files_of_report
    from geodiff_plugin.formats.out import free_folder as free_folder
    from geodiff_plugin.formats.out import lock_file as lock_file
    from geodiff_plugin.formats.out import locked_folder as locked_folder
    from geodiff_plugin.formats.out import raise_unwritable as raise_unwritable
    from geodiff_plugin.formats.out import read_report as read_report
    from geodiff_plugin.formats.out import reason_of as reason_of
    from geodiff_plugin.formats.out import write_text as write_text
    from geodiff_plugin.formats.points import read_points as read_points
    from geodiff_plugin.formats.reading import has_pose_per_image as has_pose_per_image
    from geodiff_plugin.formats.reading import is_as_stored as is_as_stored
    from geodiff_plugin.formats.reading import read_calibration as read_calibration
    from geodiff_plugin.formats.recordings import VIDEOS as VIDEOS
    from geodiff_plugin.formats.recordings import BagFrame as BagFrame
    from geodiff_plugin.formats.recordings import BagReader as BagReader
    from geodiff_plugin.formats.recordings import VideoFacts as VideoFacts
    from geodiff_plugin.formats.recordings import VideoReader as VideoReader
    from geodiff_plugin.formats.recordings import is_bag as is_bag
    from geodiff_plugin.formats.recordings import is_video as is_video
    from geodiff_plugin.formats.recordings import list_pairs as list_pairs
    from geodiff_plugin.formats.recordings import sample_frames as sample_frames
    from geodiff_plugin.formats.recordings import stereo_calibration as stereo_calibration
    from geodiff_plugin.formats.recordings import video_facts as video_facts
    from geodiff_plugin.formats.recordings import write_depth_bag as write_depth_bag
    from geodiff_plugin.formats.rigs import intrinsics as intrinsics
    from geodiff_plugin.formats.rigs import is_distorted as is_distorted
    from geodiff_plugin.formats.rigs import rig_from_parameters as rig_from_parameters
    from geodiff_plugin.formats.rigs import with_baseline as with_baseline
    from geodiff_plugin.formats.synchronization import Offset as Offset
    from geodiff_plugin.formats.synchronization import estimate_offset as estimate_offset
    from geodiff_plugin.formats.synchronization import frame_interval as frame_interval
    from geodiff_plugin.formats.synchronization import pair_frames as pair_frames
    from geodiff_plugin.formats.synchronization import watch as watch
    from geodiff_plugin.formats.target import frame_of_target as frame_of_target
    from geodiff_plugin.formats.target import read_target_camera as read_target_camera
    from geodiff_plugin.formats.transforms import NERF_CAMERA as NERF_CAMERA
    from geodiff_plugin.formats.transforms import TRANSFORMS as TRANSFORMS
    from geodiff_plugin.formats.transforms import TransformsFile as TransformsFile
    from geodiff_plugin.formats.transforms import transforms_of as transforms_of

_MODULE_OF = declared(__name__)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)
