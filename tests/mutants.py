"""Hand-written slips in the method's numbers, and whether the fast tests notice them.

    python -m tests.mutants [WORD ...]

Each mutant is a file of the package, a text that occurs in it once, and another text in its place. It is
applied in a temporary copy of the checkout, where the fast tests named beside it run until the first fails.
Printed are the mutants that survive, and those whose text is no longer there. With words, only the mutants of
files whose path contains one of them run. Kernels run in Triton's interpreter; without Triton their mutants
are left out.
"""

import importlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("geodiff_plugin", "tests", "examples", "docs", "pyproject.toml", "constraints.txt", "README.md")
OPTIONS = "-x -q -n 0 -p no:cacheprovider -W ignore::pytest.PytestAssertRewriteWarning".split()
PARTS, REFERENCES = "tests/golden/test_parts.py", "tests/parity/test_numpy_references.py"


class Mutant(NamedTuple):
    """A slip: the file below the package, what is there once, what is put there, and the tests that run."""

    file: str
    text: str
    instead: str
    tests: tuple[str, ...] = ()

    @property
    def of_kernel(self) -> bool:
        """Whether it is a slip in a Triton kernel, or in its launch."""
        return self.file.endswith("kernels.py") and "/" in self.file


def of(file: str, *slips: tuple[str, str], tests: tuple[str, ...] = ()) -> list[Mutant]:
    """Mutants of one file; ``tests`` run before the parts and the references."""
    return [Mutant(file, *slip, tests) for slip in slips]


UNIT, KERNELS = "tests/unit/test_", "tests/kernels/test_"
THRESHOLDS = (f"{UNIT}verdict_thresholds.py", f"{UNIT}verdict.py")
CAPTURES = ("tests/parity/test_capture_references.py",)
MUTANTS = [
    *of(
        "geometry.py",
        ("(before[:, :, 2] + half) * scale - half", "before[:, :, 2] * scale"),
        (
            "size_to[1] / size_from[1], size_to[0] / size_from[0]",
            "size_to[0] / size_from[0], size_to[1] / size_from[1]",
        ),
        ("align_corners=False, antialias=True)[0]", "align_corners=False)[0]"),
        ("[0, 0, 1, 1], [0, 1, 1, 2]", "[0, 0, 1], [0, 1, 1]"),
        ("sideways = t[..., 1:]", "sideways = t[..., 1:2]"),
        ("columns, rows, _ = np.minimum", "rows, columns, _ = np.minimum"),
        ("SIDEWAYS_TOLERANCE = 0.01", "SIDEWAYS_TOLERANCE = 0.02"),
    ),
    *of(
        "geometry.py",
        ("/ fx - skew / fx * y", "/ fx + skew / fx * y"),
        ("in_front = z > NEAREST_M", "in_front = z.abs() > NEAREST_M"),
        ("M = K_right @ T_right_from_left[:, :3, :3]", "M = K_left @ T_right_from_left[:, :3, :3]"),
        ("fx * x + skew * y + cx", "fx * x + cx"),
        ("max(width - 1, 1), max(height - 1, 1)", "max(width, 1), max(height, 1)"),
        ("v <= size[0] - 1 + EDGE_PX", "v <= size[1] - 1 + EDGE_PX"),
        ("u <= size[1] - 1 + EDGE_PX", "u <= size[1] + EDGE_PX"),
        ("cell = (uv + 0.5) * scale - 0.5", "cell = uv * scale"),
        ("HIDDEN_MARGIN = 0.05", "HIDDEN_MARGIN = 0.1"),
        tests=(f"{UNIT}geometry.py", f"{UNIT}skew.py"),
    ),
    *of(
        "matching/census.py",
        ("_LUMA = 0.299, 0.587, 0.114", "_LUMA = 0.114, 0.587, 0.299"),
        ("_CONTRAST = 6.0 / 255.0", "_CONTRAST = 8.0 / 255.0"),
        ("(2 * stride, 2, stride, 1)", "(stride, 1, stride, 1)"),
    ),
    *of(
        "matching/aggregation.py",
        ("STEP_PENALTY = 0.15", "STEP_PENALTY = 0.12"),
        ("JUMP_PENALTY = 1.2", "JUMP_PENALTY = 1.0"),
        ("JUMP_CONTRAST = 0.1", "JUMP_CONTRAST = 0.13"),
        ("torch.stack([p2[1:], p2[1:].flip(0)]", "torch.stack([p2[1:], p2[1:]]"),
        ("limits[n - 1] + least", "limits[n - 1]"),
        ("clamp_min(2.0 * STEP_PENALTY)", "clamp_min(STEP_PENALTY)"),
        ("torch.minimum(before, after, out=step).add_(p1)", "before.add(p1, out=step)"),
    ),
    *of(
        "matching/consistency.py",
        ("AGREEMENT_PLANES = 1.5", "AGREEMENT_PLANES = 2.5"),
        ("LOG_ODDS = (5.8, 0.8, -5.9, -0.62)", "LOG_ODDS = (5.3, 0.8, -5.9, -0.62)"),
        ("LOG_ODDS = (5.8, 0.8, -5.9, -0.62)", "LOG_ODDS = (5.8, 0.8, -5.9, -0.55)"),
        ("(margin + 0.03)", "(margin + 0.05)"),
        ("confidence = torch.maximum(confidence,", "confidence = torch.minimum(confidence + 1.0,"),
        ("LEAST_CONTRAST = 0.03", "LEAST_CONTRAST = 0.06"),
        ("0.5 * (other[before, column] + other[after, column])", "other[before, column]"),
        tests=(f"{UNIT}matching.py",),
    ),
    *of(
        "matching/winner.py",
        ("offset = 0.5 * (below - above)", "offset = 0.5 * (above - below)"),
        ("total - UNSEEN_LEVEL * (len(levels) - seen)", "total"),
        ("UNSEEN_LEVEL = 78", "UNSEEN_LEVEL = 60"),
        tests=(f"{UNIT}matching.py",),
    ),
    *of(
        "matching/matches.py",
        ("((uv[inside] + 0.5) * scale).floor()", "(uv[inside] * scale).round()"),
        ('1.0 / z[inside], "amax"', '1.0 / z[inside], "amin"'),
        ("UNIT = 0.01", "UNIT = 0.012"),
        ("confidence = points.confidence / share", "confidence = points.confidence / share.sqrt()"),
        ("LEAST_DISTANCE = 0.2", "LEAST_DISTANCE = 0.25"),
        ("SPREAD_SHARE = 0.6", "SPREAD_SHARE = 0.5"),
        ("MULTIPLE = 1.6", "MULTIPLE = 1.4"),
        ("torch.minimum(region, behind)", "region"),
        ("REGION = 0.08", "REGION = 0.12"),
    ),
    *of(
        "matching/sweep.py",
        ("total += cost * of_view", "total += cost"),
        ("count += of_view", "count += 1"),
        ("torch.where(in_view[plane], cost, unseen)", "cost"),
        tests=(f"{UNIT}matching.py",),
    ),
    *of(
        "matching/planes.py",
        ("0.5 * most)", "most)"),
        ("infinity = K_r @ T[:3, :3]", "infinity = K @ T[:3, :3]"),
        tests=(f"{UNIT}matching.py", f"{UNIT}skew.py"),
    ),
    *of(
        "matching/build.py",
        ("HEADROOM = 1.25", "HEADROOM = 1.1"),
        ("PLANE_STEP_PX = 0.75", "PLANE_STEP_PX = 0.8"),
        ("PILOT_QUANTILE = 0.995", "PILOT_QUANTILE = 0.95"),
        ("turned > _CLEARLY * given", "turned < _CLEARLY * given"),
        tests=(f"{UNIT}matching.py",),
    ),
    *of("matching/alignment.py", ('mode="bicubic"', 'mode="bilinear"')),
    *of(
        "scale/space.py",
        ("FLOOR_EPS = 0.001", "FLOOR_EPS = 0.01"),
        ("g = a * 0.9", "g = a * 0.8"),
        ("g / v**2", "g / v**1.9"),
        ("floored - FLOOR_EPS**2 / floored", "floored"),
        ("self.t_hat**2 * self.units[1]", "self.t_hat * self.units[1]"),
    ),
    *of(
        "scale/points.py",
        ("BASIN_CAUCHY = 32.0", "BASIN_CAUCHY = 8.0"),
        ("BASIN_KEEP = 1.05", "BASIN_KEEP = 1.5"),
        ("FIT_CAUCHY = 2.0", "FIT_CAUCHY = 4.0"),
        ("FIT_NOISE = 0.5", "FIT_NOISE = 1.0"),
        ("nearness = -values if", "nearness = values if"),
        ("confidence, doubt.sqrt(),", "confidence, doubt,"),
        ("NEAR_REACH = 1.4", "NEAR_REACH = 0.7"),
        ("share * below[:, -1:]", "0.5 * below[:, -1:]"),
    ),
    *of(
        "scale/volume_search.py",
        ("COST_CLAMP = 0.35", "COST_CLAMP = 0.4"),
        ("COST_CLAMP * groups.size).sum(1)", "0.0 * groups.size).sum(1)"),
        ("between(groups.seen), groups.size)", "between(groups.seen), 0 * groups.size)"),
        ("weight = position - below", "weight = (position - below).round()"),
        ('mode="nearest-exact").flatten()', 'mode="bilinear").flatten()'),
        ("return IN_VIEW_RECTIFIED if volume.rectified else IN_VIEW_POSED", "return 0.95"),
        ("KEEP_MARGIN = 2e-3", "KEEP_MARGIN = 2e-2"),
        ("far_m >= high * 0.98", "far_m >= high * 1.02"),
        tests=(f"{UNIT}scale_search.py",),
    ),
    *of(
        "algorithm/correction.py",
        ("STIFFNESS_POWER = 4.0", "STIFFNESS_POWER = 3.0"),
        ("REFERENCE_ERROR = 0.05", "REFERENCE_ERROR = 0.06"),
        ("(match_noise / noise) ** 2", "(match_noise / noise)"),
        ("(step / matched) ** 2 + match_noise**2", "match_noise**2 + 0.0 * (step / matched)"),
        ("return scale**2 * torch.exp", "return scale * torch.exp"),
        ("IMAGE_EDGE = 0.1", "IMAGE_EDGE = 0.12"),
        ("DEPTH_EDGE = 0.1", "DEPTH_EDGE = 0.13"),
        ("NORMAL_QUANTILE = 1.2816", "NORMAL_QUANTILE = 1.39"),
        ("noise**2 / 4.0", "noise**2 / 1.0"),
        (
            "torch.where(black, of_white, of_black)",
            "torch.where(black, of_black, of_white)",
        ),
        ("STIFF_SMOOTHNESS = 400.0", "STIFF_SMOOTHNESS = 300.0"),
        ("BLOCK = 0.08", "BLOCK = 0.16"),
        ("INERTIA = 0.015", "INERTIA = 0.02"),
        (".clamp_min(1.0) ** 3", ".clamp_min(1.0) ** 2"),
        ("EDGE_STEP = 0.3", "EDGE_STEP = 0.4"),
        ("RESIDUAL_CAUCHY = 2.5", "RESIDUAL_CAUCHY = 3.0"),
        ('F.interpolate(error, size, mode="nearest-exact")', 'F.interpolate(error, size, mode="bilinear")'),
        ("INERTIA * ratio**STIFFNESS_POWER", "INERTIA * ratio**3"),
        tests=(f"{UNIT}evidence.py", f"{UNIT}algorithm.py"),
    ),
    *of(
        "algorithm/solver.py",
        ("0.5 * across, 0.5 * down", "across, down"),
        ("across = torch.minimum(smoothness", "across = torch.maximum(smoothness"),
        tests=(f"{UNIT}evidence.py", f"{UNIT}algorithm.py"),
    ),
    *of(
        "algorithm/terms.py",
        ("eta * ((1.0 - ssim", "(1.0 - eta) * ((1.0 - ssim"),
        ("C2 = 0.03**2", "C2 = 0.04**2"),
        ("math.exp(-0.5 / 1.5**2)", "math.exp(-0.5 / 1.2**2)"),
        ("GAINS = (0.2, 5.0)", "GAINS = (0.2, 8.0)"),
        ("CELL_PRIOR = 0.2", "CELL_PRIOR = 0.4"),
        ("UNSEEN)).amin(1)", "UNSEEN)).amax(1)"),
        ("mask = (seen > 0.5)", "mask = (seen > 0.0)"),
        ("return total / levels", "return total"),
        ("ANCHOR_FLOOR = 0.05", "ANCHOR_FLOOR = 0.1"),
        ("in_view & ~given.hidden", "in_view"),
        ("TERM_CAUCHY = 5.0", "TERM_CAUCHY = 6.0"),
        ("masked_mean(e + e * e, given)", "masked_mean(e, given)"),
        ("visible_fraction >= self.config.min_visible", "visible_fraction >= 0.0"),
        ("t = t - compared.affine_start.t_hat", "t = t - compared.affine_start.s_hat"),
        tests=(f"{UNIT}terms.py",),
    ),
    *of(
        "algorithm/gradients.py",
        ("1 - b2**self._count", "1 - b1**self._count"),
        ("(0.9, 0.99)", "(0.9, 0.999)"),
        ("(_per_sample_norm(reference) / _per_sample_norm", "(1.0 / _per_sample_norm"),
    ),
    *of(
        "algorithm/denoising.py",
        ("level.alpha * z_t - level.sigma * output", "level.alpha * z_t + level.sigma * output"),
        ("level.alpha * output + level.sigma * z_t", "level.sigma * output + level.alpha * z_t"),
        tests=("tests/parity/test_scheduler_parity.py",),
    ),
    *of(
        "algorithm/schedule.py",
        ("(i + 1) / count > plan.updates_from", "i / count > plan.updates_from"),
        ("first = min(len(active) // 2", "first = min(0"),
        ("config.start <= i / count < config.stop", "config.start <= i / count <= config.stop"),
    ),
    *of("algorithm/edges.py", ("STEEPER = 2.0", "STEEPER = 1.0"), tests=(f"{UNIT}algorithm.py",)),
    *of(
        "result/voting.py",
        ("\nBRIGHTNESS = 0.1\n", "\nBRIGHTNESS = 0.12\n"),
        ("MAP_VOTE = 0.03", "MAP_VOTE = 0.04"),
        ("clamp_min(1.0) ** 3", "clamp_min(1.0) ** 2"),
        ("DIFFERS = 2.0", "DIFFERS = 1.5"),
        ("STEP_PX = 2", "STEP_PX = 3"),
        ("(error / crispness**SOFT)", "error"),
        ("[0, 0, WIDE:-WIDE, WIDE:-WIDE]", "[0, 0]"),
        tests=(f"{UNIT}algorithm.py",),
    ),
    *of(
        "result/confidence.py",
        ("0.94, 0.", "-0.94, 0."),
        (", -15.0)", ", 15.0)"),
        ("\nFEW = 0.02", "\nFEW = 0.03"),
        ("\nHALF_KNOWN = 0.1", "\nHALF_KNOWN = 0.12"),
        ("else torch.minimum(best, error)", "else error"),
        (
            "matched = match_exposure(warped[:, channel], left_01[:, channel], seen)",
            "matched = warped[:, channel].clone()",
        ),
        ("K_strip[:, 1, 2] -= rows.start", "K_strip[:, 1, 2] -= 0"),
        tests=(f"{UNIT}verdict.py", f"{UNIT}large_pictures.py"),
    ),
    *of(
        "result/finish.py",
        ("(depth_m < _farthest_m", "(depth_m <= _farthest_m"),
        ("else max(reach_m, config.depth_range[1])", "else reach_m"),
        tests=(f"{UNIT}out_of_reach.py",),
    ),
    *of(
        "jobs/writing.py",
        ('"depth_mm.png", depth_m * valid)', '"depth_mm.png", depth_m)'),
        ("kept = valid & ~", "kept = ~"),
        ("single_map(output.valid) & ~formats", "~formats"),
        tests=(f"{UNIT}out_of_reach.py",),
    ),
    *of(
        "types.py",
        ("positive & (self.confidence > 0)", "positive & (self.confidence >= 0)"),
        ("known = self.prediction * self.valid", "known = self.prediction"),
        tests=(f"{UNIT}out_of_reach.py",),
    ),
    *of(
        "runtime/noise_levels.py",
        ("alpha_bar.sqrt(), (1.0 - alpha_bar).sqrt()", "alpha_bar.sqrt(), 1.0 - alpha_bar.sqrt()"),
        tests=("tests/parity/test_scheduler_parity.py",),
    ),
    *of(
        "result/output.py",
        ("factor = 1.0 / float(over_prior.median())", "factor = float(over_prior.median())"),
        ("output.unit, output.scale_from", "_, output.scale_from"),
        tests=(f"{UNIT}metric_priors.py",),
    ),
    *of(
        "pose/estimate.py",
        ("px = (pixel + 0.5) * factor - 0.5", "px = pixel * factor"),
        ("ahead[close, 2] * inverse_depth", "np.linalg.norm(ahead[close], axis=1) * inverse_depth"),
    ),
    *of(
        "result/verdict.py",
        ("math.isnan(found.spread) or found.spread >= LEAST_SPREAD", "found.spread >= LEAST_SPREAD"),
        ("weak > 1", "weak > 2"),
        ("0 < found.baseline_m < LEAST_BASELINE_M", "0 < found.baseline_m < 0.1 * LEAST_BASELINE_M"),
        ("not trusted or found.at_end > MOST_AT_END", "found.at_end > MOST_AT_END"),
        tests=(f"{UNIT}verdict.py",),
    ),
    *of(
        "pose/refine.py",
        ("+ misfit**2 + uneven**2", "+ misfit"),
        ("weight = of_length /", "weight = of_depth /"),
        ("DEPTH_SPREAD = 0.05", "DEPTH_SPREAD = 0.06"),
        (
            "displacement.at((grid + 0.5) * scale - 0.5) / scale",
            "displacement.at((grid + 0.5) * scale - 0.5)",
        ),
        ("displacement.size[1] / width, displacement.size[0] / height", "1.0, 1.0"),
        (
            "_RIDGE = 3.0",
            "_RIDGE = 12.0",
        ),
    ),
    *of(
        "formats/images.py",
        ("(number(Base.FocalPlaneYResolution) or per_unit_x)", "per_unit_x"),
        ("{2: 25.4, 3: 10.0,", "{2: 25.4, 3: 25.4,"),
        ("math.hypot(36.0, 24.0)", "36.0"),
        ("max(width, height) / max(taken)", "1.0"),
        tests=(f"{UNIT}pose_estimate.py",),
    ),
    *of(
        "result/verdict.py",
        ("OFF_MATCHES = math.log(1.2)", "OFF_MATCHES = math.log(1.3)"),
        ("LEAST_CONFIDENCE = 0.5\n", "LEAST_CONFIDENCE = 0.45\n"),
        ("LEAST_MATCHED = 0.12", "LEAST_MATCHED = 0.1"),
        ("MOST_EXCHANGED = -0.2", "MOST_EXCHANGED = -0.3"),
        ("LEAST_CORRELATION = 0.2\n", "LEAST_CORRELATION = 0.15\n"),
        ("MATCHED_ENOUGH = 0.5\n", "MATCHED_ENOUGH = 0.6\n"),
        ("WEAK_EPIPOLAR_PX = 1.0", "WEAK_EPIPOLAR_PX = 1.3"),
        ("LEAST_SPREAD = 0.15", "LEAST_SPREAD = 0.2"),
        ("POINTS_REPORTED = math.log(1.08)", "POINTS_REPORTED = math.log(1.1)"),
        ("MANY_OFF = 0.25", "MANY_OFF = 0.3"),
        ("MOST_OFF = 0.5", "MOST_OFF = 0.6"),
        ("OWN_METRES = math.log(1.9)", "OWN_METRES = math.log(2.1)"),
        ("EPIPOLAR_WRONG = 4.0", "EPIPOLAR_WRONG = 5.0"),
        ("MOST_SCALE_SPREAD = 0.1", "MOST_SCALE_SPREAD = 0.12"),
        ("MOST_TOGETHER = 1.15", "MOST_TOGETHER = 1.2"),
        ("ENOUGH_POINTS = 50", "ENOUGH_POINTS = 40"),
        ("LEAST_COVER = 0.25", "LEAST_COVER = 0.2"),
        ("MOST_BEHIND = 0.05", "MOST_BEHIND = 0.1"),
        ("FAR_SCENE_OF_RIG_M = 50.0", "FAR_SCENE_OF_RIG_M = 100.0"),
        ("OTHER_UNIT = math.log(20.0)", "OTHER_UNIT = math.log(60.0)"),
        ("1.0 - 0.75 * (off", "1.0 - 0.5 * (off"),
        tests=THRESHOLDS,
    ),
    *of(
        "result/indicators.py",
        ("mean / points.inverse_depth", "points.inverse_depth / mean"),
        ("CONFIDENT = 0.5", "CONFIDENT = 0.6"),
        ("POINTS_WRONG = math.log(1.2)", "POINTS_WRONG = math.log(1.3)"),
        ("_where((depth_m * matches", "_where((depth_m / matches"),
        ("1.0 / sample.nanmedian()", "sample.nanmedian()"),
        tests=CAPTURES,
    ),
    *of(
        "result/misfit.py",
        ("(z_m - E[2, 3]) ** 2", "(z_m + E[2, 3]) ** 2"),
        ("E[0, 3] - ray_x * E[2, 3]", "E[0, 3] + ray_x * E[2, 3]"),
        ("max(scale_spread, misfit.relative) * z_m)", "max(scale_spread, misfit.relative))"),
        tests=CAPTURES,
    ),
    *of(
        "result/misfit.py",
        ("USUAL_PX = 0.45", "USUAL_PX = 0.5"),
        ("USUAL_BEND_PX = 1.0", "USUAL_BEND_PX = 1.2"),
        ("USUAL_DISTORTION = 0.08", "USUAL_DISTORTION = 0.1"),
        ("found.behind_infinity > USUAL_BEHIND", "found.behind_infinity > 0.0"),
        ("SCALE_SHARE = 0.85", "SCALE_SHARE = 0.8"),
        ("USUAL_PX if found.rectified else 0.0", "USUAL_PX"),
        ("SPREAD_SHARE = 0.3", "SPREAD_SHARE = 0.25"),
        ("USUAL_SPREAD = 0.15", "USUAL_SPREAD = 0.13"),
        ("across_px * pixels_of_matches(size), behind_px", "across_px, behind_px"),
        ("abs(found.distortion) - USUAL", "found.distortion - USUAL"),
        ("_known(deviation) ** 2 - usual**2", "(_known(deviation) - usual) ** 2"),
        ("math.hypot(MATCH_NOISE_PX, misfit.px)", "MATCH_NOISE_PX + misfit.px"),
        ("+ 2.0 * along)", "+ along)"),
        ("max(scale_spread, misfit.relative)", "math.hypot(scale_spread, misfit.relative)"),
        ("torch.erf(within * with_it) / torch.erf(within * without)", "torch.erf(within * with_it)"),
        ("z_m / expected_error", "1.0 / expected_error"),
        tests=(f"{UNIT}misfit.py",),
    ),
    *of(
        "result/finish.py",
        ("if misfit == NO_MISFIT else share * share_left", "if misfit != NO_MISFIT else share * share_left"),
        tests=(f"{UNIT}out_of_reach.py",),
    ),
    *of(
        "result/verdict.py",
        ("_behind_infinity(found) and found.centre_assumed", "_behind_infinity(found)"),
        ("_behind_infinity(found) and not found.centre_assumed", "_behind_infinity(found)"),
        ("WEAK_CONFIDENCE = 0.53", "WEAK_CONFIDENCE = 0.55"),
        ("WEAK_MATCHED = 0.38", "WEAK_MATCHED = 0.35"),
        ("not (agreed or (_well_matched(found) and followed))", "not agreed"),
        ("agreed = found.points_ratio > 0 and not", "agreed = not"),
        ("found.exchangeable < EXCHANGEABLE or", "found.exchangeable >= EXCHANGEABLE or"),
        ("_order_contradicts(found) and not _order_known(found)", "_order_contradicts(found)"),
        tests=THRESHOLDS,
    ),
    *of(
        "pose/refine.py",
        ("MOST_DEPTH_SPREAD = 0.16", "MOST_DEPTH_SPREAD = 0.14"),
        ("0.0 if misfit.rig else depths_apart", "depths_apart"),
        ("None if fit.rig or measured else DEPTH_SPREAD", "DEPTH_SPREAD"),
        ("(misses and fit.rig)", "fit.rig"),
        ("fit.is_small and not signs.are_usual", "False"),
        ("return not self.mistakes and (", "return ("),
        ("self.distortion.at_most <= LITTLE_DISTORTION", "abs(self.distortion.k1) <= LITTLE_DISTORTION"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/tracks.py",
        ("_FARTHEST_BEHIND = 0.97", "_FARTHEST_BEHIND = 0.99"),
        ("_FARTHEST_BEHIND = 0.97", "_FARTHEST_BEHIND = 0.95"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "result/indicators.py",
        ("pose.behind_px * pixels_of_matches(native.size)", "pose.behind_px"),
        ("max(pose.straightened_px, default=0.0)", "0.0"),
        tests=(f"{UNIT}misfit.py",),
    ),
    *of(
        "runtime/run.py",
        ("any(message.code == SAME_CENTRE.code for message in guidance.assumed)", "False"),
        tests=(f"{UNIT}out_of_reach.py",),
    ),
    *of("result/voting.py", ("+ 0.5) * (columns / width) - 0.5", ") * (columns / width)"), tests=CAPTURES),
    *of(
        "result/output.py",
        ("else output.uncertainty * factor", "else output.uncertainty"),
        tests=CAPTURES,
    ),
    *of(
        "pose/multiview.py",
        ("turned = scale * centres @ Q.T", "turned = scale * centres @ Q"),
        ("points=scale * result.points @ Q.T + shift", "points=scale * result.points @ Q + shift"),
        ("E[:, :3, :3], E[:, :3, 3] = Q @ E", "E[:, :3, :3], E[:, :3, 3] = Q.T @ E"),
        ("np.array([a.spread, b.spread]) ** -2.0", "np.array([a.spread, b.spread]) ** -1.0"),
        ("math.log(a[k] / b[k])", "math.log(b[k] / a[k])"),
        tests=CAPTURES,
    ),
    *of(
        "pose/tracks.py",
        ("K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5", "K[:2, 2] = K[:2, 2] * scale"),
        ("np.float32(views[0][1][0, 0]) /", "1 / np.float32(views[0][1][0, 0]) *"),
        ("(at.inverse_depth < 0) & (away", "(at.inverse_depth > 0) & (away"),
        tests=(*CAPTURES, f"{UNIT}pose_refine.py"),
    ),
    *of(
        "_certain.py",
        ("abs(value) - UNCERTAIN * error", "abs(value) + UNCERTAIN * error"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/lens.py",
        ("A[:, 0] = (ahead - behind)", "A[:, 0] = (behind - ahead)"),
        (", _error_by_blocks(inverse, pulls, blocks(tracks)))", ", 0.0)"),
        ("abs(estimate) + BOUND_ERRORS * error", "abs(estimate) - BOUND_ERRORS * error"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/conventions.py",
        ("[[cosine, -sine], [sine, cosine]]", "[[cosine, sine], [-sine, cosine]]"),
        ("MOST_GUESS = 0.007", "MOST_GUESS = 0.01"),
        tests=(f"{UNIT}pose_conventions.py",),
    ),
    *of(
        "capture/frames.py",
        ("frame.points * factor", "frame.points"),
        ("points=solved.points * factor", "points=solved.points"),
        ("solved.E_given * longer", "solved.E_given"),
        tests=CAPTURES,
    ),
    *of(
        "formats/depth.py",
        ("inverse - (K_right[0, 2] - K_left[0, 2])", "inverse + (K_right[0, 2] - K_left[0, 2])"),
        tests=CAPTURES,
    ),
    *of("formats/transforms.py", ("pose[:3, 3] /= check", "pose[:3, 3] *= check"), tests=CAPTURES),
    *of(
        "formats/lidar.py",
        ("+ T[:3, 3] + place", "+ T[:3, 3] - place"),
        ("transform(R, (0, 0, 0), rectifying) @ T", "T"),
        ("seen[seen[:, 2] > 0]", "seen"),
        ("rows[:, 3].max() > 1", "rows[:, 3].max() > 255"),
        tests=(f"{UNIT}lidar.py",),
    ),
    *of(
        "formats/stereo.py",
        ("np.linalg.inv(E_left) @ E_right", "np.linalg.inv(E_right) @ E_left"),
        ('"15mm": 450.0', '"15mm": 1050.0'),
        ("E = T_left @ np.linalg.inv(T_right)", "E = np.linalg.inv(T_left) @ T_right"),
        ("E[0, 3] < 0.9", "E[0, 3] < -0.9"),
        tests=("tests/contracts/test_formats.py",),
    ),
    *of(
        "formats/named.py",
        ('[named.get("D", ())] * 2', "[(), ()]"),
        ("if differ and name in MAY_DIFFER", "if differ and False"),
        ("return in_units(rig, units or 1.0)", "return rig"),
        ('np.linalg.inv(pose) if R == "R" else pose', 'pose if R == "R" else np.linalg.inv(pose)'),
        tests=("tests/contracts/test_formats.py", "tests/unit/test_named_calibrations.py"),
    ),
    *of(
        "formats/storage.py",
        ("level < MOST_LEVELS", "level < 1"),
        ('side = f"{sides.pop()}."', 'side = f"{sides}."'),
        tests=("tests/contracts/test_formats.py",),
    ),
    *of(
        "formats/sequences.py",
        ("(4, 4), name)[:3, :3]", "(4, 4), name)[:3, :3].T"),
        ("ALIGNED = 0.02", "ALIGNED = 2.0"),
        ('float(entries["m_depthShift"])', "1000.0"),
        ('float(entries["scale"])', "None"),
        (
            'E=rigid(row, "a pose"), depth=depth, depth_per_m',
            'E=np.linalg.inv(rigid(row, "a pose")), depth=depth, depth_per_m',
        ),
        tests=("tests/contracts/test_captures.py",),
    ),
    *of(
        "formats/radiance.py",
        ("np.column_stack([right, down, -back])", "np.column_stack([right, -down, back])"),
        ("sorted(images, key=lambda image: image.name), rows", "images, rows"),
        ("P * np.sign(np.linalg.det(P[:, :3]))", "P"),
        ("K[:2, 2] -= 0.5", "K[:2, 2] -= 0.0"),
        ("transform(R.T, array_of(entries", "transform(R, array_of(entries"),
        ("fx * float(entries.get", "fx / float(entries.get"),
        ("if same else one", "if same else lenses[pose.stem]"),
        tests=("tests/contracts/test_captures.py",),
    ),
    *of(
        "formats/openmvg.py",
        ("return [k1, k2, p1, p2, k3]", "return [k1, k2, k3, p1, p2]"),
        ("transform(rotation.T,", "transform(rotation,"),
        ("classes[number % FIRST_OF_CLASS]", "classes[number]"),
        ('(3, 3), "rotation").T, pose', '(3, 3), "rotation"), pose'),
        ("version < (1, 2, 5)", "version < (1, 2, 2)"),
        tests=("tests/contracts/test_captures.py",),
    ),
    *of(
        "formats/realityscan.py",
        ("(k1, k2, t2, t1, k3)", "(k1, k2, t1, t2, k3)"),
        ("transform(R.T, place", "transform(R, place"),
        ("size[1] / 2 + v - 0.5", "size[1] / 2 - v - 0.5"),
        ("longer = max(size)", "longer = min(size)"),
        tests=("tests/contracts/test_captures.py",),
    ),
    *of(
        "formats/kapture.py",
        ("T_camera_from_rig @ T_rig_from_world", "T_rig_from_world @ T_camera_from_rig"),
        ("np.linalg.inv(T_camera_from_world)", "T_camera_from_world"),
        tests=("tests/contracts/test_captures.py",),
    ),
    *of(
        "formats/captures.py",
        ("off_px.max() > ROUNDING_PX", "off_px.max() > 2 * ROUNDING_PX"),
        ("off_px < NEAR_SIZE * expected", "off_px < 20 * NEAR_SIZE * expected"),
        tests=("tests/contracts/test_captures.py",),
    ),
    *of(
        "formats/images.py",
        ("return int(pair[0]), int(pair[1])", "return int(pair[1]), int(pair[0])"),
        ('group["type"] == STEREO_GROUP', "group"),
        tests=(f"{UNIT}spatial_heic.py",),
    ),
    *of(
        "formats/foxglove.py",
        ("1_000_000_000 + int(message.timestamp.nanos)", "1_000_000_000 - int(message.timestamp.nanos)"),
        ("starting_at=start, ending_before=stop", "starting_at=stop, ending_before=start"),
        tests=(f"{UNIT}foxglove.py",),
    ),
    *of(
        "jobs/lengths.py",
        ("KnownScale(length / measured", "KnownScale(measured / length"),
        ("if relative > MOST_SPREAD", "if relative < MOST_SPREAD"),
        ("math.hypot(spread, length * scale_spread)", "spread"),
        ("ends = taken if frame.lens is None", "ends = taken if True"),
        ("span.frame not in doubted", "span.frame in doubted"),
        tests=(f"{UNIT}capture.py",),
    ),
    *of(
        "algorithm/correction.py",
        ("antialias=size < target.size", "antialias=size > target.size"),
        tests=(f"{UNIT}algorithm.py",),
    ),
    *of(
        "capture/agreement.py",
        ("(z > 1e-6) & (u > -0.5) & (v > -0.5)", "(z > 1e-6) & (u >= 0) & (v >= 0)"),
        ("observers=np.maximum(observers, confirmed)", "observers=observers"),
        (
            "np.where(said.agrees, 1.0 - RISES * said.confidence, 1.0)",
            "np.where(said.agrees, 1.0 - RISES, 1.0)",
        ),
        ("(depth < (1 - SAME_SHARE) * frame.depth)", "(depth > (1 + SAME_SHARE) * frame.depth)"),
        ("np.argsort(-z[inside], kind", "np.argsort(z[inside], kind"),
        ("same &= (depths > 0) & (depths[candidate] > 0)", "same &= depths[candidate] > 0"),
        ("same &= (depths > 0) & (depths[candidate] > 0)", "same &= depths > 0"),
        tests=CAPTURES,
    ),
    *of(
        "capture/frames.py",
        ("frames[seen] >= FEWEST_FRAMES", "frames[seen] > FEWEST_FRAMES"),
        tests=CAPTURES,
    ),
    *of(
        "capture/frames.py",
        (
            "angle < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG",
            "angle < BEST_ANGLE_DEG, WIDER_DEG, NARROWER_DEG",
        ),
        tests=(f"{UNIT}capture.py",),
    ),
    *of(
        "capture/splats.py",
        ("(frame.as_stored or not is_turned(frame.image))", "not is_turned(frame.image)"),
        tests=(f"{UNIT}splats.py",),
    ),
    *of(
        "evidence/inputs.py",
        ("np.isfinite(array) & (array > 0)", "np.isfinite(array) & (array >= 0)"),
        tests=(f"{UNIT}known_points.py",),
    ),
    *of(
        "pose/estimate.py",
        ("np.median(other / np.maximum(first, 1e-9))", "np.median(first / np.maximum(other, 1e-9))"),
        tests=(f"{UNIT}pose_estimate.py",),
    ),
    *of(
        "pose/tracks.py",
        ("_RATIO**2 * (1.0 - second)", "_RATIO * (1.0 - second)"),
        tests=(f"{UNIT}pose_estimate.py",),
    ),
    *of(
        "formats/image_files.py",
        ("(exact or claims[path] == 1)", "claims[path] == 1"),
        ("return _Found(path, start == 0)", "return _Found(path, True)"),
        tests=(f"{UNIT}moved_images.py",),
    ),
    *of(
        "jobs/finished.py",
        (".st_size > 0", ".st_size >= 0"),
        ("digests.get(path, digest) != digest", "digests.get(path) != digest"),
        tests=(f"{UNIT}finished.py",),
    ),
    *of(
        "jobs/many.py",
        ("record = record | (there or {})", "record = (there or {}) | record"),
        tests=(f"{UNIT}finished.py",),
    ),
    *of(
        "jobs/many.py",
        ("available_cores() // processes - CORES_OF_STAGES", "available_cores() - CORES_OF_STAGES"),
        tests=(f"{UNIT}runner.py",),
    ),
    *of(
        "jobs/journal.py",
        ("max(1, min(self.count, gpus))", "max(1, self.count)"),
        ('"LOCAL_WORLD_SIZE", max(', '"WORLD_SIZE", max('),
        tests=(f"{UNIT}runner.py",),
    ),
    *of(
        "formats/layouts.py",
        ("for count in others if count)", "for count in others)"),
        tests=(f"{UNIT}capture_files.py",),
    ),
    *of(
        "jobs/capture.py",
        (
            'read_report(folder).get("made_from") == item.inputs',
            'read_report(folder).get("frame") == item.key',
        ),
        ("return max(1, min(wanted, left))", "return max(1, wanted)"),
        tests=(f"{UNIT}capture.py",),
    ),
    *of(
        "jobs/rows.py",
        ("depth_mm(depth_m * single_map(run.output.valid))", "depth_mm(depth_m)"),
        tests=(f"{UNIT}rows.py",),
    ),
    *of(
        "jobs/reading.py",
        ("options.view_k[i - 2]", "options.view_k[i - 1]"),
        ("if i == 1 and options.k_right", "if i > 0 and options.k_right"),
        ("or [rig.K_left] * len(options.view)", "or [rig.K_right] * len(options.view)"),
        tests=("tests/cli/test_estimate_pose.py",),
    ),
    *of(
        "runtime/run.py",
        (
            "# replaced, or changed in place\n                self._results[-1] = None",
            "\n                pass",
        ),
        tests=("tests/integration/test_guided_call.py",),
    ),
    *of(
        "pose/tearing.py",
        ("np.ascontiguousarray(beside[::-1])", "np.ascontiguousarray(beside)"),
        ("heights[view] / len(greys[view])", "heights[0] / len(greys[0])"),
        ("if len(torn) != 1 or any", "if len(torn) == 0 or any"),
        tests=(f"{UNIT}tearing.py",),
    ),
    *of(
        "matching/uprights.py",
        ("_certain_median(flat - float(", "_certain_median(flat + float("),
        ("min(certain, key=abs) if certain[0]", "max(certain, key=abs) if certain[0]"),
        ("MOST_APART = 0.06", "MOST_APART = 6.0"),
        tests=(f"{UNIT}uprights.py",),
    ),
    *of(
        "matching/occlusion.py",
        ("for end in (far, near - 1))", "for end in (near - 1, far))"),
        ("beside = np.arange(-REACH_PX, REACH_PX + 2)", "beside = np.arange(2)"),
        ("(rise >= LEAST_RISE_PX) & as_wide", "rise >= LEAST_RISE_PX"),
        tests=(f"{UNIT}occlusion.py",),
    ),
    *of(
        "pose/bars.py",
        ("least[::-1], most[::-1]", "least, most"),
        ("grey if turned else grey.T", "grey.T if turned else grey.T"),
        tests=(f"{UNIT}bars.py",),
    ),
    *of(
        "pose/moving.py",
        ("apart < TOGETHER * np.abs(middle)", "apart < 10.0 * np.abs(middle)"),
        ("moved / compared if", "moved / len(off_px) ** 2 if"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/mistakes.py",
        ("left_px=tracks.right_px[0], right_px=tracks.left_px[None])", "left_px=tracks.left_px)"),
        ("return min(shares, default=math.nan)", "return 1.0 - min(shares, default=math.nan)"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/lens.py",
        ("min((k1, *others), key=abs) if all", "max((k1, *others), key=abs) if all"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/mistakes.py",
        ("(Ks[:, :2, 2] + 0.5) * factor - 0.5", "Ks[:, :2, 2] * factor"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/solve.py",
        ("1.0 / (prior.shifted_share * baseline)", "1.0 / prior.shifted_share"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/tracks.py",
        ("flow + _read(back, landed)", "flow + _read(back, centres)"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/multiview.py",
        ("(self.connected[of] and self.connected[beside])", "(self.connected[of] or self.connected[beside])"),
        tests=(f"{UNIT}capture.py",),
    ),
    *of("matching/winner.py", ("(index > 0) & (index < last)", "(index > 0) & (index <= last)")),
    *of(
        "matching/alignment.py",
        ("np.tile(scale > 0, 2)", "np.repeat(scale > 0, 2)"),
        tests=(f"{UNIT}matching.py",),
    ),
    *of(
        "matching/rows.py",
        ("-infinity if mirrored else infinity", "infinity"),
        tests=(f"{UNIT}algorithm.py",),
    ),
    *of(
        "matching/gaps.py",
        ("self.first > 0) & (self.end < ", "self.first > 0) | (self.end < "),
        ("LEAST_STEP_PX = 2.0", "LEAST_STEP_PX = 4.0"),
        ("np.minimum(*gaps.ends", "np.maximum(*gaps.ends"),
        ("np.searchsorted(full, empty) - 1", "np.searchsorted(full, empty)"),
        tests=(f"{UNIT}gaps.py",),
    ),
    *of(
        "matching/consistency.py",
        ("matches.confidence.clamp_min(1.0)", "matches.confidence.clamp(0.0, 1.0)"),
        tests=(f"{UNIT}flattening.py",),
    ),
    *of(
        "scale/volume_search.py",
        ("near_m <= low * 1.02", "near_m >= low * 1.02"),
        tests=(f"{UNIT}scale_search.py",),
    ),
    *of(
        "scale/points.py",
        (
            "near_m / math.exp(NEAR_REACH), far_m / math.exp(FAR_REACH)",
            "near_m / math.exp(FAR_REACH), far_m / math.exp(NEAR_REACH)",
        ),
        tests=(f"{UNIT}scale_search.py",),
    ),
    *of(
        "evidence/prepare.py",
        ("nearest = torch.maximum(nearest, points", "nearest = torch.minimum(nearest, points"),
        tests=(f"{UNIT}evidence.py",),
    ),
    *of(
        "evidence/store.py",
        ('("pose", "crisp", "clean_photographs"', '("pose", "clean_photographs"'),
        ("needs_matches, measured_baseline, given.unit)", "needs_matches, measured_baseline)"),
        tests=(f"{UNIT}evidence.py",),
    ),
    *of(
        "evidence/inputs.py",
        ("array.shape[1] in (4, 6)", "array.shape[1] in (4,)"),
        tests=(f"{UNIT}known_points.py",),
    ),
    *of(
        "algorithm/depth_range.py",
        ("(index == 0) | (index == len(candidates) - 1)", "(index == 0) | (index == len(candidates))"),
        tests=(f"{UNIT}algorithm.py",),
    ),
    *of(
        "algorithm/edges.py",
        (
            "halo - rows.start + part.start, halo - part.stop + rows.stop",
            "halo - part.stop + rows.stop, halo - rows.start + part.start",
        ),
        tests=(f"{UNIT}algorithm.py",),
    ),
    *of(
        "capture/splats.py",
        ("depth.confidence.clip(1 / 255, 1)", "depth.confidence.clip(0, 1)"),
        tests=(f"{UNIT}splats.py",),
    ),
    *of("jobs/lengths.py", ("(round(x), round(y))", "(int(x), int(y))"), tests=(f"{UNIT}capture.py",)),
    *of(
        "formats/bag_images.py",
        ('("gbrg", "GR"), ("grbg", "GB")', '("gbrg", "GB"), ("grbg", "GR")'),
        ("most < 1 << bits", "most <= 1 << bits"),
        tests=(f"{UNIT}bags.py",),
    ),
    *of(
        "runtime/graphs.py",
        ("stream.wait_stream(self._latest)", "pass"),
        ("with torch.cuda.device(device):", "with torch.cuda.device(0):"),
        tests=("tests/integration/test_graphs.py",),
    ),
    *of(
        "pose/fit.py",
        ("<= SURELY * fit.limit_px", "<= 9.0 * fit.limit_px"),
        ("replace(fit, surely=small().surely)", "fit"),
        ("if greys.rig and len", "if len"),
        ("len(greys.given) == 1 and (of_small", "(of_small"),
        ("(self.is_known and not", "(True and not"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "pose/tracks.py",
        ("np.array(large.shape[::-1]) / small.shape[::-1]", "1.0"),
        tests=(f"{UNIT}pose_refine.py",),
    ),
    *of(
        "_threads.py",
        ("                ready.wait()", "                pass"),
        ("stream.wait_stream(self._stream)", "pass"),
        ("tensor.record_stream(stream)", "pass"),
        ("return context.run(function)", "return function()"),
        ("with torch.no_grad(), torch.cuda", "with torch.cuda"),
        ("if self._answer.exception() is None", "if self._answer.done()"),
        ("        arrived.synchronize()", "        pass"),
        ("                    part.close()", "                    pass"),
        ("self._stream.record_event() if follows else None", "None"),
        ("stream not in self._waiting", "not self._waiting"),
        tests=(f"{UNIT}beside.py", "tests/integration/test_threads.py"),
    ),
    *of(
        "_kernels.py",
        ("_switched_on.set(_switched_on.get() and not off)", "_switched_on.set(not off)"),
        ("tensor.is_cuda and torch.version.hip is None", "tensor.is_cuda"),
        ("has_triton() and (on_device or interpreting())", "has_triton() and on_device"),
        tests=(f"{UNIT}kernel_switch.py",),
    ),
    *of(
        "result/kernels.py",
        ("1 if prior_error[0].numel() == 1 else 2", "1"),
        ("K[1, 1], K[0, 1] / K[0, 0]", "K[1, 1], 0.0"),
        tests=(
            f"{KERNELS}result.py::test_confidence",
            f"{KERNELS}result.py::test_a_right_image_seen_from_the_left",
        ),
    ),
    *of(
        "result/flattening.py",
        ("clamp_min(LEAST_INVERSE) ** 2", "clamp_min(LEAST_INVERSE) ** 0"),
        ("guide, DENOISED_EDGE)", "guide, 1e3 * DENOISED_EDGE)"),
        tests=(f"{UNIT}flattening.py",),
    ),
    *of(
        "result/flattening_kernels.py",
        ("inverse, smoothed, *links, pull", "inverse, smoothed, *links[::-1], pull"),
        tests=(f"{KERNELS}flattening.py",),
    ),
    *of(
        "scale/kernels.py",
        ("map_kernel[(triton.cdiv(pixels, PIXELS), batch)]", "map_kernel[(triton.cdiv(pixels, PIXELS), 1)]"),
        tests=(f"{KERNELS}space.py",),
    ),
    *of(
        "scale/search_kernels.py",
        ("reach / (grid - 1) * (2 if last else 1)", "reach / (grid - 1) * 2"),
        tests=(f"{KERNELS}search.py",),
    ),
    *of(
        "algorithm/correction_kernels.py",
        ("max(height, width) / correction.REFERENCE_SIDE", "width / correction.REFERENCE_SIDE"),
        ("n, target.plane_step.numel(), match_noise", "n, 1, match_noise"),
        tests=(f"{KERNELS}correction.py",),
    ),
    *of(
        "algorithm/edge_kernels.py",
        ("(triton.cdiv(height * width, BLOCK), batch)", "(triton.cdiv(height * width, BLOCK), 1)"),
        tests=(f"{KERNELS}edges.py",),
    ),
    *of(
        "matching/kernels.py",
        ("FIRST=number == 0", "FIRST=True"),
        ("            lines[:, first:],", "            lines,"),
        tests=(f"{KERNELS}matching.py",),
    ),
]


def prepared(folder: Path) -> Path:
    """A copy of the checkout, without what no test of this file reads."""
    left_out = shutil.ignore_patterns("__pycache__", "*.pyc", "scenes_cache")
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=left_out)
        else:
            shutil.copy(source, folder / name)
    return folder


def killed(copy: Path, mutant: Mutant | None) -> bool:
    """Whether the tests of a mutant fail in a process of its own; of ``None``, all parts and references."""
    child = os.fork()
    if not child:
        status = 3
        try:
            status = _run(copy, [*(() if mutant is None else mutant.tests), PARTS, REFERENCES])
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0


def _run(copy: Path, tests: list[str]) -> int:
    import pytest

    with (copy / "log.txt").open("w") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    for name in [name for name in sys.modules if name.split(".")[0] in ("geodiff_plugin", "tests")]:
        del sys.modules[name]
    sys.path[:] = [str(copy), *(path for path in sys.path if Path(path).resolve() != ROOT)]
    os.environ["PYTHONPATH"] = str(copy)
    os.chdir(copy)
    return int(pytest.main([*OPTIONS, *tests]))


def killed_in_interpreter(copy: Path, mutant: Mutant) -> bool:
    """Whether the tests of a kernel fail in Triton's interpreter, chosen where Triton is imported."""
    command = [sys.executable, "-m", "pytest", *OPTIONS, *mutant.tests]
    with (copy / "log.txt").open("w") as log:
        settings = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": str(copy)}
        ended = subprocess.run(command, cwd=copy, env=settings, stdout=log, stderr=log, check=False)
    return ended.returncode != 0


def main(words: list[str]) -> int:
    """Run the mutants of files that contain a word, all without any; how many are not killed."""
    chosen = [m for m in MUTANTS if not words or any(word in m.file for word in words)]
    chosen = [m for m in chosen if not m.of_kernel or find_spec("triton") is not None]
    importlib.import_module("tests.golden.parts")  # and with it all that a run then need not import anew
    survivors, gone = [], []
    with tempfile.TemporaryDirectory() as name:
        copy = prepared(Path(name))
        if killed(copy, None):
            raise SystemExit(f"The tests fail without any mutant:\n{(copy / 'log.txt').read_text()}")
        for mutant in chosen:
            path = copy / "geodiff_plugin" / mutant.file
            source = path.read_text(encoding="utf-8") if path.is_file() else ""
            if source.count(mutant.text) != 1:
                gone.append(mutant)
                continue
            start = time.perf_counter()
            path.write_text(source.replace(mutant.text, mutant.instead), encoding="utf-8")
            dead = killed_in_interpreter(copy, mutant) if mutant.of_kernel else killed(copy, mutant)
            path.write_text(source, encoding="utf-8")
            word = "killed" if dead else "SURVIVES"
            print(
                f"{word:8} {time.perf_counter() - start:5.1f} s  {mutant.file}: {mutant.instead}", flush=True
            )
            if not dead:
                survivors.append(mutant)
    ran = len(chosen) - len(gone)
    print(f"{ran - len(survivors)} of {ran} mutants killed")
    for title, listed in (("survives", survivors), ("no longer there", gone)):
        for mutant in listed:
            print(f"{title}: {mutant.file}: {mutant.text!r} -> {mutant.instead!r}")
    return len(survivors) + len(gone)


if __name__ == "__main__":
    raise SystemExit(bool(main(sys.argv[1:])))
