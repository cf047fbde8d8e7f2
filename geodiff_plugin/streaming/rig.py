"""Prepares the frames of a rig: guidance and evidence, with periodic checks of poses, images and borders.

The pose check takes longer than the rest of the evidence, and a rig does not change from frame to frame. It
is made with the first frame and then with every N-th. The frames in between use its result: refined poses,
warps, and the facts of its checks, so that their verdicts state the same reasons.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._internal.camera_checks import check_calibrated_size
from geodiff_plugin._internal.checks import captured_warnings
from geodiff_plugin.cameras import Camera, eroded
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.pose_check import CheckedPoses
from geodiff_plugin.evidence.prepare import cleaned, pinhole
from geodiff_plugin.evidence.valid import BLEND_PX, RIM_PX, as_mask, outside_borders, undistorted_mask
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.runtime.prefetch import prefetch_evidence
from geodiff_plugin.streaming.sources import StereoFrame
from geodiff_plugin.types import Rig

#: Status of a pose report that found too little texture to check the poses.
NOT_CHECKED = "not checked"


class RigSetup(NamedTuple):
    """Cameras of the images as they arrive, left one first, and the guidance of one frame."""

    cameras: tuple[Camera, Camera]
    guidance: GeometryGuidance
    masks: Sequence[Tensor | None] = (None, None)  # (H, W) bool, valid pixels with distortion; None for all


#: Makes the setup of a rig from the left and right image of its first frame, ``(H, W, 3)`` float32 in [0, 1].
Setup = Callable[[np.ndarray, np.ndarray], RigSetup]


def setup_of_rig(rig: Rig, config: GuidanceConfig, mask: Any = None, right_mask: Any = None) -> Setup:
    """Return the setup of a calibrated rig; the masks are for images without lens distortion."""

    def setup(left: np.ndarray, right: np.ndarray) -> RigSetup:
        left_size = (left.shape[1], left.shape[0])
        right_size = (right.shape[1], right.shape[0])
        hint = "Use the size that the rig was calibrated for, or scale its K."
        check_calibrated_size(left_size, rig.size_left, "the left frame", rig.source, hint)
        check_calibrated_size(right_size, rig.size_right, "the right frame", rig.source, hint)
        sized = rig.sized(left_size, right_size)
        cameras, masks = (sized.left, sized.right), _bent_masks(sized, left, right)
        left_view = (pinhole(left, sized.left, config, masks[0]), rig.K_left, np.eye(4))
        right_view = (pinhole(right, sized.right, config, masks[1]), rig.K_right, rig.E)
        seen_left, seen_right = (
            None if camera.lens is None else undistorted_mask(valid, camera, image.shape[:2])
            for valid, camera, image in zip(masks, cameras, (left, right), strict=True)
        )
        guidance = GeometryGuidance.from_views(
            [left_view, right_view],
            mask=seen_left if mask is None else mask,
            right_mask=seen_right if right_mask is None else right_mask,
            unit=rig.unit,
            measured_baseline=rig.measured,
            config=config,
        )
        guidance.calibrated = True
        return RigSetup(cameras, guidance, masks)

    return setup


def _bent_masks(rig: Rig, left: np.ndarray, right: np.ndarray) -> list[Tensor | None]:
    """Return the pixels ``(H, W)`` bool inside of borders of images ``(H, W, 3)`` with lens distortion.

    ``None`` stands for all pixels. Borders of images without distortion are found with each check.
    """
    if rig.left.lens is None and rig.right.lens is None:
        return [None, None]
    return outside_borders([as_image_01(image, "frame") for image in (left, right)], [None, None])


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """A frame that is ready for a guided call.

    Attributes:
        frame: as it arrived.
        left: its left image without lens distortion, as in ``StereoFrame``.
        guidance: its guidance, with evidence.
        checked: whether poses, images and borders were checked with this frame.
    """

    frame: StereoFrame
    left: np.ndarray
    guidance: GeometryGuidance
    checked: bool


class LiveRig:
    """Prepares the frames of one rig in order.

    Args:
        setup: makes the rig's setup from its first frame.
        device: device of the pipeline.
        check_every: number of frames from one check to the next; 0 never checks and uses the poses as given.
        among: number of threads of the program that compute at the same time.
        kernels: whether Triton kernels may be used.
    """

    def __init__(
        self, setup: Setup, device: torch.device, check_every: int, *, among: int = 2, kernels: bool = True
    ) -> None:
        self._make = setup
        self._setup: RigSetup | None = None
        self._device, self._check_every = device, check_every
        self._among, self._kernels, self._count = among, kernels, 0
        self._poses: CheckedPoses | None = None
        self._masks: tuple[Tensor | None, Tensor | None] = (None, None)
        self._config = DEFAULT  # of the guidance, from the first frame on

    def prepare(self, frame: StereoFrame) -> PreparedFrame:
        """Return the guidance of a frame with its evidence.

        Raises:
            InputError: images that do not match the rig or the first frame.
        """
        checks = bool(self._check_every) and self._count % self._check_every == 0
        with captured_warnings() as warned:
            setup = self._setup = self._setup or self._make(*map(_as_01, (frame.left, frame.right)))
            views = zip((frame.left, frame.right), setup.cameras, setup.masks, strict=True)
            left, right = (_straight(*view, setup.guidance.config) for view in views)
            if checks or self._count == 0:
                self._check_images(setup.guidance, left, right)
            guidance = setup.guidance.for_frame(right, *self._masks)
            guidance.config = self._config
            guidance.checked = None if checks else self._poses
            (plan,) = prefetch_evidence(
                guidance, left, self._device, among=self._among, kernels=self._kernels
            )
            if checks and plan.poses is not None:
                self._keep(plan.poses.result())
        guidance.add_findings(warned)
        self._count += 1
        return PreparedFrame(frame, left, guidance, checks)

    def _check_images(self, guidance: GeometryGuidance, left: np.ndarray, right: np.ndarray) -> None:
        """Find constant borders, and whether the images of this rig need cleaning."""
        self._masks = _valid_pixels(guidance, left, right)
        config = guidance.config
        images = [as_image_01(image, "frame") for image in (left, right)]
        clear = cleaned(images, self._masks, config)
        clean = all(one is other for one, other in zip(images, clear, strict=True))
        pose = "refine" if self._check_every else "given"
        self._config = config.changed(pose=pose, clean_images=config.clean_images and not clean)

    def _keep(self, poses: CheckedPoses) -> None:
        """Keep the result of a check; a frame without texture does not replace an earlier result."""
        if self._poses is None or poses.report.status != NOT_CHECKED:
            self._poses = poses


def _as_01(image: np.ndarray) -> np.ndarray:
    """Convert an image to ``(H, W, 3)`` float32 in [0, 1]."""
    image_01: np.ndarray = as_image_01(image, "frame").permute(1, 2, 0).contiguous().numpy()
    return image_01


def _straight(image: np.ndarray, camera: Camera, valid: Tensor | None, config: GuidanceConfig) -> np.ndarray:
    """Return an image without lens distortion; the same object if there is none."""
    return image if camera.lens is None else pinhole(_as_01(image), camera, config, valid)


def _valid_pixels(
    guidance: GeometryGuidance, left: np.ndarray, right: np.ndarray
) -> tuple[Tensor | None, Tensor | None]:
    """Return the valid pixels ``(H, W)`` of both views: the masks of the rig, or all but constant borders.

    The blended edge of a border is left out too, because these pixels are used for all frames.
    """
    (given,) = guidance.inputs
    known = (as_mask(given.mask, "mask", left.shape[:2]), given.views[0].valid)
    found = outside_borders([as_image_01(image, "frame") for image in (left, right)], known)
    of_left, of_right = (
        mask if mask is None or mask is own else eroded(mask, BLEND_PX - RIM_PX)
        for mask, own in zip(found, known, strict=True)
    )
    return of_left, of_right
