"""Quality indicators of a finished run, as numbers.

Data flow: evidence, confidence, rank correlation of a call -> one ``Signs`` an image.
Paper: none; the paper takes its calibration for granted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.formats.depth import row_strips
from geodiff_plugin.matching import Matches
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.types import CameraView, PoseReport

__all__ = ["Signs", "read_signs"]

#: A match that counts as one, a pixel of the left image that shows the same as the right one, in [0, 1].
SURE, SAME = 0.5, 1.5 / 255
#: The same, as a share of the left image's contrast: all pictures that are nearly black differ by less.
SAME_SHARE = 0.05
#: Points that are compared with matches: at least so many, each with matches this near, pixels of the grid.
FEWEST_COMPARED, REACH_PX = 12, 3
FEWEST_MATCHES = 40
#: Log of the ratio of the 95 % and the 5 % quantile of depth below which a scene may be one plane.
FLAT = 0.2


@dataclass(frozen=True)
class Signs:
    """Numbers of one image's run; NaN is "does not say".

    Attributes:
        confidence: mean of the confidence map, [0, 1].
        matched: share of the left image with a match that both views agree on, [0, 1].
        order: rank correlation of the prior's first map with matches or points, [-1, 1].
        spread: of the matched depths, log of their 95 % over their 5 % quantile.
        points_ratio: median of known points over matched depths at the same places.
        points: known depths within the image, a number of pixels; 0 without any.
        at_end: share of the sure matches that lie on the first or the last plane of a given range, [0, 1].
        baseline_m: distance of the first right camera; 0 without one, or where it has no unit.
        view_deg: horizontal field of view that K gives the left image.
        own_ratio: of the depth over a metric prior's own, median.
        epipolar_px: how far matches lie beside their epipolar lines, pixels, with the poses as used; of the
            worst right view.
        mistakes: sentences on mistakes of a given pose that would explain its misfit (``pose.mistakes``).
        flat: all sure matches lie within two planes of the sweep, and near enough that it says something.
        same: the left and a right view are one picture.
        inverse_fits: the inverse pose matches clearly more.
        on_edge: the search for the scale ended on the edge of its range.
    """

    confidence: float = math.nan
    matched: float = math.nan
    order: float = math.nan
    spread: float = math.nan
    points_ratio: float = math.nan
    points: int = 0
    at_end: float = 0.0
    baseline_m: float = 0.0
    view_deg: float = math.nan
    own_ratio: float = math.nan
    epipolar_px: float = math.nan
    mistakes: tuple[str, ...] = ()
    flat: bool = False
    same: bool = False
    inverse_fits: bool = False
    on_edge: bool = False


class _OfMatches(TypedDict, total=False):
    """Those of the ``Signs`` that need matches."""

    matched: float
    spread: float
    flat: bool
    at_end: float
    points_ratio: float


def _is_same(left_01: Tensor, rights: Sequence[CameraView]) -> bool:
    return any(image.shape == left_01.shape and _alike(image, left_01) for image, _, _ in rights)


def _alike(one: Tensor, other: Tensor) -> bool:
    """Whether no value differs by more than rounding; most images differ in their first rows."""
    most = 0.0
    for rows in row_strips(*one.shape[-2:]):
        most = max(most, float((one[:, rows] - other[:, rows]).abs().max()))
        if most >= SAME:
            return False
    darkest, brightest = other.aminmax()
    return most < SAME_SHARE * float(brightest - darkest)


def _points_against(matches: Matches, points: Matches) -> float:
    """Median ratio of points to matched depths; NaN for too few that can be compared."""
    sure = (matches.confidence > SURE).float()
    window = (2 * REACH_PX + 1, 1, REACH_PX)
    near = F.avg_pool2d(sure[None], *window)[0]
    mean = F.avg_pool2d((sure * matches.inverse_depth)[None], *window)[0] / near.clamp_min(1e-6)
    at = (points.confidence > 0) & (near > 0) & (mean > matches.plane_step)
    if int(at.sum()) < FEWEST_COMPARED:
        return math.nan
    return float((mean[at] / points.inverse_depth[at]).median())


def _of_matches(matches: Matches, planes: Tensor | None) -> _OfMatches:
    sure = matches.confidence > SURE
    found: _OfMatches = {"matched": float(sure.float().mean())}
    inverse_depth = matches.inverse_depth[sure & (matches.inverse_depth > 0)]
    if len(inverse_depth) >= FEWEST_MATCHES:
        some = inverse_depth[:: max(1, len(inverse_depth) // 100_000)]
        low, high = torch.quantile(some, some.new_tensor([0.05, 0.95]))
        found["spread"] = float((high / low.clamp_min(1e-9)).log())
        found["flat"] = found["spread"] < FLAT and float(high - low) < 2.0 * float(matches.plane_step)
        if planes is not None:
            ends = (inverse_depth - planes[[0, -1], None]).abs().amin(0) < 0.75 * matches.plane_step
            found["at_end"] = float(ends.float().mean())
    return found


def _of_pose(pose: PoseReport) -> dict[str, Any]:
    """How the poses fit, and mistakes that explain why they do not; that the inverse fits is asked apart."""
    measured = [px for px in pose.residual_px if not math.isnan(px)]
    found: dict[str, Any] = {"epipolar_px": max(measured)} if measured else {}
    if pose.status == "mistaken":
        found["mistakes"] = tuple(sentence for sentence in pose.warnings if sentence != INVERSE)
    return found


def read_signs(
    evidence: Evidence,
    left_01: Tensor,
    rights: Sequence[CameraView],
    K_left: Tensor,
    *,
    order: float,
    confidence: Tensor | None,
    on_edge: bool,
    range_given: bool = False,
    own_ratio: float = math.nan,
    has_unit: bool = True,
) -> Signs:
    """The signs of one image.

    Args:
        evidence: of it.
        left_01: ``(3, H, W)`` native left image.
        rights: native further views.
        K_left: ``(3, 3)`` pixels of the native left image.
        order: rank correlation, NaN where unknown.
        confidence: ``(1, H, W)``, or ``None``.
        on_edge: whether the search for the scale ended on the edge of its range.
        range_given: whether that range was given by the user.
        own_ratio: of the depth over a metric prior's own, NaN for a relative prior.
        has_unit: whether lengths are in metres, so that the length of a baseline says something.
    """
    matches, points = evidence.sweep_matches, evidence.sweep_points
    planes = evidence.volume.inverse_depth if range_given and evidence.volume is not None else None
    found: dict[str, Any] = {} if matches is None else {**_of_matches(matches, planes)}
    if matches is not None and points is not None:
        found["points_ratio"] = _points_against(matches, points)
    known = evidence.points
    found |= {} if evidence.pose is None else _of_pose(evidence.pose)
    return Signs(
        **found,
        confidence=math.nan if confidence is None else float(confidence.mean()),
        order=order,
        points=0 if known is None else int((known.confidence > 0).sum()),
        baseline_m=float(rights[0][2][:3, 3].norm()) if rights and has_unit else 0.0,
        view_deg=2.0 * math.degrees(math.atan(0.5 * left_01.shape[-1] / float(K_left[0, 0]))),
        own_ratio=own_ratio,
        same=_is_same(left_01, rights),
        inverse_fits=INVERSE in evidence.warnings,
        on_edge=on_edge,
    )
