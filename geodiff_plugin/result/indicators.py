"""Measures ``Indicators``: the numbers of one image's result by which its verdict is decided."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin._strips import row_strips
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import constant_like, image_size, is_rectified
from geodiff_plugin.matching import Matches
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.pose.tracks import LONG_SIDE
from geodiff_plugin.types import Indicators, PosedViews, PoseReport

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
#: Upper bound on the values that are sorted for a quantile; torch's own is four times as many.
MOST_SORTED = 1 << 22
#: Quantiles of inverse depth that are the ends of a scene.
ENDS = (0.05, 0.95)
#: Log of the ratio of the 95 % and the 5 % quantile of depth below which a scene may be one plane.
FLAT = 0.2
#: A point that differs from the matches by this factor contradicts them (log).
POINTS_WRONG = math.log(1.2)


def pixels_of_matches(size: tuple[int, int]) -> float:
    """Pixels of a left image of ``size`` ``(H, W)`` in a pixel of the grid that poses are checked on."""
    return max(1.0, max(size) / LONG_SIDE)


def read_numbers(numbers: Mapping[str, Tensor]) -> dict[str, float]:
    """Numbers ``()`` that lie on a device, read together: every read waits for the device."""
    if not numbers:
        return {}
    return dict(zip(numbers, torch.stack([x.float() for x in numbers.values()]).tolist(), strict=True))


def measure_indicators(evidence: Evidence, depth_m: Tensor, range_given: bool) -> dict[str, Tensor]:
    """What of the indicators has to be measured on the maps of one image, ``()`` each, on their device.

    ``depth_m (1, 1, H, W)`` is its result; ``range_given``: the user gave the range of the search.
    """
    numbers: dict[str, Tensor] = {}
    left_01 = evidence.native.left_01
    same_size = [view for view in evidence.native.views if view.image_01.shape == left_01.shape]
    if same_size:
        differences = [_largest_difference(view.image_01, left_01) for view in same_size]
        darkest, brightest = left_01.aminmax()
        numbers |= {"difference": _joined(torch.amin, differences), "contrast": brightest - darkest}
    matches, points, volume = evidence.matches, evidence.points, evidence.volume
    if matches is not None:
        planes = volume.inverse_depth if range_given and volume is not None else None
        numbers |= _measure_matches(matches, depth_m, planes)
        if points is not None:
            numbers |= _measure_points(matches, points)
    if points is not None:
        known = (points.confidence > 0).float()
        numbers |= {"points": known.sum(), "cover": F.adaptive_max_pool2d(known, 8).mean()}
    return numbers


def _largest_difference(image_01: Tensor, left_01: Tensor) -> Tensor:
    """The largest difference ``()`` of two images of one size, strip by strip to spare memory."""
    strips = row_strips(*image_size(left_01))
    return _joined(torch.amax, [(image_01[:, rows] - left_01[:, rows]).abs().amax() for rows in strips])


def _joined(reduced: Callable[[Tensor], Tensor], numbers: Sequence[Tensor]) -> Tensor:
    """Numbers ``()`` reduced to one; a single one as it is, without a launch."""
    return numbers[0] if len(numbers) == 1 else reduced(torch.stack(list(numbers)))


def _where(values: Tensor, at: Tensor) -> Tensor:
    """The values of a mask, and NaN elsewhere: a selection has a size that only the device knows."""
    return torch.where(at, values, torch.nan)


def _measure_points(matches: Matches, points: Matches) -> dict[str, Tensor]:
    """Median ratio of points to matched depths, the share that differs, and how many are compared."""
    confident = (matches.confidence > CONFIDENT).float()
    window = (2 * REACH_PX + 1, 1, REACH_PX)
    near = F.avg_pool2d(confident[None], *window)[0]
    mean = F.avg_pool2d((confident * matches.inverse_depth)[None], *window)[0] / near.clamp_min(1e-6)
    at = (points.confidence > 0) & (near > 0) & (mean > matches.plane_step)
    ratio = _where(mean / points.inverse_depth, at)
    off = (ratio.log().abs() > POINTS_WRONG) & at
    compared = at.sum()
    return {
        "points_ratio": ratio.flatten().nanmedian(),
        "points_off": off.sum() / compared.clamp_min(1),
        "points_compared": compared,
    }


def _measure_matches(matches: Matches, depth_m: Tensor, planes: Tensor | None) -> dict[str, Tensor]:
    """Share matched, spread of the depths, deviation of the result, share on the first or last plane."""
    resized = F.interpolate(depth_m.float(), matches.size, mode="nearest-exact")[0]
    numbers = _of_matches_and_depth(matches, resized)
    if planes is not None:
        in_front = (matches.confidence > CONFIDENT) & (matches.inverse_depth > 0)
        off = ((matches.inverse_depth - planes[end]).abs() for end in (0, -1))
        first, last = (in_front & (each < 0.75 * matches.plane_step) for each in off)
        numbers["at_end"] = (first | last).sum() / in_front.sum().clamp_min(1)
    return numbers


def _of_matches_and_depth(matches: Matches, depth_m: Tensor) -> dict[str, Tensor]:
    """What of ``_measure_matches`` every image has, for ``depth_m (1, H, W)`` on the grid of the matches."""
    every = max(1, depth_m.numel() // MOST_SORTED)
    if use_kernel(depth_m) and every == 1:
        from geodiff_plugin.result import indicator_kernels as kernels

        return kernels.of_matches(matches, depth_m)
    confident, step = matches.confidence > CONFIDENT, matches.plane_step
    in_front = confident & (matches.inverse_depth > 0)
    sample = _where(matches.inverse_depth, in_front).flatten()[::every]
    low, high = torch.nanquantile(sample, constant_like(sample, *ENDS)).unbind()
    numbers = {"matched": confident.float().mean(), "in_front": in_front.sum()}
    numbers |= {"spread": (high / low.clamp_min(1e-9)).log(), "planes_apart": (high - low) / step}
    numbers |= {"scene_m": 1.0 / sample.nanmedian()}
    at = confident & (matches.inverse_depth > step)
    off = _where((depth_m * matches.inverse_depth).log().abs(), at)
    return numbers | {"off_matches": off.flatten().nanmedian(), "off_where": at.sum()}


def pose_of(evidence: Evidence) -> PoseReport | None:
    """How the poses fit; ``None`` without a right view. On CUDA the check may not have ended before."""
    return None if evidence.report is None else evidence.report.result()


def warnings_of(evidence: Evidence) -> tuple[Message, ...]:
    """What the check of the poses and the matching warn of; both may find the same mistake."""
    pose = pose_of(evidence)
    return distinct(() if pose is None else pose.warnings, evidence.noticed)


def indicators_of(
    evidence: Evidence, numbers: Mapping[str, float], has_unit: bool = True, **further: Any
) -> Indicators:
    """The indicators of one image, from ``measure_indicators``, as ``read_numbers`` reads them.

    ``further`` are indicators that are known already. ``has_unit``: lengths are in metres, so that the
    length of a baseline means something.
    """
    pose, native = pose_of(evidence), evidence.native
    known: dict[str, Any] = {name: numbers[name] for name in ("matched", "cover") if name in numbers}
    known |= {"points": round(numbers["points"])} if "points" in numbers else {}
    known |= _of_matches(numbers)
    known |= further
    if native.views:
        known |= _of_baseline(native, numbers, has_unit)
    if pose is not None:
        for name, residuals in (("epipolar_px", pose.residual_px), ("given_px", pose.residual_px_given)):
            known[name] = max((px for px in residuals if not math.isnan(px)), default=math.nan)
        known |= {"behind_infinity": pose.behind_infinity, "distortion": pose.distortion}
        known |= {"distortion_alone": pose.distortion_alone, "tear": pose.tear}
        known |= {"exchangeable": pose.exchangeable, "moved": pose.moved, "bars": pose.bars}
        known["depth_spread"] = pose.depth_spread
        known["straightened_px"] = max(pose.straightened_px, default=0.0)
        if not math.isnan(pose.behind_px):  # a product would be another NaN, and verdicts would differ by it
            known["behind_px"] = pose.behind_px * pixels_of_matches(native.size)
        known["pose_unchecked"] = pose.status == "not checked"
        known["mistakes"] = tuple(m for m in pose.warnings if m.forbids_trust and m.code != INVERSE.code)
    of_rows = None if evidence.rows is None else evidence.rows.result().checks.result()
    if of_rows is not None:
        known["occlusion"] = of_rows.occlusion
    if of_rows is not None and not math.isnan(of_rows.shear):  # a product would be another NaN, as above
        known["shear"] = of_rows.shear * native.size[0] / native.size[1]  # pixels are square on its grid
    if native.views and has_unit:
        known["scale_spread"] = (pose and pose.scale_spread) or math.nan
    half_width = 0.5 * native.size[1]
    return Indicators(
        **known,
        view_deg=2.0 * math.degrees(math.atan(half_width / float(native.K_left[0, 0]))),
        same=_is_same(numbers),
        inverse_fits=any(message.code == INVERSE.code for message in warnings_of(evidence)),
    )


def _of_baseline(native: PosedViews, numbers: Mapping[str, float], has_unit: bool) -> dict[str, Any]:
    """What the cameras of the first pair say, and the scene under their baseline."""
    view = native.views[0]
    known: dict[str, Any] = {"rectified": bool(is_rectified(native.K_left, view.K, view.T_right_from_left))}
    if has_unit:
        known["baseline_m"] = float(view.T_right_from_left[:3, 3].norm())
        if numbers.get("in_front", 0) >= FEWEST_MATCHES:
            known["scene_m"] = numbers["scene_m"]
    return known


def _of_matches(numbers: Mapping[str, float]) -> dict[str, Any]:
    """Indicators that say something only if enough matches, or points, were compared."""
    known: dict[str, Any] = {}
    if numbers.get("in_front", 0) >= FEWEST_MATCHES:
        spread = numbers["spread"]
        known |= {"spread": spread, "flat": spread < FLAT and numbers["planes_apart"] < 2.0}
        known |= {name: numbers[name] for name in ("at_end",) if name in numbers}
    if numbers.get("off_where", 0) >= FEWEST_MATCHES:
        known["off_matches"] = numbers["off_matches"]
    if numbers.get("points_compared", 0) >= FEWEST_COMPARED:
        known |= {name: numbers[name] for name in ("points_ratio", "points_off")}
    return known


def _is_same(numbers: Mapping[str, float]) -> bool:
    """Whether no value of a right view differs from the left one by more than rounding."""
    return numbers.get("difference", math.inf) < min(SAME, SAME_SHARE * numbers.get("contrast", 0.0))
