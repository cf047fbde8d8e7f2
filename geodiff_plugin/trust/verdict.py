"""Derive the verdict on one image's result from the facts of its checks (``judge``)."""

from __future__ import annotations

from dataclasses import dataclass

from geodiff_plugin.findings import REASON, REMARK, Finding, dedupe
from geodiff_plugin.trust.check import FactSheet
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.registry import CHECKS, NOT_JUDGED, NOT_TRUSTED

#: Why a depth is not judged.
UNTESTED = "there are no matches from a second view, and too few known depths spread over the image"


@dataclass(frozen=True)
class Verdict:
    """Whether one image's depth can be trusted.

    "Trusted" means that no inconsistency was found. It is not a guarantee: a wrong baseline length is not
    observable from the images, nor is a wrong focal length for a rectified pair. Some errors shift matches
    along their epipolar lines: a wrong cx of the right camera, the yaw of nearly parallel cameras, a
    stretched image, a rolling shutter, moving objects. They are detected only if they cause negative
    disparities, frame tearing, leaning vertical lines, or far surfaces that occlude near ones.
    """

    status: str  # "trusted", "not trusted", or "not judged" if nothing could test the depth
    findings: tuple[Finding, ...]  # findings about this result, the most likely cause first
    facts: FactSheet

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """Reasons why it is not trusted, the most likely cause first."""
        return tuple(finding for finding in self.findings if finding.severity is REASON)

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings that are unusual, but possibly correct."""
        return tuple(finding for finding in self.findings if finding.severity is REMARK)

    @property
    def summary(self) -> Finding | None:
        """The verdict as one finding; ``None`` if the depth is trusted."""
        if self.status == "not trusted":
            return Finding(NOT_TRUSTED, f"Do not trust this depth: {' '.join(self.reasons)}")
        return next((finding for finding in self.findings if finding.kind == NOT_JUDGED), None)

    @property
    def trusted(self) -> bool:
        """Whether the status is ``"trusted"``."""
        return self.status == "trusted"


def judge(facts: FactSheet) -> Verdict:
    """Derive the verdict: not trusted if there is a reason, not judged if nothing tests the depth.

    A reason that another finding explains is dropped (``FindingKind.explains``).
    """
    reviewed = {code for check in CHECKS for code in check.reviews}
    found = [each for each in facts.call.findings if each.is_reason and each.code not in reviewed]
    for check in CHECKS:
        found += check.findings(facts, found)
    findings = dedupe(each for each in found if not (each.is_reason and _is_explained(each, found)))
    judged = MatchedFraction.has_matches(facts) or KnownPoints.test_the_depth(facts)
    reasons = any(finding.is_reason for finding in findings)
    if reasons or judged:
        return Verdict("not trusted" if reasons else "trusted", findings, facts)
    untested = Finding(NOT_JUDGED, f"This depth could not be verified: {UNTESTED}.")
    return Verdict("not judged", (*findings, untested), facts)


def _is_explained(finding: Finding, found: list[Finding]) -> bool:
    """Whether another finding suppresses this one."""
    kinds = {each.kind for each in found if each.code != finding.code}
    return any(finding.code in kind.explains or "*" in kind.explains for kind in kinds)
