"""Cameras of photographs without given poses: K from EXIF or a field of view, poses from their matches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._camera_checks import check_intrinsics, check_intrinsics_fit
from geodiff_plugin._checks import bad_type, bad_value, check_number
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.inputs import as_points
from geodiff_plugin.evidence.prepare import cleaned
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.formats.images import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.geometry import image_size, resize_intrinsics, unproject
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.estimate import EstimatedPose, Scale, estimate_poses, find_scale, polished
from geodiff_plugin.pose.solve import depth_spread, undetermined_pose
from geodiff_plugin.pose.tracks import Tracks, coarse_depth, grey_views
from geodiff_plugin.types import CameraView, PosedViews


@dataclass(frozen=True, eq=False)
class EstimatedRig:
    """Cameras of photographs without given poses; tuples after ``Ks`` have one entry per right view."""

    size_left: tuple[int, int]  # (width, height) of the left photograph
    Ks: tuple[np.ndarray, ...]  # (3, 3) each, left one first
    Es: tuple[np.ndarray, ...]  # (4, 4) each, pose in the left camera's frame, in metres or in units
    inliers: tuple[int, ...]  # matches that the pose explains
    parallax_deg: tuple[float, ...]  # median angle between the two rays of a point
    residual_px: tuple[float, ...]  # median distance of the inliers from their epipolar lines
    depth_spread: float | None  # relative, caused by errors of the poses; ``None`` for a rectified pair
    scale: Scale  # where the unit comes from
    notes: tuple[Message, ...]  # what was assumed
    warnings: tuple[Message, ...]


def _cameras(
    photographs: Sequence[Any], images: Sequence[Tensor], K: Any, fov: float | None, cropped: bool
) -> tuple[list[np.ndarray], list[Message]]:
    """K of every photograph, and what was assumed for it."""
    given = list(K) if isinstance(K, (tuple, list)) and np.ndim(K[0]) == 2 else [K] * len(images)
    if len(given) != len(images):
        bad_value("K", f"one matrix, or {len(images)} of them", f"{len(given)}")
    Ks: list[np.ndarray] = []
    notes: list[Message] = []
    for i, (photograph, image, matrix) in enumerate(zip(photographs, images, given, strict=True)):
        name = "the left photograph" if i == 0 else f"right photograph {i}"
        size = (image.shape[-1], image.shape[-2])
        if matrix is not None:
            Ks.append(check_intrinsics(matrix, f"K of {name}"))
            if not cropped:
                check_intrinsics_fit(Ks[-1], *size, f"K of {name}", name)
        elif fov is not None:
            Ks.append(intrinsics_from_fov(fov, size))
        elif hasattr(photograph, "getexif"):
            from_exif, assumed = intrinsics_from_exif(photograph, name)
            Ks.append(from_exif)
            notes += assumed
        else:
            cure = "Give K, a field of view (fov), or PIL images that carry their EXIF."
            bad_value(f"K of {name}", "known", "an array without EXIF", cure)
    return Ks, notes


def _as_cloud(points: Tensor, K_left: Tensor, size: tuple[int, int]) -> np.ndarray:
    """Points ``(N, 3)`` unchanged; a depth map of the left photograph, of any resolution, unprojected."""
    if points.shape[1] == 3:
        return points.double().numpy()
    K = resize_intrinsics(K_left[None], size, image_size(points))
    xyz = unproject(points[None, None], K).reshape(-1, 3)
    return xyz[xyz[:, 2] > 0].double().numpy()


class KnownLengths(NamedTuple):
    """What can give estimated poses their unit, as ``from_photographs`` takes it; ``None`` if unknown."""

    baseline_m: float | None
    known_length: tuple[float, float, float, float, float] | None
    points: Any


def _in_float32(matrix: np.ndarray) -> Tensor:
    return torch.as_tensor(matrix, dtype=torch.float32, device="cpu")


def _posed(images: Sequence[Tensor], Ks: Sequence[np.ndarray], Ts: Iterable[np.ndarray]) -> PosedViews:
    """Images, left one first, with the poses ``T_right_from_left`` of the right ones."""
    rights = (
        CameraView(image, _in_float32(K), _in_float32(T))
        for image, K, T in zip(images[1:], Ks[1:], Ts, strict=True)
    )
    return PosedViews(images[0], tuple(rights), _in_float32(Ks[0]))


class _Solved(NamedTuple):
    """Poses of photographs whose first baseline has the length 1."""

    Ts: np.ndarray  # (V, 4, 4) T_right_from_left
    poses: Sequence[EstimatedPose]  # as they were estimated, view by view
    tracks: Tracks  # that they fit
    spread: float | None  # ``depth_spread``; ``None`` for a rectified pair


def _solved(images: Sequence[Tensor], Ks: Sequence[np.ndarray]) -> _Solved:
    """Estimate the poses of images, left one first, and fit those of a general pose to all matches."""
    views = grey_views(_posed(images, Ks, [np.eye(4)] * (len(images) - 1)))
    tracks, poses = estimate_poses(views)
    Ts = np.stack([pose.T for pose in poses])
    if all(pose.rectified for pose in poses):
        return _Solved(Ts, poses, tracks, None)
    depth_m = coarse_depth(_posed(images, Ks, Ts), views[0][0].shape)
    Ts, tracks = polished(views, Ts, depth_m, tracks.seen_anywhere())
    return _Solved(Ts, poses, tracks, depth_spread(tracks, Ts))


def estimate_rig(
    photographs: Sequence[Any],
    known: KnownLengths,
    *,
    K: Any = None,
    fov: float | None = None,
    cropped: bool = False,
) -> EstimatedRig:
    """Cameras of two photographs or more, left one first; arguments as ``from_photographs``."""
    if len(photographs) < 2:
        bad_type("photographs", "two images or more", photographs)
    names = ["left", *(f"right photograph {i}" for i in range(1, len(photographs)))]
    images = [as_image_01(p, n) for p, n in zip(photographs, names, strict=True)]
    Ks, notes = _cameras(photographs, images, K, fov, cropped)
    if known.baseline_m is not None:
        check_number(known.baseline_m, "baseline_m", 1e-6, 1e6)
    size, cloud = image_size(images[0]), None
    if known.points is not None:
        cloud = _as_cloud(as_points(known.points, "points"), _in_float32(Ks[0]), size)
    found = _solved(cleaned(images, DEFAULT), Ks)
    factor = found.tracks.K_left[0, 0] / Ks[0][0, 0]
    scale = find_scale(found.tracks, found.Ts, factor, known.baseline_m, known.known_length, cloud)
    Ts, poses = found.Ts.copy(), found.poses
    Ts[:, :3, 3] *= scale.factor
    of_poses = [warning for pose in poses for warning in pose.warnings]
    return EstimatedRig(
        size_left=size[::-1],
        Ks=tuple(Ks),
        Es=tuple(np.linalg.inv(T) for T in Ts),
        inliers=tuple(int(pose.inliers.sum()) for pose in poses),
        parallax_deg=tuple(pose.parallax_deg for pose in poses),
        residual_px=tuple(pose.residual_px for pose in poses),
        depth_spread=found.spread,
        scale=scale,
        notes=tuple(notes),
        warnings=(*of_poses, *undetermined_pose(found.spread), *scale.warnings),
    )
