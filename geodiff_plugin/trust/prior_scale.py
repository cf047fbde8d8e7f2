"""Check whether the depth agrees with a metric prior's scale."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import REASON, REMARK, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.constants import STATE_RANGE
from geodiff_plugin.trust.known_points import log_size
from geodiff_plugin.trust.search_range import SearchRange
from geodiff_plugin.trust.stages import ResultStage

UNIT = FindingKind(
    "prior.unit",
    REASON,
    "The depth differs from the metric prior by a factor of more than 20",
    cause="The baseline is not in metres.",
    hint="Check the unit of the baseline. If it really is in metres, set the depth range of the scene to "
    "confirm it (depth_range, --near, --far), or use a different prior.",
)
METRES = FindingKind(
    "prior.metres",
    REMARK,
    "The depth differs from the metric prior by a factor of 1.9 to 20",
    cause="The baseline is not in metres, K is for a different image size, or the prior was not trained on "
    "scenes like this.",
    hint="Check the baseline and K. Ignore this message if the prior was trained on different kinds of "
    "scenes.",
)


@dataclass(frozen=True)
class Ratio:
    """Ratio of the result to a metric prior."""

    ratio: float  # median ratio of the depth to the prior's depth


class PriorScale(Check[Ratio]):
    """Detects lengths in another unit by comparison with a metric prior."""

    kinds = (UNIT, METRES)
    #: A larger ratio is a remark (log).
    REMARKED_LOG_RATIO = math.log(1.9)
    #: A larger ratio is a reason (log). No metric prior is wrong by this much, but wrong units are: inches by
    #: 39, centimetres by 100.
    MAX_LOG_RATIO = math.log(20.0)

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        if stage.over_prior is None or not stage.call.has_unit:
            return {}
        return {"ratio": stage.over_prior.nanmedian()}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Ratio | None:
        return Ratio(numbers["ratio"]) if numbers and not math.isnan(numbers["ratio"]) else None

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None or log_size(fact.ratio) <= cls.REMARKED_LOG_RATIO:
            return
        message = (
            f"The depth is {fact.ratio:.2g} times the metric prior's depth. Check the baseline's unit, K, "
            "and that the prior suits the scene."
        )
        if log_size(fact.ratio) <= cls.MAX_LOG_RATIO:
            yield Finding(METRES, message)
        elif not SearchRange.confirms_unit(facts):
            yield Finding(UNIT, f"{message} {STATE_RANGE}")
