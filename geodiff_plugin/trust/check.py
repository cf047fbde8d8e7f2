"""Define ``Check``, which measures facts at stages of a call and derives findings from all facts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from torch import Tensor

from geodiff_plugin.findings import Finding, FindingKind
from geodiff_plugin.trust.stages import (
    Call,
    ImagesStage,
    MatchesStage,
    PosesStage,
    ResultStage,
    RowsStage,
    TracksStage,
)

F = TypeVar("F")


class MatchError(NamedTuple):
    """Additional error of matched depths that a fact implies, compared with exact cameras."""

    px: float = 0.0  # standard deviation of the disparity, pixels of the left image
    distortion: float = 0.0  # magnitude of the residual radial coefficient k1 in both images
    relative: float = 0.0  # relative standard deviation common to all depths


NO_ERROR = MatchError()


def combined(errors: Sequence[MatchError]) -> MatchError:
    """Combine the errors of independent causes."""
    return MatchError(*(math.hypot(*each) for each in zip(NO_ERROR, *errors, strict=True)))


class Check(Generic[F]):
    """A check of one image's result. ``F`` is the record of its facts, which holds plain numbers.

    The classmethods of a check define everything about one problem. Checks are never instantiated. To add
    one, add a file with a subclass, a line in ``CHECKS`` and a test file. A fact that cannot be measured is
    ``None``.
    """

    #: The kinds of findings that the check can report.
    kinds: ClassVar[tuple[FindingKind, ...]] = ()
    #: Codes of input findings that are dropped unless ``findings`` confirms them.
    reviews: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def name(cls) -> str:
        """Return the name of the check in reports, which is its module's name."""
        return cls.__module__.rpartition(".")[2]

    @classmethod
    def of_images(cls, stage: ImagesStage) -> F | None:
        """Measure facts in the images, before matching."""
        return None

    @classmethod
    def of_tracks(cls, stage: TracksStage) -> F | None:
        """Measure facts in sparse matches under the given poses."""
        return None

    @classmethod
    def of_poses(cls, stage: PosesStage) -> F | None:
        """Measure facts under the poses in use. They replace the facts from ``of_tracks``."""
        return None

    @classmethod
    def of_matches(cls, stage: MatchesStage) -> F | None:
        """Measure facts in dense matches."""
        return None

    @classmethod
    def of_rows(cls, stage: RowsStage) -> F | None:
        """Measure facts in the rows of a rectified pair."""
        return None

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        """Compute tensors ``()`` that ``of_result`` needs. They are read together for all checks."""
        return {}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> F | None:
        """Measure facts in the result. ``numbers`` holds the values of ``scalars``."""
        return None

    @classmethod
    def rules_out(cls, fact: F | None) -> bool:
        """Whether few, coarse matches suffice to exclude the problem. ``False`` requests more matches."""
        return True

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        """Yield the findings. ``earlier`` holds input findings and findings of earlier ``CHECKS``."""
        return iter(())

    @classmethod
    def match_error(cls, facts: FactSheet) -> MatchError:
        """Return the additional error of matched depths."""
        return NO_ERROR

    @classmethod
    def confidence_factor(cls, facts: FactSheet) -> float:
        """Return the factor on the confidence, in (0, 1]."""
        return 1.0


class FactSheet:
    """The facts of one image by check: ``facts[Tearing]`` is a record, or ``None`` if not measured."""

    def __init__(self, facts: Mapping[type[Check[Any]], Any] | None = None, call: Call | None = None) -> None:
        self._facts = {check: fact for check, fact in (facts or {}).items() if fact is not None}
        self.call = Call() if call is None else call

    def __getitem__(self, check: type[Check[F]]) -> F | None:
        return self._facts.get(check)

    def __or__(self, later: FactSheet) -> FactSheet:
        """Merge two sheets. Later facts override earlier ones; the call is the first sheet's."""
        return FactSheet(self._facts | later._facts, self.call)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, FactSheet):
            return NotImplemented
        return (self._facts, self.call) == (other._facts, other.call)

    __hash__ = None  # type: ignore[assignment]  # compared by value; records may not be hashable

    def __repr__(self) -> str:
        return f"FactSheet({', '.join(map(repr, self._facts.values()))})"

    def of_call(self, call: Call) -> FactSheet:
        """Return the same facts for another call."""
        return FactSheet(self._facts, call)

    def as_record(self) -> dict[str, dict[str, Any]]:
        """Return the facts as a JSON record of a report: ``{check: {fact: value}}``."""
        return {check.name(): asdict(fact) for check, fact in self._facts.items()}
