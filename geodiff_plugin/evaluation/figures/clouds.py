"""Drawing of a depth map as a point cloud, seen from another place.

Data flow: depth in metres + colours + K -> points -> picture from a second camera.
Paper: Figure 5 (fig:exp-two-view, point clouds).
"""

from __future__ import annotations

import math

import numpy as np
import torch

from geodiff_plugin.geometry import project, resize_intrinsics, transform, unproject

__all__ = ["orbit", "render_cloud"]

YAW_DEGREES = -25.0
PITCH_DEGREES = 12.0
#: A picture of points is drawn this much smaller than the map that they come from, which closes its holes.
SHRINK = 0.6


def orbit(
    centre_m: float, yaw_degrees: float = YAW_DEGREES, pitch_degrees: float = PITCH_DEGREES
) -> np.ndarray:
    """``T_view_from_left`` of a camera that swings around the point at ``centre_m`` on the optical axis.

    Args:
        centre_m: depth of the point that stays where it is, metres.
        yaw_degrees: turn about the vertical axis; positive moves the camera to the right.
        pitch_degrees: turn about the horizontal axis; positive moves the camera up.

    Returns:
        ``(4, 4)`` float64.
    """
    yaw, pitch = math.radians(yaw_degrees), math.radians(pitch_degrees)
    turn_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    turn_x = np.array(
        [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]]
    )
    T = np.eye(4)
    T[:3, :3] = turn_x @ turn_y
    centre = np.array([0.0, 0.0, centre_m])
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def render_cloud(
    depth_m: np.ndarray, image: np.ndarray, K: np.ndarray, T_view_from_left: np.ndarray
) -> np.ndarray:
    """Points of a depth map from another camera, the nearest one in every pixel.

    Args:
        depth_m: ``(H, W)`` metres; not finite or not positive has no point.
        image: ``(H, W, 3)`` uint8, colours of the points.
        K: ``(3, 3)`` pixels of both.
        T_view_from_left: ``(4, 4)``.

    Returns:
        ``(H', W', 3)`` uint8, ``SHRINK`` times the size, white where no point lies.
    """
    height, width = depth_m.shape
    size = (round(height * SHRINK), round(width * SHRINK))
    known = np.isfinite(depth_m) & (depth_m > 0)
    z_left = torch.from_numpy(np.where(known, depth_m, 1.0).astype(np.float32))[None, None]
    cameras = (
        torch.from_numpy(K.astype(np.float32))[None],
        torch.from_numpy(T_view_from_left.astype(np.float32)),
    )
    points = transform(unproject(z_left, cameras[0]), cameras[1][None])
    uv, z = project(points, resize_intrinsics(cameras[0], (height, width), size))
    cell = uv.round().long().view(-1, 2)
    inside = (cell >= 0).all(1) & (cell[:, 0] < size[1]) & (cell[:, 1] < size[0])
    keep = inside & torch.from_numpy(known).view(-1)
    target, z = (cell[:, 1] * size[1] + cell[:, 0])[keep], z.view(-1)[keep]
    colours = torch.from_numpy(np.ascontiguousarray(image)).view(-1, 3)[keep]
    # Far to near, and a stable sort: the last point written into a pixel is its nearest one.
    order = torch.argsort(z, descending=True, stable=True).numpy()
    picture = np.full((size[0] * size[1], 3), 255, np.uint8)
    picture[target.numpy()[order]] = colours.numpy()[order]
    return picture.reshape(*size, 3)
