"""Estimates the cameras of unposed images: K from EXIF or a field of view, poses from matches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from geodiff_plugin._internal.camera_checks import check_intrinsics, check_intrinsics_fit
from geodiff_plugin._internal.checks import (
    InputError,
    UnknownPoseError,
    bad_type,
    bad_value,
    check_number,
    with_code,
)
from geodiff_plugin.cameras import Camera, PosedViews, View, field_of_view_deg
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.inputs import as_points, right_masks
from geodiff_plugin.evidence.prepare import cleaned
from geodiff_plugin.evidence.valid import alpha_mask, as_mask, both, neutral_views
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import as_image_01, intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.geometry import image_size
from geodiff_plugin.pose.estimate import EstimatedPose, Matcher, Scale, estimate_poses, find_scale, polished
from geodiff_plugin.pose.solve import depth_spread, unconstrained_pose
from geodiff_plugin.pose.tracks import Tracks, coarse_depth, grey_views
from geodiff_plugin.pose.xfeat import XFEAT, XFeatMatcher

#: Name of the default matcher.
SIFT = "sift"


@dataclass(frozen=True, eq=False)
class EstimatedRig:
    """Cameras of images without given poses; fields after ``Ks`` have one entry per right view."""

    size_left: tuple[int, int]  # (width, height) of the left image
    Ks: tuple[np.ndarray, ...]  # (3, 3) each, left one first
    Es: tuple[np.ndarray, ...]  # (4, 4) each, pose in the left camera's frame, in metres or without unit
    inliers: tuple[int, ...]  # number of matches consistent with the pose
    parallax_deg: tuple[float, ...]  # median angle between the two rays of a point
    residual_px: tuple[float, ...]  # median distance of the inliers from their epipolar lines
    depth_spread: float | None  # relative, from pose errors; ``None`` for a rectified pair
    scale: Scale  # source of the unit
    findings: tuple[Finding, ...]  # assumptions and warnings


def _cameras(
    unposed: Sequence[Any], images: Sequence[Tensor], K: Any, fov: float | None, cropped: bool
) -> tuple[list[np.ndarray], list[Finding]]:
    """Return the K of every image and the assumptions made for it."""
    given = list(K) if isinstance(K, (tuple, list)) and np.ndim(K[0]) == 2 else [K] * len(images)
    if len(given) != len(images):
        bad_value("K", f"one matrix, or {len(images)} of them", f"{len(given)}")
    Ks: list[np.ndarray] = []
    assumptions: list[Finding] = []
    for i, (image_source, image, matrix) in enumerate(zip(unposed, images, given, strict=True)):
        name = "the left image" if i == 0 else f"right image {i}"
        size = (image.shape[-1], image.shape[-2])
        if matrix is not None:
            Ks.append(check_intrinsics(matrix, f"K of {name}"))
            if not cropped:
                check_intrinsics_fit(Ks[-1], *size, f"K of {name}", name)
        elif fov is not None:
            Ks.append(intrinsics_from_fov(fov, size))
        elif hasattr(image_source, "getexif"):
            from_exif, assumed = intrinsics_from_exif(image_source, name)
            Ks.append(from_exif)
            assumptions += assumed
        else:
            hint = "Pass K, a field of view (fov), or PIL images with EXIF data."
            bad_value(f"K of {name}", "known", "an array without EXIF", hint)
    return Ks, assumptions


def _as_cloud(points: Tensor, left: Camera) -> np.ndarray:
    """Return points ``(N, 3)`` unchanged; unproject a depth map of the left image of any resolution."""
    if points.shape[1] == 3:
        return points.double().numpy()
    depth_m = points.numpy()
    rows, columns = np.nonzero(depth_m > 0)
    rays = left.resized(image_size(points)[::-1]).rays(np.stack([columns, rows], 1).astype(np.float32))
    return (rays * depth_m[rows, columns, None]).astype(np.float64)


def focal_source(assumed: Sequence[Finding]) -> str:
    """Return a sentence about a focal length from EXIF, which may be outdated; empty for other sources."""
    sources = [finding for finding in assumed if finding.code == "camera.from-exif"]
    hint = "EXIF is outdated if an editor resized or cropped the image: pass --K or --fov (K, fov)."
    return f" {sources[0]} {hint}" if sources else ""


def _intrinsics_used(K: np.ndarray, width: int, assumed: Sequence[Finding]) -> str:
    """State the focal length used to estimate poses, with its source: a wrong one hides parallax."""
    degrees = field_of_view_deg(width, float(K[0, 0]))
    return f"The left image has fx {K[0, 0]:.0f} px ({degrees:.0f} degrees wide).{focal_source(assumed)}"


class KnownLengths(NamedTuple):
    """Lengths that can give estimated poses a unit (``from_unposed_images``); ``None`` if unknown."""

    baseline_m: float | None
    known_length: tuple[float, float, float, float, float] | None
    points: Any


class _Images(NamedTuple):
    """Images, left one first."""

    images: Sequence[Tensor]  # (3, H, W) each, with neutral content where they are not valid
    valid: Sequence[Tensor | None]  # (H, W) bool each; None for all

    @classmethod
    def of(cls, images: Sequence[Tensor], valid: Sequence[Tensor | None]) -> _Images:
        """Clean images and make invalid pixels neutral: outside of the masks, or in constant borders."""
        pairs = neutral_views(images, valid)
        masks = [mask for _, mask in pairs]
        return cls(cleaned([image for image, _ in pairs], masks, DEFAULT), masks)


def _posed(unposed: _Images, Ks: Sequence[np.ndarray], Ts: Iterable[np.ndarray]) -> PosedViews:
    """Combine images with the poses ``T_right_from_left`` of the right ones."""
    each = zip(unposed.images, Ks, (np.eye(4), *Ts), unposed.valid, strict=True)
    left, *rights = (View.single(image, Camera(K), T, valid) for image, K, T, valid in each)
    return PosedViews(left, tuple(rights))


class _Solved(NamedTuple):
    """Poses of images, scaled to a first baseline of length 1."""

    Ts: np.ndarray  # (V, 4, 4) T_right_from_left
    poses: Sequence[EstimatedPose]  # as estimated, view by view
    tracks: Tracks  # tracks consistent with the poses
    spread: float | None  # ``depth_spread``; ``None`` for a rectified pair


def _matcher_of(name: str) -> Matcher | None:
    """Return the matcher in addition to SIFT: ``None`` for ``sift``, else ``xfeat`` or ``xfeat:FOLDER``."""
    kind, _, folder = name.partition(":")
    if name == SIFT:
        return None
    if kind != XFEAT or (":" in name and not folder):
        bad_value("matcher", "sift, xfeat or xfeat:FOLDER", repr(name))
    return XFeatMatcher.load(Path(folder) if folder else None).tracks


def _solve(unposed: _Images, Ks: Sequence[np.ndarray], matcher: Matcher | None) -> _Solved:
    """Estimate the poses of images; non-rectified poses are then fitted to all matches."""
    views = grey_views(_posed(unposed, Ks, [np.eye(4)] * (len(unposed.images) - 1)))
    tracks, poses = estimate_poses(views, matcher)
    Ts = np.stack([pose.T for pose in poses])
    if all(pose.rectified for pose in poses):
        return _Solved(Ts, poses, tracks, None)
    depth_m = coarse_depth(_posed(unposed, Ks, Ts), views[0].grey.shape)
    Ts, tracks = polished(views, Ts, depth_m, tracks.seen_anywhere())
    return _Solved(Ts, poses, tracks, depth_spread(tracks, Ts))


def estimate_rig(
    unposed: Sequence[Any],
    known: KnownLengths,
    *,
    K: Any = None,
    fov: float | None = None,
    cropped: bool = False,
    masks: tuple[Any, Any] = (None, None),
    matcher: str = SIFT,
) -> EstimatedRig:
    """Estimate the cameras of two or more images, left one first; arguments as in ``from_unposed_images``.

    ``masks`` has the masks for the left image and for the others, as ``GeometryGuidance`` takes them.
    """
    if len(unposed) < 2:
        bad_type("images", "two or more images", unposed)
    names = ["left", *(f"right image {i}" for i in range(1, len(unposed)))]
    images = [as_image_01(p, n) for p, n in zip(unposed, names, strict=True)]
    Ks, assumed = _cameras(unposed, images, K, fov, cropped)
    if known.baseline_m is not None:
        check_number(known.baseline_m, "baseline_m", 1e-6, 1e6)
    size = image_size(images[0])
    cloud = None
    if known.points is not None:
        cloud = _as_cloud(as_points(known.points, "points"), Camera(Ks[0], size[::-1]).single())
    left = both(as_mask(masks[0], "mask", size), alpha_mask(unposed[0]))
    valid = [left, *right_masks(masks[1], "right_mask", tuple(unposed[1:]), images[1:])]
    match = _matcher_of(matcher)
    try:
        found = _solve(_Images.of(images, valid), Ks, match)
    except InputError as error:
        text = f"{error} {_intrinsics_used(Ks[0], size[1], assumed)}"
        raise with_code(UnknownPoseError(text), error.code) from None
    factor = found.tracks.K_left[0, 0] / Ks[0][0, 0]
    scale = find_scale(found.tracks, found.Ts, factor, known.baseline_m, known.known_length, cloud)
    Ts = found.Ts.copy()
    poses = found.poses
    Ts[:, :3, 3] *= scale.factor
    of_poses = [finding for pose in poses for finding in pose.findings]
    return EstimatedRig(
        size_left=size[::-1],
        Ks=tuple(Ks),
        Es=tuple(np.linalg.inv(T) for T in Ts),
        inliers=tuple(int(pose.inliers.sum()) for pose in poses),
        parallax_deg=tuple(pose.parallax_deg for pose in poses),
        residual_px=tuple(pose.residual_px for pose in poses),
        depth_spread=found.spread,
        scale=scale,
        findings=(*assumed, *of_poses, *unconstrained_pose(found.spread), *scale.findings),
    )
