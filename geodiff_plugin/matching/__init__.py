"""Matches the views densely for any pose, without a prior (paper S7.3).

Belongs here: image cleaning, the plane sweep and its cost volume, aggregation, left-right consistency,
reflections, row matching of rectified pairs, and known points in the form of matches.
Layer 2: imports ``cameras``, ``geometry`` and below; imported by ``pose``, ``scale``, ``trust`` and the
phases through the names listed here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from geodiff_plugin._internal.lazy import declared, importer

if TYPE_CHECKING:  # for type checkers; at run time names are imported on first use, as gaps need no torch
    from geodiff_plugin.matching.aggregation import aggregate as aggregate
    from geodiff_plugin.matching.build import build_cost_volume as build_cost_volume
    from geodiff_plugin.matching.build import inverse_pose_preferred as inverse_pose_preferred
    from geodiff_plugin.matching.build import to_grid as to_grid
    from geodiff_plugin.matching.cleaning import clean as clean
    from geodiff_plugin.matching.consistency import known_fraction as known_fraction
    from geodiff_plugin.matching.consistency import known_shape as known_shape
    from geodiff_plugin.matching.consistency import match_volume as match_volume
    from geodiff_plugin.matching.consistency import window_mean as window_mean
    from geodiff_plugin.matching.matches import Matches as Matches
    from geodiff_plugin.matching.matches import points_to_matches as points_to_matches
    from geodiff_plugin.matching.matches import with_points as with_points
    from geodiff_plugin.matching.reflections import reject_reflections as reject_reflections
    from geodiff_plugin.matching.sweep import sweep_planes as sweep_planes
    from geodiff_plugin.matching.volume import CostVolume as CostVolume

_MODULE_OF = declared(__name__)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)
