"""``Indicators``: the numbers of one image's result by which its verdict is decided."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.formats.depth import row_strips
from geodiff_plugin.matching import Matches
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.mistakes import INVERSE

#: Matches above this confidence count.
CONFIDENT = 0.5
#: Two images whose values in [0, 1] differ by less, one and a half levels of 8 bits, are the same picture.
SAME = 1.5 / 255
#: They also differ by less than this share of their contrast: all nearly black pictures differ by little.
SAME_SHARE = 0.05
#: Least number of points that are compared with matches: the median of fewer is chance.
FEWEST_COMPARED = 12
#: Radius in pixels in which a point has matches: a point rarely hits a matched pixel itself.
REACH_PX = 3
#: Least number of matches that say something about the depths of the scene.
FEWEST_MATCHES = 40
#: Log of the ratio of the 95 % and the 5 % quantile of depth below which a scene may be one plane.
FLAT = 0.2
#: A point that differs from the matches by this factor contradicts them (log).
POINTS_WRONG = math.log(1.2)


@dataclass(frozen=True)
class Indicators:
    """Numbers of one image's run; NaN where unknown."""

    confidence: float = math.nan  # mean of the confidence map, [0, 1]
    matched: float = math.nan  # share of the left image with a match that both views agree on, [0, 1]
    rank_correlation: float = math.nan  # of the prior's first map with matches or points, [-1, 1]
    spread: float = math.nan  # of the matched depths, log of their 95 % over their 5 % quantile
    points_ratio: float = math.nan  # median of known points over matched depths at the same places
    points_off: float = math.nan  # share of the points that differ from the matches by 1.2 or more
    points: int = 0  # number of known depths within the image
    cover: float = 0.0  # share of 8x8 equal parts of the image in which they lie
    at_end: float = 0.0  # share of the confident matches on the first or the last plane of a given range
    baseline_m: float = 0.0  # distance of the first right camera; 0 without one, or where it has no unit
    view_deg: float = math.nan  # horizontal field of view that K gives the left image
    prior_ratio: float = math.nan  # median of the depth over a metric prior's depth
    epipolar_px: float = math.nan  # median distance of matches from their epipolar lines, the worst view's
    given_px: float = math.nan  # the same distance under the poses as given
    scale_spread: float = math.nan  # relative standard deviation of a refined pose's scale, if in metres
    off_matches: float = math.nan  # median of the absolute log of the depth over the matched depth
    doubts: tuple[Message, ...] = ()  # warnings about the input, each of which forbids trust
    mistakes: tuple[Message, ...] = ()  # of a given pose, that would explain its misfit (``pose.mistakes``)
    flat: bool = False  # all confident matches lie within two planes, and near enough to mean something
    same: bool = False  # the left and a right view are the same picture
    inverse_fits: bool = False  # the inverse pose matches clearly more
    on_edge: bool = False  # the search for the scale ended on the edge of its range


def _alike(image_01: Tensor, left_01: Tensor) -> bool:
    """Whether no value differs by more than rounding; most images differ in their first rows."""
    if image_01.shape != left_01.shape:
        return False
    darkest, brightest = left_01.aminmax()
    most, strips = min(SAME, SAME_SHARE * float(brightest - darkest)), row_strips(*left_01.shape[-2:])
    return all(float((image_01[:, rows] - left_01[:, rows]).abs().max()) < most for rows in strips)


def _points_indicators(matches: Matches, points: Matches) -> dict[str, float]:
    """Median ratio of points to matched depths, and the share that differs; empty for too few of them."""
    confident = (matches.confidence > CONFIDENT).float()
    window = (2 * REACH_PX + 1, 1, REACH_PX)
    near = F.avg_pool2d(confident[None], *window)[0]
    mean = F.avg_pool2d((confident * matches.inverse_depth)[None], *window)[0] / near.clamp_min(1e-6)
    at = (points.confidence > 0) & (near > 0) & (mean > matches.plane_step)
    if int(at.sum()) < FEWEST_COMPARED:
        return {}
    ratio = mean[at] / points.inverse_depth[at]
    off = (ratio.log().abs() > POINTS_WRONG).float().mean()
    return {"points_ratio": float(ratio.median()), "points_off": float(off)}


def _match_indicators(matches: Matches, depth_m: Tensor | None, planes: Tensor | None) -> dict[str, Any]:
    """Share matched, spread of the depths, deviation of the result, share on the first or last plane."""
    confident = matches.confidence > CONFIDENT
    numbers: dict[str, Any] = {"matched": float(confident.float().mean())}
    inverse_depth = matches.inverse_depth[confident & (matches.inverse_depth > 0)]
    if len(inverse_depth) >= FEWEST_MATCHES:
        sample = inverse_depth[:: max(1, len(inverse_depth) // 100_000)]
        low, high = torch.quantile(sample, sample.new_tensor([0.05, 0.95]))
        spread = float((high / low.clamp_min(1e-9)).log())
        flat = spread < FLAT and float(high - low) < 2.0 * float(matches.plane_step)
        numbers |= {"spread": spread, "flat": flat}
        if planes is not None:
            ends = (inverse_depth - planes[[0, -1], None]).abs().amin(0) < 0.75 * matches.plane_step
            numbers["at_end"] = float(ends.float().mean())
    at = confident & (matches.inverse_depth > matches.plane_step)
    if depth_m is not None and int(at.sum()) >= FEWEST_MATCHES:
        resized = F.interpolate(depth_m[None].float(), matches.size, mode="nearest-exact")[0]
        numbers["off_matches"] = float((resized * matches.inverse_depth)[at].log().abs().median())
    return numbers


def read_indicators(
    evidence: Evidence,
    depth_m: Tensor | None = None,
    *,
    range_given: bool = False,
    has_unit: bool = True,
    **more: Any,
) -> Indicators:
    """The indicators of one image, of the result ``depth_m (1, H, W)``, and ``more`` that are known already.

    ``range_given``: the user gave the range of the search; ``has_unit``: lengths are in metres, so that the
    length of a baseline means something.
    """
    matches, pose, native = evidence.matches, evidence.pose, evidence.native
    if matches is not None:
        planes = evidence.volume.inverse_depth if range_given and evidence.volume is not None else None
        more |= _match_indicators(matches, depth_m, planes)
        if evidence.points is not None:
            more |= _points_indicators(matches, evidence.points)
    if pose is not None:
        for name, residuals in (("epipolar_px", pose.residual_px), ("given_px", pose.residual_px_given)):
            more[name] = max((px for px in residuals if not math.isnan(px)), default=math.nan)
        if pose.status == "mistaken":
            more["mistakes"] = tuple(m for m in pose.warnings if m.code != INVERSE.code)
    if evidence.points is not None:
        known = (evidence.points.confidence > 0).float()
        more |= {"points": int(known.sum()), "cover": float(F.adaptive_max_pool2d(known, 8).mean())}
    if native.views and has_unit:
        more["baseline_m"] = float(native.views[0].T_right_from_left[:3, 3].norm())
        more["scale_spread"] = (pose and pose.scale_spread) or math.nan
    half_width = 0.5 * native.size[1]
    return Indicators(
        **more,
        view_deg=2.0 * math.degrees(math.atan(half_width / float(native.K_left[0, 0]))),
        same=any(_alike(view.image_01, native.left_01) for view in native.views),
        inverse_fits=any(message.code == INVERSE.code for message in evidence.warnings),
    )
