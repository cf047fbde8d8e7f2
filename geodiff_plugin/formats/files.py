"""Opens files that the user named, with one-sentence errors: text, arrays, camera matrices and poses."""

from __future__ import annotations

import codecs
import hashlib
import os
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from geodiff_plugin._checks import (
    FolderError,
    ForbiddenFileError,
    MissingFileError,
    bad_type,
    bad_value,
    quoted,
)

if TYPE_CHECKING:  # `geodiff --help` reads this module and starts without numpy
    import numpy as np

__all__ = ["check_file", "file_digest", "read_matrix", "read_npy", "read_text", "refuse_decimal_commas"]

#: A number whose decimals follow a comma, alone between blanks, semicolons or the ends of a line.
DECIMAL_COMMA = re.compile(r"(?<![^\s;])[-+]?\d+,\d+(e[-+]?\d+)?(?![^\s;])", re.IGNORECASE)

#: No calibration file is near this size; a larger one is something else.
LARGEST_TEXT_BYTES = 16_000_000

SHAPES = ((3, 3), (4, 4))
FLAT = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
#: What may stand around and between numbers: commas, semicolons, the brackets of Python and JSON.
BETWEEN = str.maketrans(dict.fromkeys(",;[]()", " "))
MATRIX = "a 3x3 K or a 4x4 (or 3x4) E, as text of numbers or .npy"


def check_file(path: str | os.PathLike[str], name: str, what: str = "a file") -> Path:
    """An existing, readable, non-empty file.

    Args:
        path: where the user says it is.
        name: the argument that it came in, for the message.
        what: what is expected there, for the message (``"an image file"``).

    Returns:
        The path.

    Raises:
        TypeError: not a path.
        FileNotFoundError: nothing there.
        IsADirectoryError: a folder.
        PermissionError: not readable.
        ValueError: empty, or a pipe or a device.
    """
    if not isinstance(path, (str, os.PathLike)):
        bad_type(name, f"the path of {what}", path)
    file = Path(path)
    shown = quoted(file)
    if os.path.isdir(file):
        raise FolderError(f"{name} must be {what}; got the folder {shown}. Name the file inside it.")
    if not os.path.exists(file):  # Path.exists() raises on a name that is too long
        raise MissingFileError(
            f"{name} must be {what}; got {shown}, which does not exist. Check the spelling."
        )
    if not file.is_file():
        bad_value(name, what, f"{shown}, which is a pipe or a device", "Save what it gives as a file first.")
    if not os.access(file, os.R_OK):
        raise ForbiddenFileError(
            f"{name} must be {what} that you may read; got {shown}. Check its permissions."
        )
    if file.stat().st_size == 0:
        bad_value(name, what, f"{shown}, which is empty", "Was its download or copy cut off? Fetch it again.")
    return file


def read_text(path: str | os.PathLike[str], name: str, what: str = "a text file") -> str:
    """The text of a file, with Unix line ends and no byte-order mark.

    Raises:
        OSError, ValueError: as ``check_file``; not text.
    """
    file = check_file(path, name, what)
    cure = "Is this an image or an archive?"
    size = file.stat().st_size
    if size > LARGEST_TEXT_BYTES:
        bad_value(name, what, f"{file} of {size} bytes", cure)
    raw = file.read_bytes()
    wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as Windows' shell and Notepad write
    text = raw.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if "\0" in text:
        bad_value(name, what, f"{file}, which holds binary data", cure)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if not text.strip():
        bad_value(name, what, f"{file}, which holds only blanks", "Fetch it again.")
    return text


def refuse_decimal_commas(lines: Iterable[str], path: str | os.PathLike[str], name: str) -> None:
    """Refuse ``1,5 2,5 3,0`` and ``1,5;2,5;3,0``, which would be read as six numbers.

    ``1,2`` alone in a line may be two columns.

    Raises:
        ValueError: a line of several numbers, one of them with a decimal comma.
    """
    for line in lines:
        comma = DECIMAL_COMMA.search(line)
        if comma and comma.group() != line:
            cure = "Write points for commas, as 1.5 for 1,5."
            bad_value(name, "numbers with a decimal point", f"{path} with {comma.group()}", cure)


def file_digest(path: Path) -> str:
    """SHA-256 of what a file holds, read once as long as its size and time stay the same.

    Raises:
        OSError: it cannot be read, or is a folder.
    """
    state = path.stat()
    return _digest(path.absolute(), state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, size: int, changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_npy(path: Path, name: str, expected: str) -> np.ndarray:
    """The array of a file.

    Args:
        path: an existing file.
        name: the argument that it came in, for messages.
        expected: what it should hold, for messages.

    Returns:
        Of real numbers, in the file's own type.

    Raises:
        ValueError: numpy cannot load it, or it holds something else.
    """
    import numpy as np

    reason: str | None = None
    try:
        value = np.load(path, allow_pickle=False)
    except Exception as error:  # a damaged head is parsed as Python, which may fail in any way
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # numpy's own words tell how to run what is in there
            reason = "pickled objects, which are never loaded"
    if reason is not None:
        bad_value(name, expected, f"{path}, which numpy cannot load ({reason})", "Save it with numpy.save.")
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        cure = "Save one array with numpy.save."
        bad_value(name, expected, f"{path} without an array of real numbers", cure)
    return value


def _from_text(path: Path, name: str) -> np.ndarray:
    import numpy as np

    lines = [line.split("#")[0].strip() for line in read_text(path, name, MATRIX).splitlines()]
    refuse_decimal_commas(lines, path, name)
    rows = [words for line in lines if (words := line.translate(BETWEEN).split())]
    try:
        numbers = [[float(word) for word in words] for words in rows]
    except ValueError:
        bad_value(name, MATRIX, f"{path} with words in it", "A calibration file with words goes to --calib.")
    if not rows:
        bad_value(name, MATRIX, f"{path} without numbers")
    if len({len(row) for row in numbers}) > 1:
        bad_value(
            name, MATRIX, f"{path} with rows of {[len(row) for row in numbers]} numbers", "Is it cut off?"
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
    import numpy as np

    file = check_file(path, name, MATRIX)
    is_npy = file.suffix.lower() == ".npy"
    matrix = read_npy(file, name, MATRIX).astype(np.float64) if is_npy else _from_text(file, name)
    matrix = np.squeeze(matrix)
    if matrix.ndim == 1 and matrix.size in FLAT:
        matrix = matrix.reshape(FLAT[matrix.size])
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    if matrix.shape not in SHAPES:
        bad_value(name, MATRIX, f"{path} of shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        bad_value(name, "finite", f"NaN or infinity in {path}")
    return matrix
