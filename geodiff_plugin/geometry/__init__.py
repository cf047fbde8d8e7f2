"""Two pinhole cameras: intrinsics, rigid transforms, projection, backward warping.

Data flow: depth in metres on the left grid -> right-view pixels -> right image seen from the left.
Paper: S3.3, S7.2.
"""

from geodiff_plugin.geometry.cameras import (
    OPENGL_FROM_OPENCV,
    image_size,
    invert_rigid,
    is_rectified,
    nearest_rotation,
    pad_intrinsics,
    relative_pose,
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

__all__ = [
    "NEAREST_M",
    "OPENGL_FROM_OPENCV",
    "PlaneRays",
    "Warped",
    "hidden_in_right",
    "image_size",
    "invert_rigid",
    "is_rectified",
    "nearest_rotation",
    "pad_intrinsics",
    "plane_rays",
    "project",
    "project_rays",
    "relative_pose",
    "resize_intrinsics",
    "sample_at",
    "transform",
    "unproject",
    "warp_right_to_left",
]
