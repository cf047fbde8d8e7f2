"""Reading the files that several data sets share, with errors that name the file.

Hop: path -> array.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value

__all__ = ["check_size", "folders", "read_png16", "read_rgb", "require"]


def require(path: Path, what: str) -> Path:
    """Return ``path``; raise ``FileNotFoundError`` with its name and what it should hold."""
    if not path.is_file():
        raise FileNotFoundError(
            f"{what} is missing: {path} does not exist. Check that the download is complete."
        )
    return path


def _open(path: Path, what: str) -> Image.Image:
    try:
        image = Image.open(require(path, what))
        image.load()
    except (OSError, SyntaxError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(
            f"{path} must be a whole image file ({what}); got {error}. Download it again."
        ) from error
    return image


def read_rgb(path: Path, what: str = "image") -> np.ndarray:
    """``(H, W, 3)`` uint8 of an 8-bit image; grey is repeated three times."""
    return np.asarray(_open(path, what).convert("RGB"))


def read_png16(path: Path, what: str) -> np.ndarray:
    """``(H, W)`` uint16 of a 16-bit PNG; ``ValueError`` for any other kind."""
    values = np.asarray(_open(path, what))
    if values.ndim != 2 or values.dtype not in (np.uint16, np.int32):
        bad_value(str(path), "a one-channel 16-bit PNG", f"{values.dtype} {values.shape}")
    return values.astype(np.uint16)


def check_size(path: Path, got: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Raise ``ValueError`` naming ``path`` where its ``(H, W)`` is not the expected one."""
    if tuple(got[:2]) != tuple(expected[:2]):
        bad_value(
            str(path),
            f"{expected[1]} x {expected[0]} pixels as the left image",
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
