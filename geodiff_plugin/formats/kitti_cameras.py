"""Choice of two of KITTI's four cameras: 0, 1 are the grey pair, 2, 3 the colour pair.

Data flow: ``cameras``, the image folder's name, the file's own cameras -> (left, right).
Paper: S5.1 (KITTI stereo).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.calibration import CameraChoice

__all__ = ["choose_cameras"]

PAIRS = ((0, 1), (2, 3))
#: Folder names of the benchmarks: image_2 and image_02, and colored_0 of KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")


def _pair_of_folder(hint: str | None) -> tuple[int, int] | None:
    found = FOLDER.findall(hint or "")
    if not found:
        return None
    kind, number = found[-1]
    return (2, 3) if kind == "colored" or int(number) >= 2 else (0, 1)


def choose_cameras(available: Collection[int], choice: CameraChoice, path: Path) -> tuple[int, int]:
    """The numbers of the left and the right camera.

    In this order: ``cameras`` as given; the pair that the image folder's name says, if the file has it; the
    only pair in the file; the colour pair, with a warning, where the file has both.

    Args:
        available: camera numbers in the file.
        choice: what the user said.
        path: the file, for messages.

    Raises:
        ValueError: a chosen camera is not in the file, or the file has no pair.
    """
    have = ", ".join(str(c) for c in sorted(available)) or "none"
    if choice.cameras is not None:
        left, right = choice.cameras
        if left == right or not {left, right} <= set(available):
            bad_value("cameras", f"two different cameras of {path} ({have})", f"{left},{right}")
        return left, right
    of_folder = _pair_of_folder(choice.image_folder_hint)
    if of_folder is not None and set(of_folder) <= set(available):
        return of_folder
    pairs = [pair for pair in PAIRS if set(pair) <= set(available)]
    if len(pairs) > 1:
        warnings.warn(
            f"{path} holds the grey pair 0,1 and the colour pair 2,3; taking 2,3. "
            "Give cameras (--cameras) to choose.",
            stacklevel=3,
        )
        return pairs[-1]
    if pairs:
        return pairs[0]
    if len(available) == 2:
        left, right = sorted(available)
        return left, right
    bad_value(f"{path}", "a calibration with two cameras", f"cameras {have}", "Give cameras (--cameras).")
