"""Records shared by all layers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from geodiff_plugin.messages import Message

#: Why a depth is not judged.
UNTESTED = "neither matches of two views nor enough known depths, all over the image, test it"


@dataclass(frozen=True, eq=False)
class Distortion:
    """Lens distortion of one camera: ``coefficients`` in OpenCV's order.

    ``model`` is ``"opencv"`` (k1, k2, p1, p2, k3 and so on), ``"fisheye"`` (k1 to k4), or the name of a model
    of COLMAP that OpenCV does not have, such as ``"FOV"``, with its coefficients behind cx and cy.
    """

    model: str
    coefficients: np.ndarray


@dataclass(frozen=True)
class Rig:
    """Calibration of a left and a right pinhole camera; at 0.12 m to the right ``E[0, 3] == +0.12``.

    Attributes:
        K_left: ``(3, 3)`` float64, pixels of the left image.
        K_right: ``(3, 3)`` float64, pixels of the right image.
        E: ``(4, 4)`` float64, lengths in ``unit``; pose of the right camera in the left camera's frame.
        size_left: ``(width, height)`` of the images that ``K_left`` is for; ``None`` if unknown.
        size_right: likewise for ``K_right``.
        source: file or option it comes from, for messages and reports.
        distortion: of the left and the right lens; ``None`` for none.
        rectified: whether the source says that its images are rectified, free of lens distortion.
        unit: ``"m"``, or ``None`` where the source does not say what its lengths are in.
        measured: whether the distance between the cameras is calibrated or measured, so that a refined pose
            keeps it; ``False`` for poses of a tracker, of SLAM or of structure from motion.
        as_taken: the cameras of the same pictures before they were rectified, where the source has both.
    """

    K_left: np.ndarray
    K_right: np.ndarray
    E: np.ndarray
    size_left: tuple[int, int] | None = None
    size_right: tuple[int, int] | None = None
    source: str = "arguments"
    distortion: tuple[Distortion | None, Distortion | None] = (None, None)
    rectified: bool = False
    unit: str | None = "m"
    measured: bool = True
    as_taken: Rig | None = None

    @property
    def T_right_from_left(self) -> np.ndarray:
        """``(4, 4)`` float64, maps points from the left camera's frame to the right one's."""
        return np.linalg.inv(self.E)


class Tear(NamedTuple):
    """From ``row`` on, of the left picture (``view`` 0) or a right one, pixels lie ``px`` to the right."""

    view: int
    row: int
    px: int


@dataclass(frozen=True, eq=False)
class PoseReport:
    """Poses of one image's right views: as given, as used, and how well they fit the matches.

    ``status`` is ``"given"`` (not checked, by configuration), ``"fits"``, ``"refined"``, ``"kept"`` (no
    better pose nearby), ``"mistaken"`` (a usual mistake explains the misfit; the pose is used as given) or
    ``"not checked"`` (too few matches). Residuals are in pixels of the right images, resized to the left
    image's pixels per radian; the left image is at most 832 on its longer side.
    """

    status: str
    E_given: tuple[np.ndarray, ...]  # (4, 4) each, metres, pose in the left camera's frame
    E: tuple[np.ndarray, ...]  # the same as used
    residual_px_given: tuple[float, ...] = ()  # median distance of the matches from their epipolar lines
    residual_px: tuple[float, ...] = ()  # the same with the poses, and images, as used
    matches: tuple[float, ...] = ()  # number of matches of each right view
    straightened_px: tuple[float, ...] = ()  # root mean square displacement of the right images; 0 for none
    scale_spread: float | None = None  # relative, of the scale of the poses as used; None for measured ones
    depth_spread: float = 0.0  # median change of log depth by another pose that fits as well
    behind_infinity: float = math.nan  # share of the matches at which the rays of the poses as used diverge
    behind_px: float = math.nan  # how far behind infinity the farthest of them lie; 0 where hardly any do
    distortion: float = math.nan  # radial coefficient k1 that both pictures still have for certain
    distortion_alone: float = math.nan  # what of it neither a turn nor a shear of the right picture explains
    tear: Tear | None = None  # where a picture is torn
    bars: float = 0.0  # width of bars at opposite sides of all pictures, as a share of that side
    exchangeable: float = math.nan  # share of the matches that fit as well with near and far exchanged
    moved: float = math.nan  # share of the matches in parts that moved across the lines of the given pose
    warnings: tuple[Message, ...] = ()


class CameraView(NamedTuple):
    """A right image ``(C, H, W)`` float32 in [0, 1], C = 3, or 1 for grey, and its camera.

    ``K (3, 3)`` is in pixels of this image; ``T_right_from_left (4, 4)``, metres, maps left points to it.
    """

    image_01: torch.Tensor
    K: torch.Tensor
    T_right_from_left: torch.Tensor


class PosedViews(NamedTuple):
    """A left image, the right views that are compared with it, and their cameras; all at one scale.

    ``left_01 (3, H, W)`` float32 in [0, 1] and ``K_left (3, 3)`` in pixels of it; of a chunk of samples, each
    tensor, those of the views too, has a batch axis in front. Images are on the device of the call, cameras
    on the CPU, where decisions about them are taken. Without a right view only points are known.
    """

    left_01: torch.Tensor
    views: tuple[CameraView, ...]
    K_left: torch.Tensor

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the left image."""
        return self.left_01.shape[-2], self.left_01.shape[-1]


@dataclass(frozen=True)
class StepReport:
    """Report of one round of a guided denoising step, with one entry per sample of the batch."""

    step: int  # index of the step in the schedule, from 0
    timestep: float  # the scheduler's
    s_hat: torch.Tensor  # (B,) raw scale before softplus, after the step
    t_hat: torch.Tensor  # (B,) raw shift likewise
    g_s: torch.Tensor  # (B,) global scale in use, metres
    loss: torch.Tensor | None = None  # (B,) total before the round's updates; None without updates
    terms: dict[str, torch.Tensor] = field(default_factory=dict)  # (B,) unweighted value of each, by name
    visible_fraction: torch.Tensor | None = None  # (B,) pixels that a right view sees; 0 without a view

    def cpu(self) -> StepReport:
        """The same on the CPU."""
        here: dict[str, Any] = {k: v.cpu() for k, v in vars(self).items() if isinstance(v, torch.Tensor)}
        return replace(self, **here, terms={name: value.cpu() for name, value in self.terms.items()})


@dataclass(frozen=True)
class Indicators:
    """Numbers of one image's run; NaN where unknown."""

    confidence: float = math.nan  # mean of the confidence, [0, 1], also where depth is out of reach
    matched: float = math.nan  # share of the left image with a match that both views agree on, [0, 1]
    rank_correlation: float = math.nan  # of the prior's first map with matches or points, [-1, 1]
    spread: float = math.nan  # of the matched depths, log of their 95 % over their 5 % quantile
    points_ratio: float = math.nan  # median of known points over matched depths at the same places
    points_off: float = math.nan  # share of the points that differ from the matches by 1.2 or more
    centre_assumed: bool = False  # the right camera's cx is assumed to be the left one's
    points: int = 0  # number of known depths within the image
    cover: float = 0.0  # share of 8x8 equal parts of the image in which they lie
    range_given: bool = False  # the user gave the range of depths
    at_end: float = 0.0  # share of the confident matches on the first or the last plane of a given range
    baseline_m: float = 0.0  # distance of the first right camera; 0 without one, or where it has no unit
    scene_m: float = math.nan  # median of the matched depths, if lengths are in metres
    rectified: bool = False  # the cameras of the first pair are parallel, and one stands beside the other
    view_deg: float = math.nan  # horizontal field of view that K gives the left image
    prior_ratio: float = math.nan  # median of the depth over a metric prior's depth
    epipolar_px: float = math.nan  # median distance of matches from their epipolar lines, the worst view's
    given_px: float = math.nan  # the same distance under the poses as given
    scale_spread: float = math.nan  # relative standard deviation of the scale of the poses, if in metres
    depth_spread: float = math.nan  # median change of log depth by another pose that fits as well
    straightened_px: float = math.nan  # root mean square that no pose explains, the worst view's
    behind_infinity: float = math.nan  # share of the matches at which the two cameras' rays diverge
    behind_px: float = math.nan  # how far behind infinity the farthest lie, pixels of the left image
    distortion: float = math.nan  # k1 that both pictures still have for certain
    distortion_alone: float = math.nan  # what of it neither a turn nor a shear of the right picture explains
    tear: Tear | None = None  # where a picture is torn
    exchangeable: float = math.nan  # share of the matches that fit as well with near and far exchanged
    occlusion: float = math.nan  # [-1, 1], below 0 where what is matched as far hides what is near
    moved: float = math.nan  # share of the matches in parts that moved across the lines of the given pose
    bars: float = 0.0  # width of bars at opposite sides of all pictures, as a share of that side
    shear: float = math.nan  # of the right picture from its first row to its last, in shares of its width
    off_matches: float = math.nan  # median of the absolute log of the depth over the matched depth
    doubts: tuple[Message, ...] = ()  # warnings about the input, each of which forbids trust
    pose_unchecked: bool = False  # too few matches show whether the poses are right
    mistakes: tuple[Message, ...] = ()  # of a given pose, that would explain its misfit (``pose.mistakes``)
    flat: bool = False  # all confident matches lie within two planes, and near enough to mean something
    same: bool = False  # the left and a right view are the same picture
    inverse_fits: bool = False  # the inverse pose matches clearly more
    on_edge: bool = False  # the search for the scale ended on the edge of its range


@dataclass(frozen=True)
class Verdict:
    """Whether one image's depth can be trusted: whether anything in the pictures speaks against it.

    They cannot show a wrong length of the baseline, nor, of a rectified pair, a wrong focal length. Of what
    shifts matches along their epipolar lines (cx of the right camera, the yaw of nearly parallel ones, a
    stretched picture, a rolling shutter, moving things) they show what puts things behind infinity, a torn
    picture, a shear of upright lines, and where far things hide near ones.
    """

    status: str  # "trusted", "not trusted", or "not judged": there was nothing to compare it with
    reasons: tuple[Message, ...]  # what speaks against it, the likeliest cause first
    remarks: tuple[Message, ...]  # what is unusual but may be right
    indicators: Indicators

    @property
    def message(self) -> Message | None:
        """The verdict for the user; ``None`` where it is trusted."""
        if self.trusted:
            return None
        if self.status == "not judged":
            return Message("verdict.not-judged", f"This depth was not judged: {UNTESTED}.")
        return Message("verdict.not-trusted", f"Do not trust this depth: {' '.join(self.reasons)}")

    @property
    def sentence(self) -> str:
        """The sentence of ``message``; empty where it is trusted."""
        return self.message or ""

    @property
    def trusted(self) -> bool:
        """Whether the status is ``"trusted"``."""
        return self.status == "trusted"


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """Depth of one frame of a capture, as it goes from the runs to agreement and the cloud."""

    name: str
    depth: np.ndarray  # (H, W) z
    confidence: np.ndarray  # (H, W) in [0, 1]
    K: np.ndarray  # (3, 3) pixels
    E: np.ndarray  # (4, 4) camera-to-world
    confirmed: np.ndarray | None = None  # (H, W) how many other frames have the same depth there
    observers: np.ndarray | None = None  # (H, W) how many see the point by this depth, or something before it

    def world(self, mask: np.ndarray | None = None) -> np.ndarray:
        """``(N, 3)`` points of the pixels of a mask, by default of all, in the world's frame."""
        v, u = np.nonzero(np.ones(self.depth.shape, bool) if mask is None else mask)
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(self.K).T
        return rays * self.depth[v, u][:, None] @ self.E[:3, :3].T + self.E[:3, 3]
