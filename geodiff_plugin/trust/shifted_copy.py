"""Check whether all matches have one depth, as if the right image were a shifted copy of the left one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.constants import MIN_MATCHES
from geodiff_plugin.trust.stages import ResultStage

SHIFTED = FindingKind(
    "views.shifted",
    REASON,
    "All matches have the same depth",
    cause="The right image is a shifted copy of the left one, or the scene is a fronto-parallel wall.",
    hint="Use a second image from a different viewpoint.",
)


@dataclass(frozen=True)
class DepthRange:
    """The range of the matched depths from their 5 % to their 95 % quantile."""

    log_ratio: float  # log ratio of the two quantiles
    planes: float  # difference of the two quantiles in planes of the sweep


class ShiftedCopy(Check[DepthRange]):
    """Detects matches that all have the same depth.

    The matched depths are within two planes of the sweep, and their ratio is small. The second condition is
    needed because all distant depths are within two planes.
    """

    kinds = (SHIFTED,)
    #: Log ratio below which a scene may be a single plane.
    MAX_LOG_RATIO = 0.2
    #: Difference in planes of the sweep below which a scene may be a single plane.
    MAX_PLANES = 2.0

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        found = stage.matched
        names = ("in_front", "log_range", "range_planes") if found else ()
        return {name: found[name] for name in names}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> DepthRange | None:
        if numbers.get("in_front", 0) < MIN_MATCHES:
            return None
        return DepthRange(numbers["log_range"], numbers["range_planes"])

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.log_ratio < cls.MAX_LOG_RATIO and fact.planes < cls.MAX_PLANES:
            yield Finding(
                SHIFTED,
                "All matches have the same depth: the right image may be a shifted copy. Use a different "
                "image, unless the scene is a flat wall.",
            )
