"""Check whether matches are on a repeated pattern, where they may be wrong by whole periods."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.findings import REASON, REMARK, Finding, FindingKind
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ResultStage

REPEATED = FindingKind(
    "views.repeated-pattern",
    REMARK,
    "Part of the image is a repeated pattern",
    cause="A fence, tiles, blinds or shelves look the same when shifted by one period along the epipolar "
    "line.",
    hint="Discard low-confidence pixels there, or rotate the rig so that the pattern does not repeat along "
    "the baseline.",
)
UNDECIDED = FindingKind(
    "depth.repeated-pattern",
    REASON,
    "A repeated pattern makes the depth ambiguous",
    cause="The pattern matches at several depths, and neither the prior nor the surroundings resolve which "
    "one is correct.",
    hint="Rotate the rig so that the pattern does not repeat along the baseline, include more of the scene "
    "beyond the pattern, use a better prior, or provide known points.",
)


@dataclass(frozen=True)
class Repetition:
    """How much of the image is a repeated pattern."""

    fraction: float  # fraction of the image on a repeated pattern
    undecided: float  # fraction of the image on one whose depth is more likely wrong than right


class RepeatedPattern(Check[Repetition]):
    """Detects patterns whose costs have a second minimum one period away (``matching.repetition``).

    The prior's depth, corrected by the surroundings, settles the period. It cannot if its error is as large
    as a period, or if it contradicts the matches.
    """

    kinds = (REPEATED, UNDECIDED)
    #: A larger part of the image is worth a remark. One of 13 real pairs has such a pattern, the slats of a
    #: chair (.057); the bars of a cot are .108.
    MIN_FRACTION = 0.05
    #: A larger part whose depth is unknown is a reason. Correct pairs: 0 for that chair, .059 for the cot. A
    #: wall of equal tiles, which all match one period off: .612.
    MAX_UNDECIDED = 0.2

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        matches, confidence = stage.matches, stage.confidence
        if matches is None or matches.repeated is None or confidence is None:
            return {}
        on_pattern = (matches.repeated[None] > 0.5).float()
        confidence = F.interpolate(confidence, matches.size, mode="nearest-exact")
        doubtful = on_pattern * (confidence < RELIABLE)
        return {"fraction": stage.mean(on_pattern), "undecided": stage.mean(doubtful)}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Repetition | None:
        return Repetition(**numbers) if numbers else None

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact is None:
            return
        if fact.undecided > cls.MAX_UNDECIDED:
            yield Finding(
                UNDECIDED,
                f"{100 * fact.undecided:.0f} % of the image is a repeated pattern that matches at several "
                "depths, so its depth may be off by whole periods. Rotate the rig, or provide known points.",
            )
        elif fact.fraction > cls.MIN_FRACTION:
            yield Finding(
                REPEATED,
                f"{100 * fact.fraction:.0f} % of the image is a repeated pattern. Its depth was chosen with "
                "the prior and the surrounding depth, and is less certain. Discard low-confidence pixels "
                "there.",
            )
