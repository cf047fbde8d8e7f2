"""Two pinhole cameras: intrinsics, projection, backward warping (S3.3, S7.2).

Rigid transforms are kornia's (``kornia.geometry.linalg``). Where kornia has something else of it as well, a
comment says why ours is used.
"""

from geodiff_plugin.geometry.cameras import (
    OPENGL_FROM_OPENCV,
    image_size,
    is_rectified,
    nearest_rotation,
    resize_image,
    resize_intrinsics,
)
from geodiff_plugin.geometry.projection import (
    NEAREST_M,
    PlaneRays,
    plane_rays,
    project,
    project_rays,
    transform,
    unproject,
)
from geodiff_plugin.geometry.warping import Warped, hidden_in_right, sample_at, warp_right_to_left

__all__ = ["NEAREST_M", "OPENGL_FROM_OPENCV", "PlaneRays", "Warped", "hidden_in_right", "image_size"]
__all__ += ["is_rectified", "nearest_rotation", "plane_rays", "project", "project_rays", "resize_image"]
__all__ += ["resize_intrinsics", "sample_at", "transform", "unproject", "warp_right_to_left"]
