"""Check whether dense matching works clearly better under the inverse pose."""

from __future__ import annotations

from dataclasses import dataclass

from geodiff_plugin.matching import inverse_pose_preferred
from geodiff_plugin.trust.check import Check
from geodiff_plugin.trust.stages import MatchesStage


@dataclass(frozen=True)
class Preference:
    """The pose that dense matching prefers."""

    inverse: bool  # whether clearly more is matched under the inverse pose


class InversePose(Check[Preference]):
    """Measures with two coarse sweeps whether the images were swapped or E is world-to-camera.

    ``PoseErrors`` reports the finding, because sparse matches can show the same problem.
    """

    @classmethod
    def of_matches(cls, stage: MatchesStage) -> Preference | None:
        return Preference(inverse_pose_preferred(stage.native, stage.matches))
