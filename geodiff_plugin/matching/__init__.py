"""What the views alone say about depth: plane sweep, aggregation, left-right check, for any pose (S7.3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geodiff_plugin._lazy import importer, modules_of

if TYPE_CHECKING:  # for type checkers; at run time names are imported on first use, as gaps need no torch
    from geodiff_plugin.matching.aggregation import aggregate as aggregate
    from geodiff_plugin.matching.build import build_cost_volume as build_cost_volume
    from geodiff_plugin.matching.build import inverse_pose_preferred as inverse_pose_preferred
    from geodiff_plugin.matching.build import to_grid as to_grid
    from geodiff_plugin.matching.cleaning import clean as clean
    from geodiff_plugin.matching.consistency import known_shape as known_shape
    from geodiff_plugin.matching.consistency import known_share as known_share
    from geodiff_plugin.matching.consistency import match_volume as match_volume
    from geodiff_plugin.matching.consistency import window_mean as window_mean
    from geodiff_plugin.matching.matches import Matches as Matches
    from geodiff_plugin.matching.matches import points_to_matches as points_to_matches
    from geodiff_plugin.matching.matches import reject_reflections as reject_reflections
    from geodiff_plugin.matching.matches import with_points as with_points
    from geodiff_plugin.matching.sweep import CostVolume as CostVolume
    from geodiff_plugin.matching.sweep import sweep_planes as sweep_planes

#: Module -> its public names.
_NAMES_OF = {
    "aggregation": ("aggregate",),
    "build": ("build_cost_volume", "inverse_pose_preferred", "to_grid"),
    "cleaning": ("clean",),
    "consistency": ("known_shape", "known_share", "match_volume", "window_mean"),
    "matches": ("Matches", "points_to_matches", "reject_reflections", "with_points"),
    "sweep": ("CostVolume", "sweep_planes"),
}
_MODULE_OF = modules_of(__name__, _NAMES_OF)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)
