"""K and E from text and ``.npy`` files.

Data flow: text or ``.npy`` -> float64 matrix, unchecked for meaning.
Paper: none.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import check_file, read_text, refuse_decimal_commas
from geodiff_plugin.formats.npy import read_npy

__all__ = ["read_matrix"]

SHAPES = ((3, 3), (4, 4))
FLAT = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
#: What may stand around and between numbers: commas, semicolons, the brackets of Python and JSON.
BETWEEN = str.maketrans(dict.fromkeys(",;[]()", " "))
EXPECTED = "a 3x3 K or a 4x4 (or 3x4) E, as text of numbers or .npy"


def _from_text(path: Path, name: str) -> np.ndarray:
    lines = [line.split("#")[0].strip() for line in read_text(path, name, EXPECTED).splitlines()]
    refuse_decimal_commas(lines, path, name)
    rows = [words for line in lines if (words := line.translate(BETWEEN).split())]
    try:
        numbers = [[float(word) for word in words] for words in rows]
    except ValueError:
        bad_value(
            name, EXPECTED, f"{path} with words in it", "A calibration file with words goes to --calib."
        )
    if not rows:
        bad_value(name, EXPECTED, f"{path} without numbers")
    if len({len(row) for row in numbers}) > 1:
        bad_value(
            name, EXPECTED, f"{path} with rows of {[len(row) for row in numbers]} numbers", "Is it cut off?"
        )
    return np.array(numbers, dtype=np.float64)


def read_matrix(path: str | os.PathLike[str], name: str = "matrix") -> np.ndarray:
    """A camera matrix or a pose from a file.

    Rows of numbers, or all 9, 12 or 16 in one row; commas, semicolons and brackets count as blanks, what
    follows ``#`` is left out. A 3x4 pose gets the row 0 0 0 1. Whether the matrix is a K or an E is checked
    where it is used.

    Args:
        path: a text file, or ``.npy`` (never unpickled).
        name: the argument that it came in, for the message.

    Returns:
        ``(3, 3)`` or ``(4, 4)`` float64.

    Raises:
        FileNotFoundError, IsADirectoryError, PermissionError: no readable file.
        ValueError: no matrix of such a shape, not finite, or with decimal commas.
    """
    found = check_file(path, name, EXPECTED)
    matrix = (
        read_npy(found, name, EXPECTED).astype(np.float64)
        if found.suffix.lower() == ".npy"
        else _from_text(found, name)
    )
    matrix = np.squeeze(matrix)
    if matrix.ndim == 1 and matrix.size in FLAT:
        matrix = matrix.reshape(FLAT[matrix.size])
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    if matrix.shape not in SHAPES:
        bad_value(name, EXPECTED, f"{path} of shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        bad_value(name, "finite", f"NaN or infinity in {path}")
    return matrix
