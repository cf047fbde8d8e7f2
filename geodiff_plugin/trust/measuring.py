"""Measure the facts of all checks at the stages of a call."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

import torch
from torch import Tensor

from geodiff_plugin.trust.check import FactSheet, MatchError, combined
from geodiff_plugin.trust.registry import CHECKS
from geodiff_plugin.trust.stages import (
    ImagesStage,
    MatchesStage,
    PosesStage,
    ResultStage,
    RowsStage,
    TracksStage,
)

K = TypeVar("K")
Stage = ImagesStage | TracksStage | PosesStage | MatchesStage | RowsStage
#: Stage -> name of the method of a check that measures there.
_METHODS = {
    ImagesStage: "of_images",
    TracksStage: "of_tracks",
    PosesStage: "of_poses",
    MatchesStage: "of_matches",
    RowsStage: "of_rows",
}


def measure(stage: Stage) -> FactSheet:
    """Measure the facts of all checks at one stage."""
    return FactSheet({check: getattr(check, _METHODS[type(stage)])(stage) for check in CHECKS})


def measure_result(stage: ResultStage) -> FactSheet:
    """Measure the facts of all checks on a result, reading all tensors in one device transfer."""
    numbers = {check: check.scalars(stage) for check in CHECKS}
    flat = {(check, name): x for check, of_check in numbers.items() for name, x in of_check.items()}
    values = read_numbers(flat)
    return FactSheet(
        {
            check: check.of_result(stage, {name: values[check, name] for name in numbers[check]})
            for check in CHECKS
        },
        stage.call,
    )


def read_numbers(numbers: Mapping[K, Tensor]) -> dict[K, float]:
    """Read tensors ``()`` in one transfer, because every read synchronises with the device."""
    if not numbers:
        return {}
    stacked = torch.stack([x.float() for x in numbers.values()])
    return dict(zip(numbers, stacked.tolist(), strict=True))


def match_error(facts: FactSheet) -> MatchError:
    """Combine the errors of matched depths from all checks."""
    return combined([check.match_error(facts) for check in CHECKS])


def confidence_factor(facts: FactSheet) -> float:
    """Multiply the confidence factors of all checks, in (0, 1]."""
    return math.prod(check.confidence_factor(facts) for check in CHECKS)


def rules_out_everything(facts: FactSheet) -> bool:
    """Whether few, coarse matches exclude every problem that more matches could reveal."""
    return all(check.rules_out(facts[check]) for check in CHECKS)
