"""The stereo pairs of ``geodiff demo``: one rendered with exact depth, and real ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geodiff_plugin.formats import read_calibration, read_depth_png, read_image
from geodiff_plugin.types import Rig

#: Folder with ``left.png``, ``right.png``, ``calib.txt`` (Middlebury's format) and ``depth_mm.png``.
DEMO_PAIR_FOLDER = Path(__file__).resolve().parent / "pair"
#: Folder of the real pairs, each with ``left.png``, ``right.png`` and ``calib.txt``; MIT licence.
REAL_PAIRS_FOLDER = Path(__file__).resolve().parent / "real"
#: Folder of an example pair -> its name in the demo, the web app and the documentation.
EXAMPLE_NAMES = {
    "toy": "Playroom",
    "cycles": "Hallway",
    "donkey_toy": "Bedroom",
    "pair": "Desk",
    "street": "Street",
}


def example_name(folder: Path) -> str:
    """Return the name of an example pair, by default its folder's."""
    return EXAMPLE_NAMES.get(folder.name, folder.name)


@dataclass(frozen=True)
class DemoPair:
    """Two views with ground truth."""

    left: np.ndarray  # (H, W, 3) float32 in [0, 1]
    right: np.ndarray
    rig: Rig
    depth_m: np.ndarray  # (H, W) float32 metres, with millimetre precision
    valid: np.ndarray  # (H, W) where ground truth is known


def read_demo_pair() -> DemoPair:
    """Read the pair that ships with the package."""
    left, right = (read_image(DEMO_PAIR_FOLDER / f"{side}.png")[0] for side in ("left", "right"))
    rig = read_calibration(DEMO_PAIR_FOLDER / "calib.txt")
    return DemoPair(left, right, rig, *read_depth_png(DEMO_PAIR_FOLDER / "depth_mm.png"))
