"""Fact sheets, and errors of several causes together."""

from dataclasses import dataclass

import pytest

from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import NO_ERROR, Call, Check, FactSheet, MatchError
from geodiff_plugin.trust.check import combined
from geodiff_plugin.trust.field_of_view import FieldOfView, ViewAngle
from geodiff_plugin.trust.pose_errors import FoundErrors, PoseError, PoseErrors

CALL = Call(range_given=True, findings=(Finding("camera.assumed-cx", "cx is assumed."),))


@dataclass(frozen=True)
class Answer:
    value: int


class Question(Check[Answer]):
    pass


FACTS = FactSheet({Question: Answer(42), FieldOfView: ViewAngle(60.0)}, CALL)


def test_a_fact_sheet_has_the_record_of_each_conclusive_check():
    assert FACTS[Question] == Answer(42) and FACTS[FieldOfView] == ViewAngle(60.0)
    assert FACTS[PoseErrors] is None and FactSheet({Question: None})[Question] is None
    assert FactSheet().call == Call()


def test_later_facts_replace_earlier_ones_and_unknown_ones_do_not():
    both = FACTS | FactSheet({Question: Answer(7), FieldOfView: None, PoseErrors: FoundErrors(())}, Call())
    assert both == FactSheet(
        {Question: Answer(7), FieldOfView: ViewAngle(60.0), PoseErrors: FoundErrors(())}, CALL
    )
    assert FACTS[Question] == Answer(42)


def test_sheets_are_compared_by_their_facts_and_their_call():
    assert FactSheet({Question: Answer(42), FieldOfView: ViewAngle(60.0)}, CALL) == FACTS
    assert FactSheet({Question: Answer(42), FieldOfView: None}) == FactSheet({Question: Answer(42)})
    assert FACTS.of_call(Call()) != FACTS and FACTS | FactSheet({Question: Answer(7)}) != FACTS
    assert FACTS != "facts" and FactSheet({Question: Answer(42)}) != FactSheet()
    with pytest.raises(TypeError, match="unhashable"):
        hash(FACTS)
    assert repr(FACTS) == f"FactSheet({Answer(42)!r}, {ViewAngle(60.0)!r})"


def test_the_same_facts_of_another_call():
    other = FACTS.of_call(Call(has_unit=False))
    assert not other.call.has_unit and other.call.findings == () and other[Question] == Answer(42)


def test_a_record_names_checks_by_their_modules_and_facts_by_their_fields():
    facts = FactSheet({Question: Answer(42), PoseErrors: FoundErrors((PoseError("camera.scaled", 2.0),))})
    assert facts.as_record() == {
        "test_check": {"value": 42},
        "pose_errors": {"found": ({"code": "camera.scaled", "factor": 2.0},)},
    }


def test_a_check_without_methods_has_no_findings():
    assert list(Question.findings(FACTS, ())) == [] and Question.rules_out(None)
    assert Question.match_error(FACTS) == NO_ERROR and Question.confidence_factor(FACTS) == 1.0


def test_errors_of_independent_causes_add_as_their_squares():
    errors = MatchError(0.3, 0.04, 0.0), MatchError(0.4, 0.03, 0.1)
    assert combined(errors) == pytest.approx((0.5, 0.05, 0.1))
    assert combined([]) == NO_ERROR == MatchError(0.0, 0.0, 0.0)
