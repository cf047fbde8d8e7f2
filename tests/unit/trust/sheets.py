"""Fact sheets from records alone."""

from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any, NamedTuple, get_args

from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import CHECKS, Call, Check, FactSheet, judge
from geodiff_plugin.trust.field_of_view import ViewAngle
from geodiff_plugin.trust.length_units import Lengths
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.prior_correlation import Correlation
from geodiff_plugin.trust.shifted_copy import DepthRange


def record_type(check: type[Check[Any]]) -> type | None:
    """The type of a check's facts; ``None`` if it measures nothing."""
    (base,) = check.__orig_bases__
    (record,) = get_args(base)
    return record if is_dataclass(record) else None


CHECK_OF = {record_type(check): check for check in CHECKS if record_type(check) is not None}
#: The facts of a good pair without a metric prior or known points.
GOOD = (
    Matched(0.8, 0.85),
    Correlation(0.8),
    DepthRange(0.7, 30.0),
    Lengths(False, 0.12, 5.0),
    ViewAngle(60.0),
)


def sheet(*records: Any, **call: Any) -> FactSheet:
    """The sheet of these records, for a ``Call`` of these fields."""
    return FactSheet({CHECK_OF[type(record)]: record for record in records}, Call(**call))


def good(*records: Any, **call: Any) -> FactSheet:
    """The sheet of a good pair, but for these records and this call."""
    return sheet(*GOOD, **call) | sheet(*records)


def codes(facts: FactSheet) -> list[str]:
    """The codes of all findings of a verdict."""
    return [finding.code for finding in judge(facts).findings]


def judged(facts: FactSheet, code: str) -> Finding:
    """The one finding of a verdict that has a code."""
    (finding,) = [finding for finding in judge(facts).findings if finding.code == code]
    return finding


class Case(NamedTuple):
    """What changes at a threshold: on its one side the answer is ``below``, on the other one ``above``."""

    threshold: str  # the name of the constant
    facts: Callable[[float], FactSheet]  # with a number that is compared with the threshold
    below: Any
    above: Any
    answer: Callable[[FactSheet], Any] = codes
