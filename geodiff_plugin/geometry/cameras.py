"""How K follows an image that is resized, and what counts as a rotation and as a rectified pair."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

#: Two cameras count as rectified to a milliradian, and to a baseline that is sideways to 1 %.
ANGLE_TOLERANCE, SIDEWAYS_TOLERANCE = 1e-3, 0.01
#: ``(4, 4)``, from a camera's frame with y down and z forward to one with y up and z backward, and back.
#: OpenGL, Blender, NeRF and glTF use the latter. kornia's ``camtoworld_graphics_to_vision_4x4`` turns the
#: axes of a pose in the world; a relative pose needs both sides.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def image_size(image: torch.Tensor) -> tuple[int, int]:
    """``(H, W)`` of an image or a map ``(..., H, W)``."""
    return image.shape[-2], image.shape[-1]


def resize_intrinsics(K: torch.Tensor, size_from: tuple[int, int], size_to: tuple[int, int]) -> torch.Tensor:
    """``K (B, 3, 3)`` after its image is resized between two ``(H, W)``, with the half-pixel shift.

    Per axis; kornia's is without the shift.

    Convention:
        An integer is a pixel centre, so an image keeps its outer edges at -0.5 and ``W - 0.5``:
        ``cx = 319.5`` of 640 columns becomes 159.5 of 320.
    """
    scale = K.new_tensor([size_to[1] / size_from[1], size_to[0] / size_from[0], 1.0])
    half = K.new_tensor([0.5, 0.5, 0.0])
    resized = K * scale[:, None]
    centre = (K[:, :, 2] + half) * scale - half
    return torch.cat([resized[:, :, :2], centre[:, :, None]], dim=2)


def resize_image(
    image_01: torch.Tensor, K: torch.Tensor, size: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """An image ``(C, H, W)`` at another ``size`` (antialiased), and the ``K (3, 3)`` that belongs to it."""
    before = image_size(image_01)
    if before == size:
        return image_01, K
    resized = F.interpolate(image_01[None], size, mode="bilinear", align_corners=False, antialias=True)[0]
    return resized, resize_intrinsics(K[None], before, size)[0]


def nearest_rotation(matrix: torch.Tensor) -> torch.Tensor:
    """The proper rotation nearest to a matrix ``(..., 3, 3)`` (orthogonal Procrustes)."""
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.ones_like(matrix[..., 0])
    sign[..., 2] = torch.linalg.det(u @ vh).sign()
    return (u * sign[..., None, :]) @ vh


def is_rectified(
    K_left: torch.Tensor, K_right: torch.Tensor, T_right_from_left: torch.Tensor
) -> torch.Tensor:
    """Whether disparity along rows says everything, ``(...)`` bool.

    The rotation is the identity to 1e-3 an entry, ``|t_y|`` and ``|t_z|`` are below 1 % of ``|t_x|``, f
    agrees to 0.1 %, skew and cy to 0.1 % of f; cx may differ.

    Args:
        K_left: ``(..., 3, 3)`` float, pixels.
        K_right: ``(..., 3, 3)``, pixels, at the same number of pixels per radian.
        T_right_from_left: ``(..., 4, 4)``.
    """
    identity = torch.eye(3, dtype=T_right_from_left.dtype, device=T_right_from_left.device)
    turned = (T_right_from_left[..., :3, :3] - identity).abs().amax((-2, -1))
    t = T_right_from_left[..., :3, 3].abs()
    uneven = (K_left - K_right).abs()[..., [0, 0, 1, 1], [0, 1, 1, 2]].amax(-1)
    sideways = t[..., 1:].amax(-1) < SIDEWAYS_TOLERANCE * t[..., 0]
    return (turned <= ANGLE_TOLERANCE) & sideways & (uneven <= ANGLE_TOLERANCE * K_left[..., 1, 1])
