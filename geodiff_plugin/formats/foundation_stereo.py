"""``K.txt`` of FoundationStereo: the flat K, then the baseline in metres.

Data flow: 9 numbers and 1 -> ``Rig`` with equal K on both sides.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CalibrationFile, CalibrationFormat, CameraChoice
from geodiff_plugin.formats.rigs import make_rig, pose_to_the_right, positive
from geodiff_plugin.types import Rig

__all__ = ["FOUNDATION_STEREO", "matches", "read"]


def _numbers(text: str) -> np.ndarray | None:
    try:
        return np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        return None


def matches(text: str, path: Path) -> bool:
    """Whether the text is numbers and nothing else."""
    return _numbers(text) is not None


def read(files: tuple[CalibrationFile, ...], choice: CameraChoice) -> Rig:
    """The rig of one ``K.txt``.

    Raises:
        ValueError: not 10 numbers.
    """
    path = files[0].path
    values = _numbers(files[0].text)
    if values is None or values.size != 10:
        bad_value(
            f"{path}",
            "a K.txt of 9 numbers of K and the baseline in metres",
            f"{0 if values is None else values.size} numbers",
            "Add the baseline as a second line; a file that holds only K or E goes to K and E (--K, --E).",
        )
    K = values[:9].reshape(3, 3)
    return make_rig(K, K.copy(), pose_to_the_right(positive(values[9], f"the baseline in {path}")), path)


FOUNDATION_STEREO = CalibrationFormat(
    "K.txt of FoundationStereo (9 numbers, baseline in metres)", matches, read
)
