"""The words, the tone and the reasons of every kind of result."""

from dataclasses import FrozenInstanceError

import pytest

from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import KINDS, FactSheet, Tone, TrustSummary, Verdict, summarise, summary_words

REASONS = (Finding(KINDS["views.identical"], "Same."), Finding(KINDS["views.moved"], "Moved."))
REMARK = Finding(KINDS["camera.field-of-view"], "12 degrees.")
CENTRE, EXIF = Finding("camera.assumed-cx", "cx is assumed."), Finding("camera.from-exif", "K is from EXIF.")
LENS, METRES = (
    Finding("camera.assumed-intrinsics", "cx is filled in."),
    Finding("scale.from-prior", "The prior's metres."),
)
OTHER = Finding("image.alpha", "Alpha is dropped.")
NOT_JUDGED = Finding(KINDS["verdict.not-judged"], "It was not judged.")
IF = "trusted, given the assumptions"


@pytest.mark.parametrize(
    ("status", "found", "others", "tone", "words", "shown"),
    [
        ("trusted", (), (), Tone.GOOD, "trusted", ()),
        ("trusted", (REMARK,), (OTHER,), Tone.GOOD, "trusted", ()),
        ("trusted", (), (CENTRE, OTHER), Tone.CAUTION, IF, (CENTRE,)),
        ("trusted", (), (EXIF, OTHER), Tone.CAUTION, IF, (EXIF,)),
        ("trusted", (), (CENTRE, OTHER, LENS, METRES, CENTRE), Tone.CAUTION, IF, (CENTRE, LENS, METRES)),
        ("not trusted", (*REASONS, REMARK), (), Tone.BAD, "not trusted", REASONS),
        (
            "not trusted",
            REASONS,
            (CENTRE, REASONS[0], EXIF),
            Tone.BAD,
            "not trusted",
            (*REASONS, CENTRE, EXIF),
        ),
        ("not judged", (NOT_JUDGED,), (), Tone.CAUTION, "not judged", (NOT_JUDGED,)),
        (
            "not judged",
            (REMARK, NOT_JUDGED),
            (EXIF, CENTRE),
            Tone.CAUTION,
            "not judged",
            (NOT_JUDGED, EXIF, CENTRE),
        ),
    ],
)
def test_the_summary_of_a_result(status, found, others, tone, words, shown):
    summary = summarise(Verdict(status, found, FactSheet()), others)
    assert summary == TrustSummary(status, tone, words, shown)
    assert [finding.code for finding in summary.reasons] == [finding.code for finding in shown]
    with pytest.raises(FrozenInstanceError):
        summary.status = "trusted"


def test_only_a_trusted_result_depends_on_what_is_assumed():
    assert summary_words("trusted", True) != summary_words("trusted", False) == "trusted"
    for status in ("not trusted", "not judged"):
        assert summary_words(status, True) == summary_words(status, False) == status


def test_the_tones_differ():
    assert len({tone.value for tone in Tone}) == 3
