"""What is known beside the prior: matches and points, and which of them are believed.

Data flow: matches less reflections, and points + metric depth of an estimate -> that depth refined.
Paper: none; its only evidence is the photometric error of Eq. 14 (eq:geo-loss).

One object answers for both grids: that of the losses, at every step, and that of the sweep, for the output.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.correction import Refined, off_edges, prior_error, refine_depth
from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.terms.base import MatchTarget
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry.cameras import image_size
from geodiff_plugin.matching import Matches, reject_reflections, with_points

__all__ = ["Known", "stacked"]


@dataclass(frozen=True)
class Known:
    """Matches and points of some samples on one grid.

    Attributes:
        config: the rejection of reflections and the fit.
        matches: what the views say by themselves, or ``None``.
        points: what the user knows, or ``None``.
        kept: ``(B, 1, h, w)`` in [0, 1] on any grid, the share of each match's confidence that remains once
            reflections are rejected; ``None`` before the prior's first estimate.
        error: ``(B, 1, 1, 1)`` of that estimate in log depth, as ``correction.prior_error`` measures it.
    """

    config: GuidanceConfig
    matches: MatchTarget | None
    points: MatchTarget | None
    kept: Tensor | None = None
    error: Tensor | None = None

    @classmethod
    def of(
        cls,
        evidence: Sequence[Evidence],
        config: GuidanceConfig,
        grid: Literal["loss", "sweep"],
        kept: Tensor | None = None,
        error: Tensor | None = None,
    ) -> Self:
        """Stack what is known of some samples.

        Args:
            evidence: of every sample, one after the other.
            config: hyperparameters.
            grid: that of the losses, or that of the sweep, which is finer for wide images.
            kept: as the attribute.
            error: likewise.
        """
        found = [e.matches if grid == "loss" else e.sweep_matches for e in evidence]
        points = [e.points if grid == "loss" else e.sweep_points for e in evidence]
        return cls(config, stacked(found), stacked(points), kept, error)

    @property
    def size(self) -> tuple[int, int] | None:
        """``(h, w)`` of the grid; ``None`` where nothing is known."""
        target = self.matches or self.points
        return None if target is None else (target.confidence.shape[-2], target.confidence.shape[-1])

    def judged(self, depth_m: Tensor, left_01: Tensor) -> Self:
        """With ``kept`` and ``error`` by the prior's first estimate; later ones change nothing.

        Args:
            depth_m: ``(B, 1, h, w)`` metres, its scale settled.
            left_01: ``(B, 3, h', w')`` in [0, 1].
        """
        if self.error is not None or (self.matches is None and self.points is None):
            return self
        kept, config = self.kept, self.config
        if self.matches is not None and kept is None:
            rejects = config.reject_reflections
            kept = reject_reflections(self.matches, depth_m) if rejects else torch.ones_like(depth_m)
        known = replace(self, kept=kept)
        target = known.target(depth_m) if config.correct or config.refine else None
        return (
            known if target is None else replace(known, error=prior_error(depth_m, target, left_01, config))
        )

    def of_sample(self, index: int) -> tuple[Tensor | None, Tensor | None]:
        """``kept (1, h, w)`` and ``error (1, 1, 1)`` of one sample."""
        return (
            None if self.kept is None else self.kept[index],
            None if self.error is None else self.error[index],
        )

    @property
    def usable_matches(self) -> MatchTarget | None:
        """The matches less those that look like reflections; ``None`` before the prior's first estimate."""
        if self.matches is None or self.kept is None:
            return None
        kept = _resized(self.kept, image_size(self.matches.confidence))
        return replace(self.matches, confidence=kept * self.matches.confidence)

    def target(self, depth_m: Tensor) -> MatchTarget | None:
        """What an estimate is refined by: usable matches, and points; ``None`` without either."""
        matches = self.usable_matches
        if matches is not None and self.error is not None:
            matches = off_edges(matches, depth_m, self.error)
        return matches if self.points is None else with_points(matches, self.points)

    def refine(self, depth_m: Tensor, left_01: Tensor) -> Refined | None:
        """An estimate fitted to what is known, edge-aware; ``None`` where nothing is.

        Args:
            depth_m: ``(B, 1, H, W)`` metres, at any resolution.
            left_01: ``(B, 3, h, w)`` in [0, 1], the left images at any resolution.
        """
        target = self.target(depth_m)
        if target is None or self.error is None:
            return None
        return refine_depth(depth_m, target, left_01, self.error, self.config)


def _resized(values: Tensor, size: tuple[int, int]) -> Tensor:
    if image_size(values) == size:
        return values
    return F.interpolate(values, size, mode="bilinear", align_corners=False)


def stacked(found: Sequence[Matches | None]) -> MatchTarget | None:
    """Matches, or points, of every sample, on one grid; ``None`` where there are none."""
    given = [one for one in found if one is not None]
    if len(given) < len(found):
        return None
    return MatchTarget(
        torch.stack([one.inverse_depth for one in given]),
        torch.stack([one.confidence for one in given]),
        torch.stack([one.plane_step for one in given]),
    )
