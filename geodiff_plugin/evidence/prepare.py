"""Clean photographs, refine or estimate their poses, make ``Evidence`` of them, and cache it."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._camera_checks import check_intrinsics, check_intrinsics_fit
from geodiff_plugin._checks import bad_type, bad_value, check_number
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence, prepare_evidence
from geodiff_plugin.evidence.inputs import Inputs, as_points
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.formats.images import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.geometry import image_size, resize_intrinsics, unproject
from geodiff_plugin.matching import clean
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.estimate import Scale, estimate_poses, find_scale, polished
from geodiff_plugin.pose.refine import refine_views, untouched
from geodiff_plugin.pose.solve import depth_spread, undetermined_pose
from geodiff_plugin.pose.tracks import coarse_depth, grey_views
from geodiff_plugin.types import CameraView


def cleaned(image_01: Tensor, config: GuidanceConfig) -> Tensor:
    """A photograph ``(3, H, W)`` in [0, 1] of native size, without flaws if ``clean_photographs`` is set."""
    return clean(image_01, config.sweep_pixels) if config.clean_photographs else image_01


def make_evidence(
    left_01: Tensor, given: Inputs, config: GuidanceConfig, needs_matches: bool, measured: bool = False
) -> Evidence:
    """Clean the photographs, refine the poses, and prepare the ``Evidence`` of one native left image.

    ``needs_matches``: match the volume against each view. ``measured``: baseline lengths are measured.
    """
    views, K_left, points = given.on(left_01.device)
    if not views:
        return prepare_evidence(left_01, views, K_left, points, config, needs_matches)
    left_01 = cleaned(left_01, config)
    views = [view._replace(image_01=cleaned(view.image_01, config)) for view in views]
    if config.pose == "given":
        posed, report = untouched(views)
    else:
        posed, report = refine_views(left_01, views, K_left, given.unit, measured)
    return prepare_evidence(left_01, posed, K_left, points, config, needs_matches, report)


class EvidenceStore:
    """A cache of evidence by the values that it was made from; several guidances may share it."""

    def __init__(self, size: int = 2, copies: bool = True) -> None:
        """Keep the last ``size`` images, some 100 MB each; without ``copies`` they must not be changed."""
        self._size, self._copies, self._spared = size, copies, 0.0
        # Tensors and settings that an entry was made from, the entry, and the seconds that it took.
        self._entries: list[tuple[list[Tensor | None], tuple[Any, ...], Evidence, float]] = []

    def get(
        self,
        left_01: Tensor,
        given: Inputs,
        config: GuidanceConfig,
        needs_matches: bool,
        measured: bool = False,
    ) -> Evidence:
        """What ``make_evidence`` gives for these arguments; the caller must not change it."""
        views = [value for view in given.views for value in view]
        tensors = [left_01, torch.from_numpy(given.K_left), given.points, *views]
        knobs = ("pose", "clean_photographs", "depth_range", "planes", "sweep_pixels")
        settings = (*(getattr(config, name) for name in knobs), config.search == "volume")
        settings = (*settings, needs_matches, measured, given.unit)
        for held, made_with, evidence, seconds in self._entries:
            if made_with == settings and len(held) == len(tensors) and all(map(_equal, held, tensors)):
                self._spared += seconds
                return evidence
        start = time.perf_counter()
        evidence = make_evidence(left_01, given, config, needs_matches, measured)
        # Copies, so that an image that was changed in place since is not taken for the same.
        held = [value.clone() if self._copies and value is not None else value for value in tensors]
        self._entries.insert(0, (held, settings, evidence, time.perf_counter() - start))
        del self._entries[self._size :]
        return evidence

    def take_spared_seconds(self) -> float:
        """Seconds that the cache saved since the last call of this method; benchmarks add them."""
        spared, self._spared = self._spared, 0.0
        return spared


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.device == b.device and a.shape == b.shape and torch.equal(a, b)


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


def estimate_rig(
    photographs: Sequence[Any],
    *,
    K: Any = None,
    fov: float | None = None,
    baseline_m: float | None = None,
    known_length: tuple[float, float, float, float, float] | None = None,
    points: Any = None,
    cropped: bool = False,
) -> EstimatedRig:
    """Cameras of two photographs or more, left one first; arguments as ``from_photographs``."""
    if len(photographs) < 2:
        bad_type("photographs", "two images or more", photographs)
    names = ["left", *(f"right photograph {i}" for i in range(1, len(photographs)))]
    images = [as_image_01(p, n) for p, n in zip(photographs, names, strict=True)]
    Ks, notes = _cameras(photographs, images, K, fov, cropped)
    if baseline_m is not None:
        check_number(baseline_m, "baseline_m", 1e-6, 1e6)
    K_left = torch.as_tensor(Ks[0], dtype=torch.float32, device="cpu")
    size = image_size(images[0])
    cloud = None if points is None else _as_cloud(as_points(points, "points"), K_left, size)
    images = [cleaned(image, DEFAULT) for image in images]

    def posed(Ts: Iterable[np.ndarray]) -> list[CameraView]:
        return [
            CameraView(image, *(torch.as_tensor(m, dtype=torch.float32, device="cpu") for m in matrices))
            for image, *matrices in zip(images[1:], Ks[1:], Ts, strict=True)
        ]

    views = grey_views(images[0], posed([np.eye(4)] * (len(images) - 1)), K_left)
    tracks, poses = estimate_poses(views)
    Ts, spread = np.stack([pose.T for pose in poses]), None
    if not all(pose.rectified for pose in poses):
        depth_m = coarse_depth(images[0], posed(Ts), K_left, views[0][0].shape)
        Ts, tracks = polished(views, Ts, depth_m, tracks.seen_anywhere())
        spread = depth_spread(tracks, Ts)
    factor = tracks.K_left[0, 0] / Ks[0][0, 0]
    scale = find_scale(tracks, Ts, factor, baseline_m, known_length, cloud)
    Ts[:, :3, 3] *= scale.factor
    return EstimatedRig(
        size[::-1],
        tuple(Ks),
        tuple(np.linalg.inv(T) for T in Ts),
        tuple(int(pose.inliers.sum()) for pose in poses),
        tuple(pose.parallax_deg for pose in poses),
        tuple(pose.residual_px for pose in poses),
        spread,
        scale,
        tuple(notes),
        (*(s for pose in poses for s in pose.warnings), *undetermined_pose(spread), *scale.warnings),
    )
