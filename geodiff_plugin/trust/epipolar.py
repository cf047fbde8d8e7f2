"""Check the epipolar errors of matches, and whether a better pose was found nearby."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from geodiff_plugin.findings import REASON, REMARK, WARNING, Finding, FindingKind
from geodiff_plugin.pose.fit import FITS_PX
from geodiff_plugin.pose.tracks import MIN_MATCHES
from geodiff_plugin.trust.check import Check, FactSheet, MatchError
from geodiff_plugin.trust.length_units import LengthUnits
from geodiff_plugin.trust.stages import PosesStage
from geodiff_plugin.types import RejectedPose

FEW_MATCHES = FindingKind(
    "pose.few-matches",
    REASON,
    "There are too few feature matches to confirm either the refined or the given pose",
    cause="The given pose contradicts the optical flow between the images, which have too little texture or "
    "overlap to check it reliably.",
    hint="Provide a more accurate pose, or use views with more texture or overlap.",
)
KEPT = FindingKind(
    "pose.kept",
    WARNING,
    "The given pose has an epipolar error above 1 px, and no nearby pose is clearly better",
    cause="The pose is inaccurate, objects moved between the images, a rolling shutter or lens distortion "
    "deforms the images, K is for a different image size, the views are in the wrong order, or the poses are "
    "world-to-camera.",
    hint="Check the causes in the message in the order listed.",
)
REFINED = FindingKind(
    "pose.refined",
    WARNING,
    "The given pose had an epipolar error above 1 px (0.45 px for a rectified rig) and was refined",
    cause="The pose is from a tracker or SLAM, or the cameras of the rig have shifted since calibration.",
    hint="No action is needed if the refined error is below 1 px; otherwise check the causes in the message.",
)
TOO_FAR = FindingKind(
    "pose.too-far",
    WARNING,
    "The best-fitting pose is too far from the given one and was not used",
    cause="The given pose belongs to a different pair, or uses a different convention.",
    hint="Correct the pose, or estimate it (from_unposed_images, --estimate-pose).",
)
EPIPOLAR_ERROR = FindingKind(
    "pose.epipolar-error",
    REASON,
    "The epipolar error is above 4 px",
    cause="The pair is not rectified, K is for different images, or E is for a different pair.",
    hint="Check these causes in the order listed.",
)
RESIDUAL = FindingKind(
    "pose.residual",
    REMARK,
    "The epipolar error is 2 to 4 px",
    cause="The rectification or the pose is inaccurate, or lens distortion was not removed.",
    hint="Rectify or undistort the images, or check K and the pose.",
)

_CAUSES = (
    "Likely causes: inaccurate poses (tracker, SLAM, drifted rig), moving objects, rolling shutter, "
    "lens distortion, K for a different size, wrong view order, world-to-camera poses."
)
_DRIFT = (
    "Likely cause: the rig has drifted since calibration. Recalibrate it, or keep its calibration "
    "(pose='given', --set pose=given)."
)


@dataclass(frozen=True)
class Residuals:
    """Median epipolar error of the matches per right view, in pixels of the match grid.

    The error of a view with too few matches is ``None``.
    """

    status: str  # status of the ``PoseReport``
    given_px: tuple[float | None, ...]  # errors under the given poses
    used_px: tuple[float | None, ...]  # errors under the poses and with the images in use
    warp_rms_px: float  # RMS residual warp of the right image, maximum over the views
    grid_px: float  # pixels of the left image per pixel of the grid
    rig: bool  # whether the given poses describe a rectified rig
    features: int | None  # number of matching features, if too few to check the poses
    rejected: RejectedPose | None  # a pose that fits but is too far from the given one

    @property
    def worst(self) -> int:
        """Index of the view with the largest error under the given poses."""
        return max(range(len(self.given_px)), key=lambda v: self.given_px[v] or 0.0)

    @property
    def worst_used_px(self) -> float | None:
        """The largest error under the poses in use."""
        return max((px for px in self.used_px if px is not None), default=None)

    @property
    def worst_given_px(self) -> float | None:
        """The largest error under the given poses."""
        return max((px for px in self.given_px if px is not None), default=None)


class Epipolar(Check[Residuals]):
    """Detects poses or cameras with a large epipolar error."""

    kinds = (FEW_MATCHES, KEPT, REFINED, TOO_FAR, EPIPOLAR_ERROR, RESIDUAL)
    #: A larger error of a given pose is a warning.
    WARNS_PX = 1.0
    #: A larger error under the best nearby pose is a remark.
    MAX_REMARKED_PX = 2.0
    #: A larger error under the best nearby pose is a reason.
    MAX_PX = 2 * MAX_REMARKED_PX
    #: A larger error is a weak indicator (see ``Agreement``).
    WEAK_PX = 1.0
    #: Correct pairs of rectified rigs have this error. Only the excess over it is assumed to occur along the
    #: epipolar lines too, where it changes depth. Under any other pose the whole error counts. The log loss
    #: of 90 pairs from three trackers is within .001 of its minimum for factors up to 1.25, and the log loss
    #: of rendered pairs decreases with larger factors.
    USUAL_PX = FITS_PX
    #: RMS warp of the right image that corrects the epipolar error of correct pairs.
    USUAL_WARP_PX = 1.0

    @classmethod
    def of_poses(cls, stage: PosesStage) -> Residuals | None:
        report = stage.report
        if report.status == "given":
            return None
        given, used = (
            tuple(None if math.isnan(px) else px for px in residuals)
            for residuals in (report.residual_px_given, report.residual_px)
        )
        return Residuals(
            report.status,
            given,
            used,
            max(report.warp_rms_px, default=0.0),
            stage.grid_px,
            report.rig,
            report.features,
            report.rejected,
        )

    @classmethod
    def is_weak(cls, facts: FactSheet) -> bool:
        """Whether the error is a weak indicator of inconsistent views."""
        fact = facts[cls]
        return fact is not None and (fact.worst_used_px or 0.0) > cls.WEAK_PX

    @classmethod
    def is_good(cls, facts: FactSheet) -> bool:
        """Whether the matches are known to have a small epipolar error."""
        fact = facts[cls]
        return fact is not None and fact.worst_used_px is not None and fact.worst_used_px < cls.WEAK_PX

    @classmethod
    def misses_by_px(cls, facts: FactSheet) -> float | None:
        """Return the error of the given poses if it exceeds ``MAX_PX``."""
        fact = facts[cls]
        px = None if fact is None else fact.worst_given_px
        return px if px is not None and px > cls.MAX_PX else None

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None:
            return
        yield from _of_refinement(fact)
        px = fact.worst_used_px
        if px is not None and px > cls.MAX_REMARKED_PX:
            yield Finding(
                EPIPOLAR_ERROR if px > cls.MAX_PX else RESIDUAL,
                f"The epipolar error is {px:.1f} px under the best nearby pose, so depth is off. Check "
                "rectification, poses and K.",
            )

    @classmethod
    def match_error(cls, facts: FactSheet) -> MatchError:
        fact, lengths = facts[cls], facts[LengthUnits]
        if fact is None:
            return MatchError()
        usual_px = cls.USUAL_PX if lengths is not None and lengths.rectified else 0.0
        across_px = math.hypot(
            beyond(fact.worst_used_px or 0.0, usual_px), beyond(fact.warp_rms_px, cls.USUAL_WARP_PX)
        )
        return MatchError(px=across_px * fact.grid_px)


def beyond(deviation: float, usual: float) -> float:
    """Return the standard deviation that remains after subtracting the usual variance."""
    return math.sqrt(max(0.0, deviation**2 - usual**2))


def _of_refinement(fact: Residuals) -> Iterator[Finding]:
    """Yield the findings about pose refinement."""
    worst_px = fact.worst_given_px
    if worst_px is None:
        return
    # A refined rig is always reported, because a calibration is supposed to be exact.
    limit_px = FITS_PX if fact.rig and fact.status == "refined" else Epipolar.WARNS_PX
    if worst_px > limit_px:
        if fact.rejected is not None:
            yield _too_far(fact, fact.rejected)
        elif fact.status == "kept":
            yield Finding(
                KEPT, f"{_misses(fact, fact.worst)}, and no nearby pose is clearly better. {_CAUSES}"
            )
        elif fact.status == "refined":
            causes = _CAUSES if worst_px > Epipolar.WARNS_PX else _DRIFT
            refined_px = fact.used_px[fact.worst] or 0.0
            yield Finding(REFINED, f"{_misses(fact, fact.worst)}; refined to {refined_px:.1f} px. {causes}")
    if fact.features is not None:
        yield Finding(
            FEW_MATCHES,
            f"Only {fact.features} features match, but {MIN_MATCHES} are needed to check the pose. Optical "
            f"flow implies a median epipolar error of {worst_px:.1f} px. Provide a more accurate pose.",
        )


def _misses(fact: Residuals, v: int) -> str:
    """State the median epipolar error of the given pose of view ``v``."""
    pose = "The given pose" if len(fact.given_px) == 1 else f"The given pose of right view {v + 1}"
    return f"{pose} has a median epipolar error of {fact.given_px[v] or 0.0:.1f} px"


def _too_far(fact: Residuals, rejected: RejectedPose) -> Finding:
    return Finding(
        TOO_FAR,
        f"{_misses(fact, rejected.view)}. A better pose ({rejected.residual_px:.1f} px) was rejected: it is "
        f"{rejected.degrees:.0f} degrees and {100 * rejected.of_baseline:.0f} % of the baseline away. "
        f"{_CAUSES}",
    )
