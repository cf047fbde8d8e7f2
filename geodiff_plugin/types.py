"""Records that travel between the layers: cameras of a pair, a view, what a step did, the output.

Data flow: files and user input -> ``Rig``, ``CameraView`` -> guidance
    -> ``StepReport``, ``MetricDepthOutput``.
Paper: S3.3 (two views with known cameras).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from diffusers.utils import BaseOutput

__all__ = ["CameraView", "Distortion", "MetricDepthOutput", "PoseReport", "Rig", "StepReport"]


@dataclass(frozen=True, eq=False)
class Distortion:
    """What a lens does to the image of a pinhole camera.

    Attributes:
        model: ``"opencv"`` (k1, k2, p1, p2, k3 and so on) or ``"fisheye"`` (k1 to k4).
        coefficients: in OpenCV's order.
    """

    model: str
    coefficients: np.ndarray


@dataclass(frozen=True)
class Rig:
    """Calibration of two pinhole cameras, before any image is seen.

    Attributes:
        K_left: ``(3, 3)`` float64, pixels of the left image.
        K_right: ``(3, 3)`` float64, pixels of the right image.
        E: ``(4, 4)`` float64, metres; pose of the right camera in the left camera's frame.
        size_left: ``(width, height)`` that ``K_left`` is for, or ``None`` where the file does not say.
        size_right: likewise for ``K_right``.
        source: what it was read from, for messages and reports.
        distortion: of the left and the right lens, ``None`` for a pinhole camera.

    Convention:
        A right camera 0.12 m to the right of the left one has ``E[0, 3] == +0.12``.
    """

    K_left: np.ndarray
    K_right: np.ndarray
    E: np.ndarray
    size_left: tuple[int, int] | None = None
    size_right: tuple[int, int] | None = None
    source: str = "arguments"
    distortion: tuple[Distortion | None, Distortion | None] = (None, None)

    @property
    def T_right_from_left(self) -> np.ndarray:
        """``(4, 4)`` float64, takes points from the left camera's frame to the right one's."""
        return np.linalg.inv(self.E)


@dataclass(frozen=True, eq=False)
class PoseReport:
    """How the poses of one left image's right views fit the images, and what was made of them.

    Pixels are those of the right images at the left one's pixels per radian, the left one at most 832 wide.

    Attributes:
        status: ``"given"`` (not looked at), ``"fits"``, ``"refined"``, ``"kept"`` (no better pose is near),
            ``"mistaken"`` (a mistake explains the misfit; the pose is used as given) or ``"not checked"``.
        E_given: ``(4, 4)`` each, metres, pose of every right camera in the left camera's frame, as given.
        E: the same as used.
        residual_px_given: median distance of the matches from their epipolar lines, one a right view.
        residual_px: the same with the poses, and images, as used.
        matches: how many of them, one a right view.
        straightened_px: root mean square of the right images' displacement, 0 for none.
        warnings: sentences for the user.
    """

    status: str
    E_given: tuple[np.ndarray, ...]
    E: tuple[np.ndarray, ...]
    residual_px_given: tuple[float, ...] = ()
    residual_px: tuple[float, ...] = ()
    matches: tuple[float, ...] = ()
    straightened_px: tuple[float, ...] = ()
    warnings: tuple[str, ...] = ()

    def changed(self, **fields: Any) -> Self:
        """The same report with other entries."""
        return replace(self, **fields)


class CameraView(NamedTuple):
    """An image beside the left one, and its camera.

    Attributes:
        image_01: ``(C, H, W)`` float32 in [0, 1], C = 3, or 1 for grey.
        K: ``(3, 3)`` float32, pixels of this image.
        T_right_from_left: ``(4, 4)`` float32, metres; takes points of the left camera's frame to this one's.
    """

    image_01: torch.Tensor
    K: torch.Tensor
    T_right_from_left: torch.Tensor


@dataclass(frozen=True)
class StepReport:
    """What one guided denoising step did, one entry per sample of the batch.

    Attributes:
        step: index of the step in the schedule, from 0.
        timestep: the scheduler's timestep.
        loss: ``(B,)`` total loss at the start of the step's updates.
        terms: ``(B,)`` unweighted value of every term, by name.
        s_hat: ``(B,)`` raw scale before softplus, after the step.
        t_hat: ``(B,)`` raw shift before softplus, after the step.
        g_s: ``(B,)`` global scale in use, metres.
        visible_fraction: ``(B,)`` share of the pixels that a right view sees; 0 without one.
    """

    step: int
    timestep: float
    loss: torch.Tensor
    terms: dict[str, torch.Tensor]
    s_hat: torch.Tensor
    t_hat: torch.Tensor
    g_s: torch.Tensor
    visible_fraction: torch.Tensor


@dataclass
class MetricDepthOutput(BaseOutput):
    """Metric depth and all that is known about it.

    ``N`` images, ``E`` ensemble members, ``H W`` the resolution of the input image (or of the
    processing grid with ``match_input_resolution=False``).

    Attributes:
        prediction: metres; ``(N, H, W, 1)`` numpy or ``(N, 1, H, W)`` torch, as ``output_type`` says.
        uncertainty: metres (median absolute deviation of the members from ``prediction``, each refined as it
            was), shaped as ``prediction``; ``None`` unless ``output_uncertainty=True`` asked for it, of two
            members or more.
        latent: ``(N * E, 4, h, w)`` final latents, with ``output_latent=True``.
        relative: median unclipped relative depth, about [0, 1], shaped as ``prediction``.
        scale: ``(N, E)`` softplus of the learnt scale.
        shift: ``(N, E)`` softplus of the learnt shift.
        global_scale: ``(N, E)`` metres, the pre-selected g_s of Eq. 16.
        own_scale: ``(N, E)`` what the metres of a prior that is metric by itself had to be multiplied with,
            median over the pixels; ``None`` for a relative prior.
        visible: boolean, in front of a right camera and inside its image, shaped as ``prediction``; ``None``
            without a right view.
        photometric_error: [0, 1] mean absolute difference to the left image re-rendered from the right view
            that explains the pixel best, 0 where not visible; ``None`` without a right view.
        confidence: [0, 1] probability that the depth is within 10 % of the truth, shaped as ``prediction``:
            from matches near on the same surface, photometric error, the prior's own error and, where it is
            given, uncertainty; ``None`` without ``refine``, or without matches and points.
        support: [0, 1] how far matches and points, own or near on the same surface, decided the depth, shaped
            as ``prediction``; ``None`` where ``confidence`` is.
        prior_error: ``(N,)`` how far the prior alone is wrong, standard deviation in log depth, as left-out
            matches or points tell; ``None`` where none were compared.
        K: ``(N, 3, 3)`` intrinsics of the output grid, pixels.
        history: one ``StepReport`` a step and batch chunk.
        poses: one ``PoseReport`` an image with right views: the poses as given and as used.
        extras: further maps of the prior by name (GeoWizard's ``"normals"``), shaped as ``prediction`` with
            their own channels.
        judgements: for every image whether its depth is to be trusted, and why not
            (``runtime.judgement.Judgement``).
        unit: ``"m"``, or ``None`` where poses were estimated and no length is known: what is said to be in
            metres is then in baselines of the first two cameras.
        scale_from: where the unit of estimated poses comes from: ``"baseline"``, ``"known length"``,
            ``"points"``, ``"prior"`` or ``"none"``; ``None`` for given poses.
        scale_spread: relative spread of that scale, as matches or the prior's map show it; ``None`` where
            they cannot.
        rescaled: what the lengths of ``GeometryGuidance`` are to be multiplied with to be metres, where the
            prior alone knew the unit.
        warnings: what the user should know about this result, as sentences; those of the judgements too.
    """

    prediction: np.ndarray | torch.Tensor
    uncertainty: np.ndarray | torch.Tensor | None = None
    latent: torch.Tensor | None = None
    relative: np.ndarray | torch.Tensor | None = None
    scale: torch.Tensor | None = None
    shift: torch.Tensor | None = None
    global_scale: torch.Tensor | None = None
    own_scale: torch.Tensor | None = None
    visible: np.ndarray | torch.Tensor | None = None
    photometric_error: np.ndarray | torch.Tensor | None = None
    confidence: np.ndarray | torch.Tensor | None = None
    support: np.ndarray | torch.Tensor | None = None
    prior_error: torch.Tensor | None = None
    K: np.ndarray | torch.Tensor | None = None
    history: list[StepReport] = field(default_factory=list)
    poses: list[PoseReport] = field(default_factory=list)
    unit: str | None = "m"
    scale_from: str | None = None
    scale_spread: float | None = None
    rescaled: float = 1.0
    extras: dict[str, np.ndarray | torch.Tensor] = field(default_factory=dict)
    judgements: list[Any] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
