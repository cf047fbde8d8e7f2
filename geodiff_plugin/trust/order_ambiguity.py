"""Check whether the matches would also fit an inverted depth order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from geodiff_plugin.pose.tracks import MIN_MATCHES, Tracks
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.pose_errors import fine_fraction
from geodiff_plugin.trust.stages import TracksStage


@dataclass(frozen=True)
class Ambiguity:
    """The depth-order ambiguity of the matches."""

    fraction: float  # fraction of the matches that also fit an inverted depth order, [0, 1]


class OrderAmbiguity(Check[Ambiguity]):
    """Measures whether epipolar geometry alone excludes an inverted depth order.

    The depth order is inverted if the images were swapped, mirrored or upside down. The check undoes each of
    these three errors and counts the matches that then fit the nearby or the given poses, relative to the
    matches that fit the nearby poses. The fact is the maximum over the errors and the minimum over the views.
    Parallel cameras give such matches negative disparities unless their principal points differ. Other
    cameras give them large epipolar errors. ``DepthOrder`` and ``OcclusionOrder`` use the fact. This check
    has no finding of its own.
    """

    #: Correct pairs whose pose fits have up to .16. Swapped, mirrored or upside-down images have 1. A correct
    #: pair whose principal points differ by more than the disparities has .99.
    MAX_EXCLUDED = 0.3
    #: Limit for few matches, half of ``MAX_EXCLUDED``.
    MAX_RULED_OUT = MAX_EXCLUDED / 2

    @classmethod
    def of_tracks(cls, stage: TracksStage) -> Ambiguity | None:
        fractions = []
        same = stage.nearby is stage.given  # the given poses fit
        tried = (stage.nearby,) if same else (stage.given, stage.nearby)
        for v, poses in enumerate(zip(*tried, strict=True)):
            seen = stage.tracks.view(v)
            if len(seen) < MIN_MATCHES:
                continue
            undone = list(_undone(seen, stage.sizes[0], stage.sizes[v + 1]))
            best = max(fine_fraction(each, T) for T in poses for each in undone)
            as_it_is = fine_fraction(seen, stage.nearby[v])
            fractions.append(min(1.0, best / as_it_is) if as_it_is > 0 else 1.0)
        return Ambiguity(min(fractions)) if fractions else None

    @classmethod
    def rules_out(cls, fact: Ambiguity | None) -> bool:
        return fact is not None and fact.fraction <= cls.MAX_RULED_OUT

    @classmethod
    def excludes_inverted_order(cls, facts: FactSheet) -> bool:
        """Whether the matches do not fit an inverted depth order."""
        fact = facts[cls]
        return fact is not None and fact.fraction < cls.MAX_EXCLUDED

    @classmethod
    def allows_inverted_order(cls, facts: FactSheet) -> bool:
        """Whether the matches also fit an inverted depth order."""
        fact = facts[cls]
        return fact is not None and fact.fraction >= cls.MAX_EXCLUDED


def _undone(tracks: Tracks, left: tuple[int, ...], right: tuple[int, ...]) -> Iterator[Tracks]:
    """Yield the tracks of one right view with the images swapped, mirrored, and rotated by 180 degrees."""
    yield replace(tracks, left_px=tracks.right_px[0], right_px=tracks.left_px[None])
    for flipped in (np.array([True, False]), np.array([True, True])):
        left_px = np.where(flipped, np.array(left[::-1]) - 1.0 - tracks.left_px, tracks.left_px)
        right_px = np.where(flipped, np.array(right[::-1]) - 1.0 - tracks.right_px, tracks.right_px)
        yield replace(tracks, left_px=left_px, right_px=right_px)
