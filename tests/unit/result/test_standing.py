"""The words, the tone and the reasons of every kind of result."""

from dataclasses import FrozenInstanceError

import pytest

from geodiff_plugin.messages import MESSAGES, Message
from geodiff_plugin.result.standing import Standing, Tone, cure_of, standing_of, standing_words
from geodiff_plugin.types import UNTESTED, Indicators, Verdict

REASONS = (Message("views.same", "Same."), Message("views.moved", "Moved."))
CENTRE, EXIF = Message("camera.same-centre", "cx is assumed."), Message("camera.from-exif", "K is from EXIF.")
LENS, METRES = (
    Message("camera.filled-in", "cx is filled in."),
    Message("scale.from-prior", "The prior's metres."),
)
OTHER = Message("image.alpha", "Alpha is dropped.")
NOT_JUDGED = Message("verdict.not-judged", f"It was not judged: {UNTESTED}.")


@pytest.mark.parametrize(
    ("status", "reasons", "assumed", "notes", "tone", "words", "shown"),
    [
        ("trusted", (), (), (), Tone.GOOD, "trusted", ()),
        ("trusted", (), (), (OTHER,), Tone.GOOD, "trusted", ()),
        ("trusted", (), (CENTRE,), (OTHER,), Tone.CAUTION, "trusted if what is assumed holds", (CENTRE,)),
        ("trusted", (), (), (EXIF, OTHER), Tone.CAUTION, "trusted if what is assumed holds", (EXIF,)),
        (
            "trusted",
            (),
            (CENTRE, OTHER),
            (LENS, METRES, CENTRE),
            Tone.CAUTION,
            "trusted if what is assumed holds",
            (CENTRE, OTHER, LENS, METRES),
        ),
        ("not trusted", REASONS, (), (), Tone.BAD, "not trusted", REASONS),
        (
            "not trusted",
            REASONS,
            (CENTRE,),
            (REASONS[0], EXIF),
            Tone.BAD,
            "not trusted",
            (*REASONS, CENTRE, EXIF),
        ),
        ("not judged", (), (), (), Tone.CAUTION, "not judged", (NOT_JUDGED,)),
        ("not judged", (), (EXIF,), (CENTRE,), Tone.CAUTION, "not judged", (NOT_JUDGED, EXIF, CENTRE)),
    ],
)
def test_what_is_said_of_a_result(status, reasons, assumed, notes, tone, words, shown):
    found = standing_of(Verdict(status, reasons, (), Indicators()), assumed, notes)
    assert found == Standing(status, tone, words, shown)
    assert [message.code for message in found.reasons] == [message.code for message in shown]
    with pytest.raises(FrozenInstanceError):
        found.status = "trusted"


def test_without_notes_only_what_was_assumed_counts():
    verdict = Verdict("trusted", (), (), Indicators())
    assert standing_of(verdict, ()) == standing_of(verdict, (), ())
    assert standing_of(verdict, (EXIF,)).reasons == (EXIF,)


def test_only_a_trusted_result_depends_on_what_is_assumed():
    assert standing_words("trusted", True) != standing_words("trusted", False) == "trusted"
    for status in ("not trusted", "not judged"):
        assert standing_words(status, True) == standing_words(status, False) == status


def test_every_message_has_the_cure_of_its_own_code():
    for code, kind in MESSAGES.items():
        assert cure_of(Message(code, "A sentence.")) == kind.cure != ""
    assert len({tone.value for tone in Tone}) == 3
