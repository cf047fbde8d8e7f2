"""What several data sets need around the readers of ``formats``.

Hop: path -> array of the left image's size.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import check_file, read_image

__all__ = ["check_size", "folders", "read_npy", "read_rgb"]


def read_rgb(path: Path, name: str) -> np.ndarray:
    """``(H, W, 3)`` uint8 of an image file, grey repeated; errors as ``formats.read_image``."""
    image_01, _ = read_image(path, name)
    return np.rint(image_01 * 255.0).astype(np.uint8)


def read_npy(path: Path, name: str) -> np.ndarray:
    """``(H, W)`` array of an npy file; ``ValueError`` naming it where it is cut off or of another rank."""
    found = check_file(path, name, "an npy file")
    try:
        values = np.load(found, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        bad_value(name, "a whole npy file", f"{found}, which does not load ({error})", "Is it cut off?")
    if not isinstance(values, np.ndarray) or values.ndim != 2:
        bad_value(name, "a map of shape (H, W)", f"{found} of shape {np.shape(values)}")
    return values


def check_size(path: Path, got: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Raise ``ValueError`` naming ``path`` where its ``(H, W)`` is not the expected one."""
    if tuple(got[:2]) != tuple(expected[:2]):
        bad_value(
            str(path),
            f"for {expected[1]} x {expected[0]} pixels as the left image",
            f"{got[1]} x {got[0]}",
            "Image, calibration and truth must be of one resolution.",
        )


def folders(root: Path, depth: int) -> list[Path]:
    """``root`` and the folders below it down to ``depth`` levels, sorted."""
    found = [root] if root.is_dir() else []
    level = found
    for _ in range(depth):
        level = [child for parent in level for child in sorted(parent.iterdir()) if child.is_dir()]
        found = found + level
    return found
