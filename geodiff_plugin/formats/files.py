"""Opens files that the user named, with one-sentence errors.

Data flow: a path as given -> an existing file, or its text.
Paper: none.
"""

from __future__ import annotations

import codecs
import hashlib
import os
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from geodiff_plugin._checks import (
    FolderError,
    ForbiddenFileError,
    MissingFileError,
    bad_type,
    bad_value,
    quoted,
)

__all__ = ["check_file", "file_digest", "read_text", "refuse_decimal_commas"]

#: A number whose decimals follow a comma, alone between blanks, semicolons or the ends of a line.
DECIMAL_COMMA = re.compile(r"(?<![^\s;])[-+]?\d+,\d+(e[-+]?\d+)?(?![^\s;])", re.IGNORECASE)

#: No calibration file is near this size; a larger one is something else.
LARGEST_TEXT_BYTES = 16_000_000


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
    found = Path(path)
    shown = quoted(found)
    if os.path.isdir(found):
        raise FolderError(f"{name} must be {what}; got the folder {shown}. Name the file inside it.")
    if not os.path.exists(found):  # Path.exists() raises on a name that is too long
        raise MissingFileError(
            f"{name} must be {what}; got {shown}, which does not exist. Check the spelling."
        )
    if not found.is_file():
        bad_value(name, what, f"{shown}, which is a pipe or a device", "Save what it gives as a file first.")
    if not os.access(found, os.R_OK):
        raise ForbiddenFileError(
            f"{name} must be {what} that you may read; got {shown}. Check its permissions."
        )
    if found.stat().st_size == 0:
        bad_value(name, what, f"{shown}, which is empty", "Was its download or copy cut off? Fetch it again.")
    return found


def read_text(path: str | os.PathLike[str], name: str, what: str = "a text file") -> str:
    """The text of a file, with Unix line ends and no byte-order mark.

    Raises:
        OSError, ValueError: as ``check_file``; not text.
    """
    found = check_file(path, name, what)
    cure = "Is this an image or an archive?"
    size = found.stat().st_size
    if size > LARGEST_TEXT_BYTES:
        bad_value(name, what, f"{found} of {size} bytes", cure)
    raw = found.read_bytes()
    wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as Windows' shell and Notepad write
    text = raw.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if "\0" in text:
        bad_value(name, what, f"{found}, which holds binary data", cure)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if not text.strip():
        bad_value(name, what, f"{found}, which holds only blanks", "Fetch it again.")
    return text


def refuse_decimal_commas(lines: Iterable[str], path: str | os.PathLike[str], name: str) -> None:
    """Refuse ``1,5 2,5 3,0`` and ``1,5;2,5;3,0``, which would be read as six numbers.

    ``1,2`` alone in a line may be two columns.

    Raises:
        ValueError: a line of several numbers, one of them with a decimal comma.
    """
    for line in lines:
        found = DECIMAL_COMMA.search(line)
        if found and found.group() != line:
            cure = "Write points for commas, as 1.5 for 1,5."
            bad_value(name, "numbers with a decimal point", f"{path} with {found.group()}", cure)


def file_digest(path: Path) -> str:
    """SHA-256 of what a file holds, read once as long as its size and time stay the same.

    Raises:
        OSError: it cannot be read, or is a folder.
    """
    found = path.stat()
    return _digest(path.absolute(), found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, size: int, changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
