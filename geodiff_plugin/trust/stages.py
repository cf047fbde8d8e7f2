"""Define the stages of a call at which checks measure, and the data of each stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.findings import Finding
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.gaps import Gaps
from geodiff_plugin.pose.tracks import LONG_SIDE, Tracks
from geodiff_plugin.trust.match_statistics import match_statistics
from geodiff_plugin.types import PoseReport

#: Valid pixels form a rectangle if they make up more than this fraction of their bounding box.
RECTANGULAR = 0.98


@dataclass(frozen=True)
class Call:
    """Facts that do not depend on the images of a call."""

    has_unit: bool = True  # whether lengths are in metres
    range_given: bool = False  # whether the user gave the depth range
    findings: tuple[Finding, ...] = ()  # input findings: reasons and assumptions
    calibrated: bool = False  # whether K is from a file, or the field of view is given


class ImagesStage(NamedTuple):
    """All images of one sample, before any matching."""

    greys: Sequence[np.ndarray]  # (H, W) uint8 each, the left image first
    heights: Sequence[int]  # heights of the images before resizing, pixels
    valid: Sequence[np.ndarray | None] = ()  # (H, W) bool, valid pixels of each image; None or empty for all

    @property
    def masks(self) -> Sequence[np.ndarray | None]:
        """``valid`` with an entry for each image."""
        return self.valid or [None] * len(self.greys)

    @property
    def has_rectangles(self) -> bool:
        """Whether the valid pixels of every image form a rectangle."""
        masks = [mask for mask in self.valid if mask is not None]
        return all(mask[np.ix_(mask.any(1), mask.any(0))].mean() > RECTANGULAR for mask in masks)

    @property
    def in_black(self) -> list[np.ndarray]:
        """The images with black in place of pixels that are not valid."""
        pairs = zip(self.greys, self.masks, strict=True)
        return [grey if mask is None else np.where(mask, grey, np.uint8(0)) for grey, mask in pairs]


def grid_px(size: tuple[int, int]) -> float:
    """Return the number of pixels of a left image of ``size`` ``(H, W)`` per pixel of the tracks."""
    return max(1.0, max(size) / LONG_SIDE)


class TracksStage(NamedTuple):
    """Sparse matches, before pose refinement."""

    tracks: Tracks
    given: np.ndarray  # (V, 4, 4) given T_right_from_left
    nearby: np.ndarray  # (V, 4, 4) best-fitting poses near the given ones
    sizes: Sequence[tuple[int, ...]]  # (H, W) of the images of the tracks, the left image first
    size: tuple[int, int]  # (H, W) of the left image at its original size

    @property
    def grid_px(self) -> float:
        """Pixels of the left image per pixel of the tracks."""
        return grid_px(self.size)


class PosesStage(NamedTuple):
    """The poses in use, with the matches used to refine them."""

    report: PoseReport
    tracks: Tracks | None  # None if no poses were checked
    used: np.ndarray  # (V, 4, 4) T_right_from_left
    size: tuple[int, int]  # (H, W) of the left image

    @property
    def grid_px(self) -> float:
        """Pixels of the left image per pixel of the tracks."""
        return grid_px(self.size)


class MatchesStage(NamedTuple):
    """The dense matches of the views."""

    native: PosedViews
    matches: Matches | None


class RowsStage(NamedTuple):
    """Matches along the rows of a rectified pair, mirrored if its second view is on the left."""

    grey: np.ndarray  # (H, W) uint8, left image
    shift: np.ndarray  # (H, W) disparity in pixels relative to infinity, >= 0
    matched: np.ndarray  # (H, W) bool, whether the disparity is known
    gaps: Gaps  # runs of pixels with unknown disparity
    lines: np.ndarray  # (N, 4) endpoints x, y, x, y of near-vertical lines in the left image
    size: tuple[int, int]  # (H, W) of the left image at its original size


@dataclass(frozen=True, eq=False)
class ResultStage:
    """The result of one image. Tensors are on the device of the call; scalars have the shape ``()``."""

    call: Call
    native: PosedViews
    matches: Matches | None
    points: Matches | None
    depth_m: Tensor  # (1, 1, H, W)
    planes: Tensor | None = None  # (D,) inverse depths of the sweep, 1/m
    points_outside: int = 0  # number of known points outside the left image
    confidence: Tensor | None = None  # (1, 1, H, W) in [0, 1]
    visible: Tensor | None = None  # (1, 1, H, W) whether a right view sees the pixel
    rank_correlation: Tensor | None = None  # (), rank correlation of the prior's first map with the evidence
    prior_error: Tensor | None = None  # (), error of the prior's map, log depth
    on_edge: Tensor | None = None  # (), whether the scale search ended at the edge of its range
    over_prior: Tensor | None = None  # (E, N) ratio to a metric prior's depth, NaN where not valid

    def mean(self, values: Tensor) -> Tensor:
        """Mean ``()`` of a map ``(1, 1, H, W)`` on any grid over the valid pixels of the left image."""
        if self.native.left.valid is None:
            return values.float().mean()
        mask = self.native.left.valid[None, None].float()
        valid = F.interpolate(mask, values.shape[-2:], mode="nearest-exact")
        return (values * valid).sum() / valid.sum().clamp_min(1.0)

    @property
    def valid_fraction(self) -> Tensor | float:
        """Fraction of the left image that is valid."""
        valid = self.native.left.valid
        return 1.0 if valid is None else valid.float().mean()

    @cached_property
    def matched(self) -> dict[str, Tensor]:
        """``match_statistics`` of the matches; empty without matches."""
        return {} if self.matches is None else match_statistics(self.matches, self.depth_m)
