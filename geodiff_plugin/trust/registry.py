"""List all checks (``CHECKS``) in the order in which findings are reported, most explanatory first.

``KINDS`` maps codes to the kinds of all findings, including input findings (``FINDINGS``).
"""

from __future__ import annotations

from typing import Any

from geodiff_plugin.findings import FINDINGS, WARNING, FindingKind
from geodiff_plugin.trust.agreement import Agreement
from geodiff_plugin.trust.blocked_view import BlockedView
from geodiff_plugin.trust.check import Check
from geodiff_plugin.trust.defocus import Defocus
from geodiff_plugin.trust.depth_order import DepthOrder
from geodiff_plugin.trust.distortion import Distortion
from geodiff_plugin.trust.epipolar import Epipolar
from geodiff_plugin.trust.field_of_view import FieldOfView
from geodiff_plugin.trust.identical_views import IdenticalViews
from geodiff_plugin.trust.inverse_pose import InversePose
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.length_units import LengthUnits
from geodiff_plugin.trust.letterbox import Letterbox
from geodiff_plugin.trust.matched_fraction import MatchedFraction
from geodiff_plugin.trust.moving_objects import MovingObjects
from geodiff_plugin.trust.negative_disparity import NegativeDisparity
from geodiff_plugin.trust.occlusion_order import OcclusionOrder
from geodiff_plugin.trust.order_ambiguity import OrderAmbiguity
from geodiff_plugin.trust.pose_errors import PoseErrors
from geodiff_plugin.trust.pose_uncertainty import PoseUncertainty
from geodiff_plugin.trust.prior_correlation import PriorCorrelation
from geodiff_plugin.trust.prior_scale import PriorScale
from geodiff_plugin.trust.repeated_pattern import RepeatedPattern
from geodiff_plugin.trust.result_vs_matches import ResultVsMatches
from geodiff_plugin.trust.rolling_shutter import RollingShutter
from geodiff_plugin.trust.search_edge import SearchEdge
from geodiff_plugin.trust.search_range import SearchRange
from geodiff_plugin.trust.shifted_copy import ShiftedCopy
from geodiff_plugin.trust.tearing import Tearing
from geodiff_plugin.trust.unchecked_pose import UncheckedPose

CHECKS: tuple[type[Check[Any]], ...] = (
    IdenticalViews,
    BlockedView,
    LengthUnits,
    PriorScale,
    InversePose,
    PoseErrors,
    ShiftedCopy,
    RepeatedPattern,
    SearchRange,
    KnownPoints,
    PoseUncertainty,
    ResultVsMatches,
    PriorCorrelation,
    OrderAmbiguity,
    OcclusionOrder,
    DepthOrder,
    NegativeDisparity,
    MovingObjects,
    Tearing,
    RollingShutter,
    Distortion,
    UncheckedPose,
    Epipolar,
    MatchedFraction,
    Agreement,
    FieldOfView,
    Letterbox,
    Defocus,
    SearchEdge,
)

NOT_TRUSTED = FindingKind(
    "verdict.not-trusted",
    WARNING,
    "Do not trust this depth",
    cause="At least one reason not to trust it was found; the message lists all of them.",
    hint="Look up each reason in the tables above.",
)
NOT_JUDGED = FindingKind(
    "verdict.not-judged",
    WARNING,
    "This depth could not be verified",
    cause="There is nothing to check it against: no matches from a second view, and too few known depths "
    "spread over the image.",
    hint="Add an overlapping second view, or at least 50 known points spread over the image.",
)
KINDS = FINDINGS | {
    kind.code: kind
    for kinds in (*(check.kinds for check in CHECKS), (NOT_TRUSTED, NOT_JUDGED))
    for kind in kinds
}
