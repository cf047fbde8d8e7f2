"""``Evidence``: what the views and points say about the depth of one image, before any network runs (act 1).

Matches, corrections and losses lie on one grid of at most ``sweep_pixels``; the result has the image's size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from torch import Tensor

from geodiff_plugin._threads import BackgroundTask
from geodiff_plugin.matching import CostVolume, Matches
from geodiff_plugin.matching.rows import RowMatches
from geodiff_plugin.messages import Message
from geodiff_plugin.scale.points import reliable_matches
from geodiff_plugin.types import PosedViews, PoseReport


@dataclass(frozen=True)
class Evidence:
    """What the views and points of one image tell about its depth, and what it was made from."""

    native: PosedViews  # cleaned, with the poses in use, each image at its own size
    grid: PosedViews  # the same on the grid of the matches, the right views as fine as the left one
    volume: CostVolume | None  # where the configuration searches it
    matches: Matches | None  # aggregated, left-right checked, where a term asks
    points: Matches | None = None  # depths that the user knows, in the form of matches
    reliable: Matches | None = None  # ``matches`` as points for the search, where enough are reliable
    rows: BackgroundTask[RowMatches] | None = None  # of a rectified pair, at the image's size, for act 3
    report: BackgroundTask[PoseReport] | None = None  # how the poses fit, for act 3
    noticed: tuple[Message, ...] = ()  # what the matching warns of

    def within(self, valid: Tensor) -> Self:
        """The same with confidence 0 where a prior is not ``valid``, on any grid; points stay if none is."""
        matches, points = (m and m.within(valid) for m in (self.matches, self.points))
        if points is not None and not bool(points.confidence.any()):
            points = self.points
        reliable = None if matches is None else reliable_matches(matches)
        return replace(self, matches=matches, points=points, reliable=reliable)
