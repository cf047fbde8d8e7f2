"""Pinhole cameras and rigid transforms: how K follows an image, how two poses become one transform.

Data flow: K and camera-to-world poses as given -> K of the grid in use and ``T_right_from_left``.
Paper: S3.3, S7.2 Eq. 25 (eq:forward-warp_supp).
"""

from __future__ import annotations

import numpy as np
import torch

__all__ = [
    "OPENGL_FROM_OPENCV",
    "invert_rigid",
    "is_rectified",
    "nearest_rotation",
    "pad_intrinsics",
    "relative_pose",
    "resize_intrinsics",
]

#: Two cameras count as rectified to a milliradian, and to a baseline that is sideways to 1 %.
ANGLE_TOLERANCE, SIDEWAYS_TOLERANCE = 1e-3, 0.01
#: ``(4, 4)``, from a camera's frame with y down and z forward to one with y up and z backward, and back.
#: OpenGL, Blender, NeRF and glTF use the latter.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def image_size(image: torch.Tensor) -> tuple[int, int]:
    """``(H, W)`` of an image or a map ``(..., H, W)``."""
    return image.shape[-2], image.shape[-1]


def resize_intrinsics(K: torch.Tensor, size_from: tuple[int, int], size_to: tuple[int, int]) -> torch.Tensor:
    """Intrinsics after the image is resized, per axis and with the half-pixel shift.

    Args:
        K: ``(B, 3, 3)`` float, pixels of the image of ``size_from``.
        size_from: ``(H, W)`` that ``K`` is for.
        size_to: ``(H, W)`` after resizing.

    Returns:
        ``(B, 3, 3)`` of ``K``'s dtype, pixels of the resized image.

    Convention:
        An integer is a pixel centre, so an image keeps its outer edges at -0.5 and ``W - 0.5``:
        ``cx = 319.5`` of 640 columns becomes 159.5 of 320.
    """
    scale = K.new_tensor([size_to[1] / size_from[1], size_to[0] / size_from[0], 1.0])
    half = K.new_tensor([0.5, 0.5, 0.0])
    resized = K * scale[:, None]
    centre = (K[:, :, 2] + half) * scale - half
    return torch.cat([resized[:, :, :2], centre[:, :, None]], dim=2)


def pad_intrinsics(K: torch.Tensor, left: int = 0, top: int = 0) -> torch.Tensor:
    """Intrinsics after columns and rows are added before the first ones (negative values crop).

    Args:
        K: ``(B, 3, 3)`` float, pixels.
        left: columns added on the left.
        top: rows added at the top.

    Returns:
        ``(B, 3, 3)`` of ``K``'s dtype.

    Convention:
        Padding on the right and at the bottom, as Marigold does, leaves ``K`` as it is;
        4 columns on the left move ``cx`` by +4.
    """
    shift = K.new_zeros(3, 3)
    shift[0, 2], shift[1, 2] = left, top
    return K + shift


def invert_rigid(T: torch.Tensor) -> torch.Tensor:
    """Inverse of rigid transforms, from the transposed rotation.

    Args:
        T: ``(..., 4, 4)`` float, ``T_a_from_b`` with an orthonormal rotation and last row (0, 0, 0, 1).

    Returns:
        ``(..., 4, 4)``, ``T_b_from_a``; differentiable.
    """
    rotation = T[..., :3, :3].transpose(-1, -2)
    translation = -(rotation @ T[..., :3, 3:])
    return torch.cat([torch.cat([rotation, translation], dim=-1), T[..., 3:, :]], dim=-2)


def relative_pose(E_left: torch.Tensor, E_right: torch.Tensor) -> torch.Tensor:
    """The transform of points from the left camera's frame to the right one's.

    Args:
        E_left: ``(B, 4, 4)`` float, camera-to-world pose of the left camera, metres.
        E_right: ``(B, 4, 4)``, the same of the right camera.

    Returns:
        ``T_right_from_left = inv(E_right) @ E_left``, ``(B, 4, 4)``; differentiable.

    Convention:
        A right camera 0.12 m to the right of the left one (``E_right[0, 3] = 0.12``, ``E_left = I``)
        gives ``T_right_from_left[0, 3] = -0.12``.

    Source: Eq. 25 (eq:forward-warp_supp). Eq. 26 (eq:back-warp_supp) prints ``E2 E1^-1``, which holds
        for world-to-camera poses only (docs/reference/paper-map.md, E1).
    """
    return invert_rigid(E_right) @ E_left


def nearest_rotation(matrix: torch.Tensor) -> torch.Tensor:
    """The proper rotation nearest to a matrix in the Frobenius norm.

    Args:
        matrix: ``(..., 3, 3)`` float, close to a rotation.

    Returns:
        ``(..., 3, 3)``, orthonormal with determinant +1.

    Source: orthogonal Procrustes by the singular value decomposition.
    """
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.ones_like(matrix[..., 0])
    sign[..., 2] = torch.linalg.det(u @ vh).sign()
    return (u * sign[..., None, :]) @ vh


def is_rectified(
    K_left: torch.Tensor, K_right: torch.Tensor, T_right_from_left: torch.Tensor
) -> torch.Tensor:
    """Whether disparity along rows says everything: R = I, a sideways baseline, equal f, skew, cy.

    Args:
        K_left: ``(..., 3, 3)`` float, pixels.
        K_right: ``(..., 3, 3)``, pixels, at the same number of pixels per radian; cx may differ.
        T_right_from_left: ``(..., 4, 4)``, metres.

    Returns:
        ``(...)`` bool: the rotation is the identity to 1e-3 an entry, ``|t_y|`` and ``|t_z|`` are below 1 %
        of ``|t_x|``, f agrees to 0.1 %, skew and cy to 0.1 % of f.
    """
    identity = torch.eye(3, dtype=T_right_from_left.dtype, device=T_right_from_left.device)
    turned = (T_right_from_left[..., :3, :3] - identity).abs().amax((-2, -1))
    t = T_right_from_left[..., :3, 3].abs()
    focal = K_left[..., 1, 1]
    apart = (K_left - K_right).abs()
    uneven = torch.stack([apart[..., 0, 0], apart[..., 0, 1], apart[..., 1, 1], apart[..., 1, 2]], -1).amax(
        -1
    )
    sideways = t[..., 1:].amax(-1) < SIDEWAYS_TOLERANCE * t[..., 0]
    return (turned <= ANGLE_TOLERANCE) & sideways & (uneven <= ANGLE_TOLERANCE * focal)
