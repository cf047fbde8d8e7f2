"""The stereo pairs of ``geodiff demo``: one rendered by this package, with exact depth, and real ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodiff_plugin.formats import read_calibration, read_depth_png, read_image
from geodiff_plugin.types import Rig

#: ``left.png``, ``right.png``, ``calib.txt`` (Middlebury's format), ``depth_mm.png``.
DEMO_PAIR_FOLDER = Path(__file__).resolve().parent / "pair"
#: The real pairs, a folder each with ``left.png``, ``right.png`` and ``calib.txt``; MIT licence.
REAL_PAIRS_FOLDER = Path(__file__).resolve().parent / "real"


@dataclass(frozen=True)
class DemoPair:
    """Two views with the truth."""

    left: np.ndarray  # (H, W, 3) float32 in [0, 1]
    right: np.ndarray
    rig: Rig
    depth_m: np.ndarray  # (H, W) float32 metres, to the millimetre
    valid: np.ndarray  # (H, W) where the truth is known


def read_demo_pair() -> DemoPair:
    """Read the pair that ships with the package."""
    left, right = (read_image(DEMO_PAIR_FOLDER / f"{side}.png")[0] for side in ("left", "right"))
    rig = read_calibration(DEMO_PAIR_FOLDER / "calib.txt")
    return DemoPair(left, right, rig, *read_depth_png(DEMO_PAIR_FOLDER / "depth_mm.png"))
