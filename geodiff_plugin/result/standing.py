"""How far a result may be relied on, in the words of every door: command line, page and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from geodiff_plugin.messages import MESSAGES, Message, distinct
from geodiff_plugin.types import UNTESTED, Verdict

#: Of every message that is an assumption: the result is right if it holds.
ASSUMPTIONS = ("camera.same-centre", "camera.filled-in", "camera.from-exif", "scale.from-prior")


class Tone(Enum):
    """What a result calls for: nothing, a look at what was assumed, or another run."""

    GOOD = "good"
    CAUTION = "caution"
    BAD = "bad"


def standing_words(status: str, assumed: bool) -> str:
    """The verdict's ``status`` in words; ``assumed`` says whether an input was assumed."""
    return "trusted if what is assumed holds" if status == "trusted" and assumed else status


@dataclass(frozen=True)
class Standing:
    """What is said about a result: its words, and what they rest on with the cure of each."""

    status: str  # of the verdict
    tone: Tone
    words: str
    reasons: tuple[Message, ...]  # why it is not trusted, or else what was assumed


def standing_of(verdict: Verdict, assumed: Sequence[Message], notes: Sequence[Message] = ()) -> Standing:
    """The standing of a result by its verdict and what was assumed for it.

    Args:
        verdict: of ``result.verdict.judge``.
        assumed: messages of ``MetricDepthOutput.assumed``.
        notes: further messages, of which only those count that are assumptions.
    """
    assumptions = distinct(assumed, (note for note in notes if note.code in ASSUMPTIONS))
    words = standing_words(verdict.status, bool(assumptions))
    if verdict.status == "not trusted":
        return Standing(verdict.status, Tone.BAD, words, distinct(verdict.reasons, assumptions))
    if verdict.status == "not judged":
        untested = Message("verdict.not-judged", f"It was not judged: {UNTESTED}.")
        return Standing(verdict.status, Tone.CAUTION, words, distinct((untested,), assumptions))
    return Standing(verdict.status, Tone.CAUTION if assumptions else Tone.GOOD, words, assumptions)


def cure_of(message: Message) -> str:
    """What to do about a message, from the table of all."""
    return MESSAGES[message.code].cure
