"""Defines records shared by all layers.

Layer 0: imports ``cameras``; imported by all higher layers.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from geodiff_plugin.cameras import Camera, PosedCamera, Size


@dataclass(frozen=True)
class Rig:
    """Calibration of a left and a right pinhole camera; 0.12 m to the right is ``E[0, 3] == +0.12``.

    Attributes:
        left: K, image size and lens of the left camera; ``None`` for an unknown size or no distortion.
        right: the same for the right camera.
        E: ``(4, 4)`` float64, lengths in ``unit``; pose of the right camera in the left camera's frame.
        source: file or option of origin, for messages and reports.
        rectified: whether the source states that its images are rectified, without lens distortion.
        unit: ``"m"``, or ``None`` if the source does not state the unit of its lengths.
        measured: whether the baseline is calibrated or measured, so that a refined pose keeps it; ``False``
            for poses from a tracker, SLAM or structure from motion.
        as_taken: the cameras of the same images before rectification, if the source has both.
    """

    left: Camera
    right: Camera
    E: np.ndarray
    source: str = "arguments"
    rectified: bool = False
    unit: str | None = "m"
    measured: bool = True
    as_taken: Rig | None = None

    @property
    def K_left(self) -> np.ndarray:
        """Intrinsics of the left image, ``(3, 3)`` float64, pixels."""
        return self.left.K

    @property
    def K_right(self) -> np.ndarray:
        """Intrinsics of the left image, ``(3, 3)`` float64, pixels."""
        return self.right.K

    @property
    def size_left(self) -> Size | None:
        """``(width, height)`` of the images that ``K_left`` is for; ``None`` if unknown."""
        return self.left.size

    @property
    def size_right(self) -> Size | None:
        """``(width, height)`` of the images that ``K_right`` is for; ``None`` if unknown."""
        return self.right.size

    def sized(self, left: Size | None, right: Size | None) -> Rig:
        """Return the same rig for images of these sizes."""
        return replace(self, left=replace(self.left, size=left), right=replace(self.right, size=right))

    def resized(self, left: Size, right: Size) -> Rig:
        """Return the rig after resizing its images, whose sizes it has."""
        if (left, right) == (self.size_left, self.size_right):
            return self
        rig = replace(self, left=self.left.resized(left), right=self.right.resized(right))
        if self.as_taken is None:
            return rig
        taken = self.as_taken.sized(self.size_left, self.size_right)
        return replace(rig, as_taken=taken.resized(left, right))

    @property
    def T_right_from_left(self) -> np.ndarray:
        """Transform ``(4, 4)`` float64 of points from the left camera's frame to the right one's."""
        return np.linalg.inv(self.E)


@dataclass(frozen=True)
class RejectedPose:
    """A pose that fits the matches but is too far from the given one to be used."""

    view: int  # index of the right view
    degrees: float  # rotation of the camera
    of_baseline: float  # distance from the given position relative to the baseline
    residual_px: float  # median distance of the matches from their epipolar lines


@dataclass(frozen=True, eq=False)
class PoseReport:
    """Poses of one image's right views: as given, as used, and their fit to the matches.

    ``status`` is ``"given"`` (not checked, by configuration), ``"fits"``, ``"refined"``, ``"kept"`` (no
    better pose nearby), ``"mistaken"`` (a common error explains the misfit; the pose is used as given) or
    ``"not checked"`` (too few matches). Residuals are in pixels of the right images, resized to the left
    image's pixels per radian; the left image has at most 832 pixels on its longer side.
    """

    status: str
    E_given: tuple[np.ndarray, ...]  # (4, 4) each, metres, pose in the left camera's frame
    E: tuple[np.ndarray, ...]  # the poses in use
    residual_px_given: tuple[float, ...] = ()  # median distance of the matches from their epipolar lines
    residual_px: tuple[float, ...] = ()  # the same for the poses and images in use
    matches: tuple[float, ...] = ()  # number of matches of each right view
    warp_rms_px: tuple[float, ...] = ()  # RMS displacement of the right images' warp; 0 for none
    scale_rel_std: float | None = None  # relative uncertainty of the poses' scale; None if measured
    depth_spread: float = 0.0  # median change of log depth for another pose that fits as well
    rig: bool = False  # whether the given poses belong to a rectified rig
    features: int | None = None  # number of feature matches, if too few to check the poses
    rejected: RejectedPose | None = None  # a pose that fits but is too far from the given one


@dataclass(frozen=True)
class StepReport:
    """Report of one round of a guided denoising step, with one entry per sample of the batch."""

    step: int  # index of the step in the schedule, from 0
    timestep: float  # of the scheduler
    s_hat: torch.Tensor  # (B,) raw scale before softplus, after the step
    t_hat: torch.Tensor  # (B,) raw shift before softplus, after the step
    g_s: torch.Tensor  # (B,) global scale in use, metres
    loss: torch.Tensor | None = None  # (B,) total before the round's updates; None without updates
    terms: dict[str, torch.Tensor] = field(default_factory=dict)  # (B,) unweighted value of each, by name
    visible_fraction: torch.Tensor | None = None  # (B,) pixels that a right view sees; 0 without a view

    def cpu(self) -> StepReport:
        """Copy the report to the CPU."""
        here: dict[str, Any] = {k: v.cpu() for k, v in vars(self).items() if isinstance(v, torch.Tensor)}
        return replace(self, **here, terms={name: value.cpu() for name, value in self.terms.items()})


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """Depth of one frame of a capture, from estimation to agreement check and point cloud."""

    name: str
    depth: np.ndarray  # (H, W) z
    confidence: np.ndarray  # (H, W) in [0, 1]
    camera: PosedCamera
    confirmed: np.ndarray | None = None  # (H, W) number of other frames that agree with the depth
    observers: np.ndarray | None = None  # (H, W) number that see the point or something in front
    sigma: np.ndarray | None = None  # (H, W) standard deviation of the depth; NaN where unknown
    measurable: float | None = None  # the farthest depth that its views can measure; None if unknown

    def world(self) -> np.ndarray:
        """Unproject the pixels to points ``(H, W, 3)`` in the world frame."""
        return self.camera.to_world(self.camera.unproject(self.depth))
