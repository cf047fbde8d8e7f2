"""Check whether the baseline and the depth of the scene are plausible in metres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from geodiff_plugin._internal.camera_checks import LONG_BASELINE_M
from geodiff_plugin.cameras import is_rectified
from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.constants import MIN_MATCHES, STATE_RANGE
from geodiff_plugin.trust.search_range import SearchRange
from geodiff_plugin.trust.stages import ResultStage

SHORT = FindingKind(
    "baseline.short",
    REASON,
    "The baseline is shorter than a millimetre",
    cause="The translation was divided by 1000 twice.",
    hint="Specify baselines and poses in metres. If the baseline really is that short, set the depth range "
    "of the scene to confirm it (depth_range, --near, --far).",
)
UNIT = FindingKind(
    "pose.unit",
    REASON,
    "Baseline and depth are implausibly large",
    cause="The baseline or the translation is in centimetres or millimetres.",
    hint="Divide it by 100 or 1000. If the scene really is that far away, set its depth range to confirm it "
    "(depth_range, --near, --far).",
)


@dataclass(frozen=True)
class Lengths:
    """Lengths of the first pair of cameras and of the scene in front of it."""

    rectified: bool  # whether the cameras are parallel and side by side
    baseline_m: float | None  # baseline; None if the scale is unknown
    scene_m: float | None  # median matched depth; None if the scale is unknown or for too few matches


class LengthUnits(Check[Lengths]):
    """Detects a baseline or translation in millimetres or centimetres."""

    kinds = (SHORT, UNIT)
    reviews = ("baseline.long",)
    #: Shortest plausible baseline, metres. ``check_baseline`` warns of those above ``LONG_BASELINE_M``.
    MIN_BASELINE_M = 1e-3
    #: Baseline in metres from which the depth of the scene is tested: both may be in centimetres.
    SUSPECT_BASELINE_M = 5.0
    #: With a suspect baseline, a median depth from this on is more likely the depth of a scene whose baseline
    #: is 100 or 1000 times too long. Nearer scenes pass, because a drone at 100 m has such baselines.
    FAR_SCENE_M = 200.0
    #: ``FAR_SCENE_M`` for rectified rigs, whose cameras are mounted together. A rig that is 100 times smaller
    #: in front of a scene at half a metre or more is more likely.
    FAR_SCENE_OF_RIG_M = 50.0
    #: A scene at more than this many baselines is a distant landscape in any unit.
    MAX_BASELINES_AWAY = 200.0

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        found = stage.matched
        return {name: found[name] for name in ("in_front", "median_m")} if found else {}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Lengths | None:
        if not stage.native.rights:
            return None
        view = stage.native.rights[0]
        rectified = is_rectified(stage.native.left.camera, view.camera, view.T_right_from_left)
        if not stage.call.has_unit:
            return Lengths(rectified, None, None)
        enough = numbers.get("in_front", 0) >= MIN_MATCHES
        return Lengths(
            rectified,
            float(np.linalg.norm(view.T_right_from_left[:3, 3])),
            numbers["median_m"] if enough else None,
        )

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        stated = SearchRange.confirms_unit(facts)
        if not stated:
            yield from (finding for finding in facts.call.findings if finding.code in cls.reviews)
        if fact is None or fact.baseline_m is None:
            return
        if 0 < fact.baseline_m < cls.MIN_BASELINE_M and not stated:
            yield Finding(
                SHORT,
                f"The baseline is {1000 * fact.baseline_m:.3g} mm, which is implausibly short. Specify "
                "baselines and poses in metres. If it is correct, set the depth range to confirm it "
                "(depth_range, --near, --far).",
            )
        if (
            fact.scene_m is not None
            and not stated
            and cls._is_doubtful(fact.baseline_m, fact.scene_m, fact.rectified)
        ):
            yield Finding(
                UNIT,
                f"With a baseline of {fact.baseline_m:.4g} m the median matched depth is {fact.scene_m:.0f} "
                f"m. Divide a baseline in centimetres by 100, one in millimetres by 1000. {STATE_RANGE}",
            )

    @classmethod
    def _is_doubtful(cls, baseline_m: float, scene_m: float, rectified: bool) -> bool:
        """Whether baseline and depth are both likely 100 or 1000 times too large."""
        far_m = cls.FAR_SCENE_OF_RIG_M if rectified else cls.FAR_SCENE_M
        far = far_m <= scene_m <= cls.MAX_BASELINES_AWAY * baseline_m
        return far and cls.SUSPECT_BASELINE_M <= baseline_m <= LONG_BASELINE_M
