"""Frozen records that travel between the layers.

Hop: files and user input -> ``View``, ``Rig`` -> guidance -> ``StepReport``, ``MetricDepthOutput``.
Paper: S3.3 (two views with known cameras).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from diffusers.utils import BaseOutput

__all__ = ["MetricDepthOutput", "Rig", "StepReport", "View"]


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

    Convention:
        A right camera 0.12 m to the right of the left one has ``E[0, 3] == +0.12``.
    """

    K_left: np.ndarray
    K_right: np.ndarray
    E: np.ndarray
    size_left: tuple[int, int] | None = None
    size_right: tuple[int, int] | None = None
    source: str = "arguments"

    @property
    def T_right_from_left(self) -> np.ndarray:
        """``(4, 4)`` float64, takes points from the left camera's frame to the right one's."""
        return np.linalg.inv(self.E)


@dataclass(frozen=True)
class View:
    """One camera's images and geometry, batched.

    Attributes:
        image_01: ``(B, 3, H, W)`` float32 in [0, 1].
        K: ``(B, 3, 3)`` float32, pixels of this image.
    """

    image_01: torch.Tensor
    K: torch.Tensor

    @property
    def size(self) -> tuple[int, int]:
        """``(H, W)`` of the image."""
        return self.image_01.shape[-2], self.image_01.shape[-1]


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
        uncertainty: metres (median absolute deviation of the members), shaped as ``prediction``; ``None``
            unless ``output_uncertainty=True`` asked for it, of two members or more.
        latent: ``(N * E, 4, h, w)`` final latents, with ``output_latent=True``.
        relative: median unclipped relative depth, about [0, 1], shaped as ``prediction``.
        scale: ``(N, E)`` softplus of the learnt scale.
        shift: ``(N, E)`` softplus of the learnt shift.
        global_scale: ``(N, E)`` metres, the pre-selected g_s of Eq. 16.
        visible: boolean, in front of a right camera and inside its image, shaped as ``prediction``; ``None``
            without a right view.
        photometric_error: [0, 1] mean absolute difference to the left image re-rendered from the right view
            that explains the pixel best, 0 where not visible; ``None`` without a right view.
        confidence: [0, 1] probability that the depth is within 10 % of the truth, shaped as ``prediction``:
            from matches near on the same surface, photometric error and, where it is given, uncertainty;
            ``None`` without ``refine``, or without matches and points.
        K: ``(N, 3, 3)`` intrinsics of the output grid, pixels.
        history: one ``StepReport`` a step and batch chunk.
        extras: further maps of the prior by name (GeoWizard's ``"normals"``), shaped as ``prediction`` with
            their own channels.
        warnings: what the user should know about this result, as sentences.
    """

    prediction: np.ndarray | torch.Tensor
    uncertainty: np.ndarray | torch.Tensor | None = None
    latent: torch.Tensor | None = None
    relative: np.ndarray | torch.Tensor | None = None
    scale: torch.Tensor | None = None
    shift: torch.Tensor | None = None
    global_scale: torch.Tensor | None = None
    visible: np.ndarray | torch.Tensor | None = None
    photometric_error: np.ndarray | torch.Tensor | None = None
    confidence: np.ndarray | torch.Tensor | None = None
    K: np.ndarray | torch.Tensor | None = None
    history: list[StepReport] = field(default_factory=list)
    extras: dict[str, np.ndarray | torch.Tensor] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
