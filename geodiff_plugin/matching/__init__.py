"""What the views alone say about depth: plane sweep, aggregation, left-right check, for any pose (S7.3)."""

from geodiff_plugin.matching.aggregation import aggregate
from geodiff_plugin.matching.build import build_cost_volume, inverse_pose_preferred, to_grid
from geodiff_plugin.matching.cleaning import clean
from geodiff_plugin.matching.consistency import known_shape, known_share, match_volume, window_mean
from geodiff_plugin.matching.matches import Matches, points_to_matches, reject_reflections, with_points
from geodiff_plugin.matching.sweep import CostVolume, sweep_planes

__all__ = [
    "CostVolume",
    "Matches",
    "aggregate",
    "build_cost_volume",
    "clean",
    "inverse_pose_preferred",
    "known_shape",
    "known_share",
    "match_volume",
    "points_to_matches",
    "reject_reflections",
    "sweep_planes",
    "to_grid",
    "window_mean",
    "with_points",
]
