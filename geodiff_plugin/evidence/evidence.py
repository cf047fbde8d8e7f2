"""``Evidence``: depth information from the views and points of one image (phase 1).

Matches, match fits and losses use one grid of at most ``sweep_pixels``. The result has the image's size.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

from torch import Tensor

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.matching import CostVolume, Matches
from geodiff_plugin.matching.rows import RowMatches
from geodiff_plugin.scale.points import reliable_matches
from geodiff_plugin.trust import FactSheet
from geodiff_plugin.types import PoseReport


@dataclass(frozen=True)
class Evidence:
    """Depth information from the views and points of one image, and the data that it was made from.

    The last three fields are for phase 3 and may still be computed while phase 2 runs:
    ``EvidencePlan.complete`` fills them in.
    """

    native: PosedViews  # cleaned views of native size, with the poses in use
    grid: PosedViews  # the same on the grid of the matches; all views as fine as the left one
    volume: CostVolume | None  # if the search needs it
    matches: Matches | None  # aggregated and left-right checked, if a term needs them
    points: Matches | None = None  # user-given depths as matches
    reliable: Matches | None = None  # ``matches`` as points for the search, if enough are reliable
    points_outside: int = 0  # number of user-given points outside the left image
    rows: RowMatches | None = None  # of a rectified pair, at native size
    report: PoseReport | None = None  # fit of the poses; None without a right view
    facts: FactSheet = field(default_factory=FactSheet)  # from the checks of phase 1

    def within(self, valid: Tensor) -> Self:
        """Set confidence to 0 where a prior is not ``valid``; points are kept if none would remain."""
        matches, points = (m and m.within(valid) for m in (self.matches, self.points))
        if points is not None and not bool(points.confidence.any()):
            points = self.points
        reliable = None if matches is None else reliable_matches(matches)
        return replace(self, matches=matches, points=points, reliable=reliable)
