"""Checks whether a result can be trusted, and reports why not.

"Trusted" means that no inconsistency was found. It is not a guarantee.

Each check is one class in one file (``Check``). It measures facts at stages of a call and derives findings
from the facts of all checks. The verdict is a function of the findings. To add a check, add a file with a
subclass, a line in ``registry.CHECKS`` and a test file. Contract tests and the message reference then cover
it.

Layer 4: imports ``pose``, ``matching`` and below. The phases, ``runtime`` and ``jobs`` import the names
listed here.
"""

from __future__ import annotations

from geodiff_plugin.trust.agreement import Agreement
from geodiff_plugin.trust.check import NO_ERROR, Check, FactSheet, MatchError
from geodiff_plugin.trust.epipolar import Epipolar
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.measuring import (
    confidence_factor,
    match_error,
    measure,
    measure_result,
    rules_out_everything,
)
from geodiff_plugin.trust.pose_errors import PoseErrors
from geodiff_plugin.trust.pose_uncertainty import PoseUncertainty
from geodiff_plugin.trust.registry import CHECKS, KINDS, NOT_TRUSTED
from geodiff_plugin.trust.rolling_shutter import vertical_lines
from geodiff_plugin.trust.stages import (
    Call,
    ImagesStage,
    MatchesStage,
    PosesStage,
    ResultStage,
    RowsStage,
    TracksStage,
)
from geodiff_plugin.trust.summary import Tone, TrustSummary, summarise, summary_words
from geodiff_plugin.trust.verdict import UNTESTED, Verdict, judge

__all__ = [
    "CHECKS",
    "KINDS",
    "NOT_TRUSTED",
    "NO_ERROR",
    "UNTESTED",
    "Agreement",
    "Call",
    "Check",
    "Epipolar",
    "FactSheet",
    "ImagesStage",
    "KnownPoints",
    "MatchError",
    "MatchedFraction",
    "MatchesStage",
    "PoseErrors",
    "PoseUncertainty",
    "PosesStage",
    "ResultStage",
    "RowsStage",
    "Tone",
    "TracksStage",
    "TrustSummary",
    "Verdict",
    "confidence_factor",
    "judge",
    "match_error",
    "measure",
    "measure_result",
    "rules_out_everything",
    "summarise",
    "summary_words",
    "vertical_lines",
]
