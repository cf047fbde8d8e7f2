"""Stages of made-up calls, as checks measure on them."""

from typing import Any

import numpy as np
import torch

from geodiff_plugin.cameras import PosedViews, View
from geodiff_plugin.matching import Matches
from geodiff_plugin.pose.tracks import Tracks
from geodiff_plugin.trust import Call, PosesStage, ResultStage, TracksStage
from geodiff_plugin.types import PoseReport
from tests.unit.pose.posed_scene import SIZES
from tests.views import view_of

#: ``(H, W)`` of the matches and of the result of ``made_result``.
GRID, FULL = (29, 43), (37, 61)
#: Distance of the planes of the search in ``made_result``, 1/m.
STEP = 0.01


def tracks_stage(
    tracks: Tracks, given: np.ndarray, nearby: np.ndarray | None = None, size: tuple[int, int] = SIZES[0]
) -> TracksStage:
    """Matches of images of ``SIZES``; without other ``nearby`` poses the given ones fit best."""
    return TracksStage(tracks, given, given if nearby is None else nearby, SIZES, size)


def poses_stage(
    report: PoseReport, tracks: Tracks | None = None, used: Any = (), size: tuple[int, int] = SIZES[0]
) -> PosesStage:
    """Poses in use by their report, and if need be the matches that they were refined by."""
    return PosesStage(report, tracks, np.asarray(used), size)


def as_map(values: np.ndarray) -> torch.Tensor:
    """``(1, H, W)`` float32."""
    return torch.from_numpy(np.asarray(values, np.float32))[None]


def matches_of(inverse_depth: np.ndarray, confidence: np.ndarray, step: float = STEP) -> Matches:
    """Matches of maps ``(H, W)``."""
    return Matches(as_map(inverse_depth), as_map(confidence), torch.tensor(step))


def right_view(K: torch.Tensor, *rows: tuple[float, ...], size: tuple[int, int] = FULL) -> View:
    """A black right view; ``rows`` are the upper three of ``T_right_from_left``, or none for no motion."""
    T = torch.eye(4)
    T[:3] = torch.tensor(rows) if rows else T[:3]
    return view_of(torch.zeros(3, *size), K, T)


def made_result(
    matches: Matches | None = None, points: Matches | None = None, depth_m: Any = None, **changes: Any
) -> ResultStage:
    """The result of an image of ``FULL`` size without a right view; its depth is 2 m."""
    depth_m = np.full(FULL, 2.0) if depth_m is None else depth_m
    made: dict[str, Any] = {
        "call": Call(),
        "native": PosedViews(view_of(torch.zeros(3, *FULL), torch.eye(3)), ()),
        "matches": matches,
        "points": points,
        "depth_m": as_map(depth_m)[None],
    }
    return ResultStage(**made | changes)
