"""Defines ``Camera`` (intrinsics, size and lens of a pinhole camera) and ``View`` (an image with its pose).

This module contains all changes of K, all projections except of a whole left image (``geometry``), and
the update of a z-buffer.

Convention:
    A camera's frame has x right, y down and z forward. Integer pixel coordinates are pixel centres, the first
    one at (0, 0), so an image spans -0.5 to ``width - 0.5``. ``K`` belongs to the pixels of its image: code
    that resizes, crops or pads an image takes the new K from the camera.

Layer 0: imports only helpers without a layer of their own; imported by all higher layers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.signals import keeping_sigterm

#: ``(width, height)``, pixels.
Size = tuple[int, int]
#: ``(left, top, right, bottom)``, pixels; right column and bottom row are excluded.
Box = tuple[int, int, int, int]
Numbers = TypeVar("Numbers", np.ndarray, Tensor)

#: Distance to the camera's plane, in units of the points, below which a point counts as behind it.
NEAREST = 1e-6
#: Pixel coordinate of a point behind the camera: finite, and outside any image.
BEHIND_CAMERA_PX = -1e6
#: Maximum angle between two cameras of a rectified pair, radians.
ANGLE_TOLERANCE = 1e-3
#: Maximum relative deviation of a rectified pair's baseline from the sideways direction.
SIDEWAYS_TOLERANCE = 0.01
#: Maximum reprojection error of a ray from OpenCV's undistortion, pixels.
LENS_TOLERANCE_PX = 0.01
#: Models of ``Distortion`` that OpenCV computes; pycolmap computes all others.
OPENCV_LENSES = ("opencv", "fisheye")
#: A resized pixel is valid if valid pixels make up at least this fraction of it.
ALL_VALID = 0.999


def _entries(K: Numbers) -> tuple[Numbers, ...]:
    """Return ``fx, skew, cx, fy, cy`` of ``K (..., 3, 3)``, ``(...)`` each."""
    return tuple(K[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))


def rays_of_pixels(K: Numbers, u: Numbers, v: Numbers) -> tuple[Numbers, Numbers]:
    """Return ``x`` and ``y`` at z = 1 of rays through columns ``u`` and rows ``v``, for ``K (..., 3, 3)``.

    Shapes broadcast; ``y`` does not depend on ``u``. Works for NumPy and, differentiably, for torch.
    """
    fx, skew, cx, fy, cy = _entries(K)
    y = (v - cy) / fy
    return (u - cx) / fx - skew / fx * y, y


def pixels_of_rays(K: Numbers, x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Return columns and rows of rays in a camera ``K (..., 3, 3)``; the inverse of ``rays_of_pixels``."""
    fx, skew, cx, fy, cy = _entries(K)
    return fx * x + skew * y + cx, fy * y + cy


def joined(*coordinates: np.ndarray) -> np.ndarray:
    """Stack n arrays ``(...)`` to ``(..., n)``, each contiguous in memory, which is faster."""
    return np.moveaxis(np.stack(coordinates), 0, -1)


@dataclass(frozen=True, eq=False)
class Distortion:
    """Lens distortion of one camera: ``coefficients`` in OpenCV's order.

    ``model`` is ``"opencv"`` (k1, k2, p1, p2, k3 and so on), ``"fisheye"`` (k1 to k4), or the name of a
    COLMAP model that OpenCV lacks, such as ``"FOV"``, with its coefficients after cx and cy.
    """

    model: str
    coefficients: np.ndarray


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera; computations use the dtype of K.

    Attributes:
        K: ``(3, 3)`` float64, pixels, upper triangular.
        size: ``(width, height)`` of the image of K; ``None`` if unknown.
        lens: its distortion, which ``rays`` and ``project`` account for; ``None`` for none.
    """

    K: np.ndarray
    size: Size | None = None
    lens: Distortion | None = None

    def rays(self, px: np.ndarray) -> np.ndarray:
        """Compute rays ``(..., 3)`` with z = 1 through pixels ``(..., 2)``; NaN if the lens has none."""
        px = self.undistorted_px(px)
        x, y = rays_of_pixels(self.K, px[..., 0], px[..., 1])
        return joined(x, y, np.ones_like(x))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points ``(..., 3)`` in the camera's frame to pixels ``(..., 2)`` and depth ``(...)``.

        Points at or behind the camera (z <= ``NEAREST``) get pixels outside any image.
        """
        z = points[..., 2]
        behind = ~(z > NEAREST)
        flat = points[..., :2] / np.where(behind, 1.0, z)[..., None]
        if self.lens is None:
            px = joined(*pixels_of_rays(self.K, flat[..., 0], flat[..., 1]))
        else:
            px = _distort(flat, self.K, self.lens)
        px[behind] = BEHIND_CAMERA_PX
        return px, z

    def undistorted_px(self, px: np.ndarray) -> np.ndarray:
        """Undistort pixels ``(..., 2)``; NaN if there is no ray."""
        return px if self.lens is None else _undistort(px, self.K, self.lens)

    def unproject(self, depth: np.ndarray) -> np.ndarray:
        """Unproject a map ``(H, W)`` of depth along z to ``(H, W, 3)`` in the camera's frame (Eq. 9)."""
        height, width = depth.shape
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        return self.rays(joined(u, v)) * depth[..., None]

    @property
    def known_size(self) -> Size:
        """``size`` of a camera that has one."""
        assert self.size is not None
        return self.size

    def contains(self, px: np.ndarray) -> np.ndarray:
        """Return whether pixels ``(..., 2)`` are in the image, which extends half a pixel beyond centres."""
        (width, height), (u, v) = self.known_size, np.moveaxis(px, -1, 0)
        return (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)

    def resized(self, size: Size) -> Self:
        """Return the camera after resizing its whole image, with a factor per axis.

        The image keeps its outer edges at -0.5 and ``width - 0.5``: ``cx = 319.5`` of 640 columns becomes
        159.5 of 320. A lens distorts rays and is therefore unchanged.
        """
        width, height = self.known_size
        if size == (width, height):
            return self  # bit for bit
        scale = np.array([size[0] / width, size[1] / height, 1.0], self.K.dtype)
        half = np.array([0.5, 0.5, 0.0], self.K.dtype)
        K = self.K * scale[:, None]
        K[:, 2] = (self.K[:, 2] + half) * scale - half
        return replace(self, K=K, size=size)

    def single(self) -> Self:
        """Convert to float32, so that the host decides with the same numbers that the device uses."""
        return replace(self, K=self.K.astype(np.float32))

    def cropped(self, box: Box) -> Self:
        """Return the camera of a part of its image; a box beyond the image pads it."""
        left, top, right, bottom = box
        K = self.K.copy()
        K[:2, 2] -= left, top
        return replace(self, K=K, size=(right - left, bottom - top))


@dataclass(frozen=True, eq=False)
class PosedCamera(Camera):
    """A camera of known image size with its pose in a world, by default the left camera's frame.

    Attributes:
        E: ``(4, 4)`` float64, camera-to-world.
    """

    size: Size
    E: np.ndarray = field(kw_only=True)

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Transform points ``(..., 3)`` from the camera's frame to the world."""
        return points @ self.E[:3, :3].T + self.E[:3, 3]

    def from_world(self, points: np.ndarray) -> np.ndarray:
        """Transform points ``(..., 3)`` from the world to the camera's frame."""
        return (points - self.E[:3, 3]) @ self.E[:3, :3]


class View(NamedTuple):
    """An image with its camera and pose; a left view has the identity pose."""

    image_01: Tensor  # (C, H, W) float32 in [0, 1]; C = 3, or 1 for grey
    camera: Camera
    T_right_from_left: np.ndarray  # (4, 4) metres, maps points from the left view's frame to this view's
    valid: Tensor | None = None  # (H, W) bool, where the image shows the scene; None for everywhere

    @classmethod
    def single(
        cls, image_01: Tensor, camera: Camera, T_right_from_left: np.ndarray, valid: Tensor | None = None
    ) -> View:
        """Create a view with a camera of the image's size and a pose, both float32."""
        sized = replace(camera, size=(image_01.shape[-1], image_01.shape[-2]))
        return cls(image_01, sized.single(), T_right_from_left.astype(np.float32), valid)

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the image."""
        return self.image_01.shape[-2], self.image_01.shape[-1]

    def resized(self, size: tuple[int, int]) -> View:
        """Resize the view to ``(H, W)``, antialiased; returns the same object at its own size."""
        if size == self.size:
            return self
        image = F.interpolate(
            self.image_01[None], size, mode="bilinear", align_corners=False, antialias=True
        )[0]
        valid = None if self.valid is None else resized_mask(self.valid, size)
        return self._replace(image_01=image, camera=self.camera.resized(size[::-1]), valid=valid)

    def as_fine_as(self, left: Camera) -> View:
        """Downscale the view to at most the left camera's pixels per radian.

        Then neither image aliases in the other. Each axis has its own factor: rounding to whole pixels
        changes them differently, and a rectified pair must stay rectified.
        """
        columns, rows, _ = np.minimum(left.K.diagonal() / self.camera.K.diagonal(), 1.0).tolist()
        return self.resized(scaled_size(self.size, rows, columns))


class PosedViews(NamedTuple):
    """A left view and the right views compared with it; without right views there are known points only.

    Images are on the device of the call; cameras and poses are on the CPU, where decisions are made.
    """

    left: View
    rights: tuple[View, ...]

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the left image."""
        return self.left.size


def resized_mask(valid: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize valid pixels ``(H, W)`` bool to another size; a pixel with an invalid part is invalid."""
    covered = F.interpolate(
        valid[None, None].float(), size, mode="bilinear", align_corners=False, antialias=True
    )
    return covered[0, 0] > ALL_VALID


def valid_pixels(views: Sequence[View]) -> Tensor | None:
    """Stack the valid pixels of views of one size, ``(B, 1, H, W)`` bool; ``None`` if all are valid."""
    if all(view.valid is None for view in views):
        return None
    masks = [
        torch.ones(view.size, dtype=torch.bool, device=view.image_01.device)
        if view.valid is None
        else view.valid.to(view.image_01.device)
        for view in views
    ]
    return torch.stack(masks)[:, None]


def eroded(valid: Tensor, radius: int) -> Tensor:
    """Return the pixels ``(H, W)`` bool whose window of this half width contains only valid pixels."""
    invalid = (~valid)[None, None].float()
    return F.max_pool2d(invalid, 2 * radius + 1, 1, radius)[0, 0] == 0


def scaled_size(size: tuple[int, int], rows: float, columns: float) -> tuple[int, int]:
    """Scale a size ``(H, W)`` by a factor per axis, to at least one pixel."""
    return max(1, round(size[0] * rows)), max(1, round(size[1] * columns))


def field_of_view_deg(width: int, fx: float) -> float:
    """Return the horizontal field of view of a pinhole camera, degrees; width and focal length in pixels."""
    return 2.0 * math.degrees(math.atan(0.5 * width / fx))


def size_within(size: tuple[int, int], max_pixels: int) -> tuple[int, int]:
    """Scale a size ``(H, W)`` down to at most ``max_pixels``, with one factor for both axes."""
    factor = min(1.0, math.sqrt(max_pixels / (size[0] * size[1])))
    return scaled_size(size, factor, factor)


def resized_px(px: np.ndarray, before: Size, after: Size) -> np.ndarray:
    """Return the positions of pixels ``(..., 2)`` after an image is resized."""
    return (px + 0.5) * (np.array(after) / before) - 0.5


def keep_nearest(buffer: Tensor, cells: Tensor, z: Tensor) -> None:
    """Update a z-buffer ``(..., P)`` in place with points that are nearer.

    Args:
        buffer: nearest depth of each cell so far; initially infinity.
        cells: ``(..., N)`` int64, cell of each point.
        z: ``(..., N)`` depth of each point.
    """
    buffer.scatter_reduce_(-1, cells, z, "amin")


def is_rectified(left: Camera, right: Camera, T_right_from_left: np.ndarray) -> bool:
    """Return whether two cameras are rectified: points differ only along rows between their images.

    The rotation is the identity to 1e-3 per entry, ``|t_y|`` and ``|t_z|`` are below 1 % of ``|t_x|``, f
    agrees to 0.1 %, skew and cy to 0.1 % of f; cx may differ. Both K have the same pixels per radian.
    """
    T = T_right_from_left
    rotated = np.abs(T[:3, :3] - np.eye(3, dtype=T.dtype)).max()
    t = np.abs(T[:3, 3])
    uneven = np.abs(left.K - right.K)[[0, 0, 1, 1], [0, 1, 1, 2]].max()
    sideways = t[1:].max() < SIDEWAYS_TOLERANCE * t[0]
    return bool(rotated <= ANGLE_TOLERANCE and sideways and uneven <= ANGLE_TOLERANCE * left.K[1, 1])


def _undistort(px: np.ndarray, K: np.ndarray, lens: Distortion) -> np.ndarray:
    """Undistort pixels ``(..., 2)`` as in ``Camera.undistorted_px``."""
    distorted = np.asarray(px, np.float64).reshape(-1, 2)
    K = np.asarray(K, np.float64)
    if not len(distorted):
        return distorted.reshape(px.shape)
    undistort = _undistort_by_opencv if lens.model in OPENCV_LENSES else _undistort_by_colmap
    return undistort(distorted, K, lens).reshape(px.shape)


def _undistort_by_opencv(distorted: np.ndarray, K: np.ndarray, lens: Distortion) -> np.ndarray:
    """Undistort pixels ``(N, 2)`` with OpenCV, whose search can return a ray of another pixel."""
    import cv2

    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)
    coefficients = np.asarray(lens.coefficients, np.float64)
    points = distorted[:, None]
    if lens.model == "fisheye":
        corrected = cv2.fisheye.undistortPoints(points, K, coefficients, R=np.eye(3), P=K, criteria=until)
    else:
        corrected = cv2.undistortImagePoints(points, K, coefficients, None, until)
    rays = np.stack(rays_of_pixels(K, corrected[:, 0, 0], corrected[:, 0, 1]), -1)
    off_px = np.abs(_distort(rays, K, lens) - distorted).max(1, keepdims=True)
    return np.where(off_px < LENS_TOLERANCE_PX, corrected[:, 0], np.nan)


def _undistort_by_colmap(distorted: np.ndarray, K: np.ndarray, lens: Distortion) -> np.ndarray:
    """Undistort pixels ``(N, 2)`` with pycolmap, which returns NaN without a ray."""
    distorted_rays = np.stack(rays_of_pixels(K, distorted[:, 0], distorted[:, 1]), -1)
    rays = _colmap_camera(lens).cam_from_img(distorted_rays)
    return np.stack(pixels_of_rays(K, rays[:, 0], rays[:, 1]), -1)


def _distort(flat: np.ndarray, K: np.ndarray, lens: Distortion) -> np.ndarray:
    """Project rays ``(..., 2)``, x and y at z = 1, to pixels ``(..., 2)`` of the distorted image."""
    rays = np.asarray(flat, np.float64).reshape(-1, 2)
    K = np.asarray(K, np.float64)
    if not len(rays):
        return rays.reshape(flat.shape)
    import cv2

    coefficients = np.asarray(lens.coefficients, np.float64)
    if lens.model == "fisheye":
        px = cv2.fisheye.distortPoints(rays[:, None], K, coefficients)
    elif lens.model == "opencv":
        points = np.c_[rays, np.ones(len(rays))]
        none = np.zeros(3)
        px = cv2.projectPoints(points, none, none, K, coefficients)[0]
    else:
        distorted_rays = _colmap_camera(lens).img_from_cam(np.c_[rays, np.ones(len(rays))])
        px = np.stack(pixels_of_rays(K, distorted_rays[:, 0], distorted_rays[:, 1]), -1)
    return px.reshape(flat.shape)


def _colmap_camera(lens: Distortion) -> Any:
    """Return pycolmap's camera with the identity as K, which distorts and undistorts rays.

    K stays outside, because some models have one focal length, and resized images have different fx and fy.
    """
    with keeping_sigterm():
        import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, lens.model, 1.0, 1, 1)
    focals = [1.0] * len(camera.focal_length_idxs())
    camera.params = [*focals, 0.0, 0.0, *lens.coefficients]
    return camera
