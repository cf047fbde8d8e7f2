"""Opens files that the user named, with one-sentence errors.

Data flow: a path as given -> an existing file, or its text.
Paper: none.
"""

from __future__ import annotations

import os
from pathlib import Path

from geodiff_plugin._checks import FolderError, ForbiddenFileError, MissingFileError, bad_type, bad_value

__all__ = ["check_file", "read_text"]

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
        ValueError: empty.
    """
    if not isinstance(path, (str, os.PathLike)):
        bad_type(name, f"the path of {what}", path)
    found = Path(path)
    if found.is_dir():
        raise FolderError(f"{name} must be {what}; got the folder {found}. Name the file inside it.")
    if not found.exists():
        raise MissingFileError(
            f"{name} must be {what}; got {found}, which does not exist. Check the spelling."
        )
    if not os.access(found, os.R_OK):
        raise ForbiddenFileError(
            f"{name} must be {what} that you may read; got {found}. Check its permissions."
        )
    if found.stat().st_size == 0:
        bad_value(name, what, f"{found}, which is empty", "Was its download or copy cut off? Fetch it again.")
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
    if b"\0" in raw:
        bad_value(name, what, f"{found}, which holds binary data", cure)
    text = raw.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    if not text.strip():
        bad_value(name, what, f"{found}, which holds only blanks", "Fetch it again.")
    return text
