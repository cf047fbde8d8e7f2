"""Check for matches with negative disparity, whose rays diverge in front of the cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.pose.tracks import MIN_MATCHES, Tracks, epipolar, project_tracks
from geodiff_plugin.trust.check import Check, FactSheet, MatchError
from geodiff_plugin.trust.stages import PosesStage, TracksStage

NEGATIVE_DISPARITY = FindingKind(
    "depth.negative-disparity",
    REASON,
    "Some matches have negative disparity",
    cause="The right camera's cx or the rotation of E is wrong, the right image was cropped or stretched, or "
    "objects moved between the images.",
    hint="Pass the right camera's own K (K_right, --K-right, --cx-right); check E and the right image.",
)
CX_MISMATCH = FindingKind(
    "camera.cx-mismatch",
    REASON,
    "The right camera's cx seems to differ from the left camera's",
    cause="Only one K was passed for two parallel cameras, and it leads to negative disparities.",
    hint="Pass the right camera's calibrated matrix (K_right, --K-right) or cx (--cx-right). The difference "
    "in the message is only a lower bound, so check one known distance afterwards. If the calibrated cx "
    "values are equal, check E and the right image.",
)

#: Code of the assumption under which the right camera's cx is the most likely cause.
ASSUMED_CX = "camera.assumed-cx"
#: Maximum epipolar distance of a match that is used, pixels.
ON_LINE_PX = 2.0
#: Negative disparities of a smaller magnitude may be noise, pixels.
NOISE_PX = 1.0
#: Quantile of the magnitudes of negative disparities that is reported, because single matches may be wrong.
QUANTILE = 0.97


@dataclass(frozen=True)
class Negative:
    """Matches with negative disparity, among those with a small epipolar distance."""

    fraction: float  # fraction of the matches
    px: float  # ``QUANTILE`` of the magnitudes, pixels of the left image; 0 for hardly any


class NegativeDisparity(Check[Negative]):
    """Detects a wrong cx, rotation or crop by matches whose rays meet behind the cameras.

    Under correct cameras and poses, only noise and wrong matches have a negative disparity, by less than
    ``NOISE_PX``. In 73 correct pairs up to 2 % of the matches had a larger one.
    """

    kinds = (NEGATIVE_DISPARITY, CX_MISMATCH)
    #: Correct pairs have up to .015. Pairs of distant scenes with a wrong principal point or rotation have
    #: .12 to .88.
    MAX_FRACTION = 0.05
    #: Correct pairs of blank walls, with few matches, have up to this, which does not lower the confidence.
    USUAL_FRACTION = 0.04
    #: Limit for few matches, half of ``USUAL_FRACTION``.
    MAX_RULED_OUT = USUAL_FRACTION / 2

    @classmethod
    def of_tracks(cls, stage: TracksStage) -> Negative | None:
        return negative_disparities(stage.tracks, stage.given, stage.grid_px)

    @classmethod
    def of_poses(cls, stage: PosesStage) -> Negative | None:
        if stage.report.status != "refined" or stage.tracks is None:
            return None
        return negative_disparities(stage.tracks, stage.used, stage.grid_px)

    @classmethod
    def rules_out(cls, fact: Negative | None) -> bool:
        return fact is not None and fact.fraction <= cls.MAX_RULED_OUT

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.fraction > cls.MAX_FRACTION:
            assumed = any(finding.code == ASSUMED_CX for finding in facts.call.findings)
            yield _cx_mismatch(fact) if assumed else _negative_disparity(fact)

    @classmethod
    def match_error(cls, facts: FactSheet) -> MatchError:
        fact = facts[cls]
        return MatchError(px=fact.px if fact and fact.fraction > cls.USUAL_FRACTION else 0.0)


def _negative_disparity(fact: Negative) -> Finding:
    return Finding(
        NEGATIVE_DISPARITY,
        f"{100 * fact.fraction:.0f} % of the matches have negative disparity, so depth is wrong. Check the "
        "right cx (--cx-right), E, and whether an image was cropped.",
    )


def _cx_mismatch(fact: Negative) -> Finding:
    return Finding(
        CX_MISMATCH,
        f"{100 * fact.fraction:.0f} % of the matches have negative disparity: the right cx is off by at "
        f"least {fact.px:.0f} px, possibly more. Pass the calibrated K_right or --cx-right, then check one "
        "known distance.",
    )


def negative_disparities(tracks: Tracks, Ts: np.ndarray, grid_px: float = 1.0) -> Negative | None:
    """Measure negative disparities under poses ``Ts (V, 4, 4)``; ``None`` for too few usable matches.

    ``grid_px``: pixels of the left image per pixel of the tracks.
    """
    beyond_px = []
    for v, T in enumerate(Ts):
        seen = tracks.view(v)
        at = epipolar(seen, T)
        infinity = project_tracks(seen.rays, np.zeros(len(seen)), seen.K_rights[0], T).px
        nearest = seen.right_px[0] + at.off_px[:, None] * at.normals
        away_px = np.hypot(*(nearest - infinity).T)
        beyond = (at.inverse_depth < 0) & (away_px > NOISE_PX)
        beyond_px.append(np.where(beyond, away_px, 0.0)[np.abs(at.off_px) < ON_LINE_PX])
    every_px = np.concatenate(beyond_px)
    if len(every_px) < MIN_MATCHES:
        return None
    return Negative(float((every_px > 0).mean()), grid_px * float(np.quantile(every_px, QUANTILE)))
