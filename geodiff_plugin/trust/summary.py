"""Define ``TrustSummary``, the verdict as the command line, web app and reports show it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from geodiff_plugin.findings import Finding, Severity, dedupe
from geodiff_plugin.trust.registry import NOT_JUDGED
from geodiff_plugin.trust.verdict import Verdict


class Tone(Enum):
    """Colour of a verdict: trusted, trusted under assumptions or not judged, or not trusted."""

    GOOD = "good"
    CAUTION = "caution"
    BAD = "bad"


def summary_words(status: str, assumed: bool) -> str:
    """Return the verdict's ``status`` in words; ``assumed`` is whether an input was assumed."""
    return "trusted, given the assumptions" if status == "trusted" and assumed else status


@dataclass(frozen=True)
class TrustSummary:
    """The verdict in words, and the findings that support it."""

    status: str  # status of the verdict
    tone: Tone
    words: str
    reasons: tuple[Finding, ...]  # reasons why it is not trusted, or else the assumptions


def summarise(verdict: Verdict, findings: Iterable[Finding]) -> TrustSummary:
    """Summarise a verdict and the assumptions among further findings."""
    assumptions = dedupe(each for each in findings if each.severity is Severity.ASSUMPTION)
    words = summary_words(verdict.status, bool(assumptions))
    if verdict.status == "not trusted":
        return TrustSummary(verdict.status, Tone.BAD, words, dedupe(verdict.reasons, assumptions))
    if verdict.status == "not judged":
        untested = [finding for finding in verdict.findings if finding.kind == NOT_JUDGED]
        return TrustSummary(verdict.status, Tone.CAUTION, words, dedupe(untested, assumptions))
    return TrustSummary(verdict.status, Tone.CAUTION if assumptions else Tone.GOOD, words, assumptions)
