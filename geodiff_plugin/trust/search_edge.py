"""Check whether the scale search ended at the edge of its range."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.findings import REMARK, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.search_range import SearchRange
from geodiff_plugin.trust.stages import ResultStage

EDGE = FindingKind(
    "depth.search-edge",
    REMARK,
    "The scale search ended at the edge of its range",
    cause="The true depth may be outside the search range.",
    hint="Check the unit of the baseline, or widen depth_range (--near, --far).",
)


@dataclass(frozen=True)
class Edge:
    """The end of the scale search."""

    on_edge: bool  # whether it ended at the edge of its range, for any ensemble member


class SearchEdge(Check[Edge]):
    """Detects a scale that may be outside the search range.

    This is reported only if the result is not trusted for other reasons, or if matches are at an end of a
    given range. The check is therefore after all checks with reasons.
    """

    kinds = (EDGE,)

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        return {} if stage.on_edge is None else {"on_edge": stage.on_edge}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Edge | None:
        return Edge(numbers["on_edge"] > 0) if numbers else None

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact, ends = facts[cls], facts[SearchRange]
        at_ends = ends is not None and ends.fraction > SearchRange.MANY
        if fact and fact.on_edge and (at_ends or any(finding.is_reason for finding in earlier)):
            yield Finding(
                EDGE,
                "The scale search ended at the edge of its range; depth may be wrong. Check the baseline, "
                "or widen depth_range (--near, --far).",
            )
