"""Guidance terms, one a file: functions from an ``Estimate`` to one number per sample.

Data flow: ``Estimate`` -> ``{name: (B,)}``.
Paper: Eq. 14 (eq:geo-loss), Eq. 17; the terms beyond the paper say so.

A new term is a new file and one line in ``TERMS``. ``options`` are the keywords that it takes, knobs of
``GuidanceConfig``. ``needs_warp`` says whether it reads ``Estimate.warped_01``, ``needs_matches`` and
``needs_points`` whether it reads those; a term whose input a call lacks is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from geodiff_plugin.algorithm.terms.anchor import anchor
from geodiff_plugin.algorithm.terms.base import Estimate, MatchTarget, masked_mean
from geodiff_plugin.algorithm.terms.matches import matches
from geodiff_plugin.algorithm.terms.photometric import photometric, photometric_map
from geodiff_plugin.algorithm.terms.points import points
from geodiff_plugin.algorithm.terms.prior_pull import prior_pull

__all__ = ["TERMS", "Estimate", "MatchTarget", "Term", "masked_mean", "photometric_map"]


@dataclass(frozen=True)
class Term:
    """One entry of ``TERMS``: the function, the configuration it reads, what it must be given."""

    function: Callable[..., Tensor]
    options: tuple[str, ...] = ()
    needs_warp: bool = False
    needs_matches: bool = False
    needs_points: bool = False


TERMS: dict[str, Term] = {
    "photometric": Term(photometric, ("eta", "pyramid_levels", "exposure"), needs_warp=True),
    "matches": Term(matches, needs_matches=True),
    "points": Term(points, ("points_loss",), needs_points=True),
    "prior_pull": Term(prior_pull, ("pull_to",)),
    "anchor": Term(anchor),
}
