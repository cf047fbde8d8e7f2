"""Atomic writing: a file appears whole or not at all.

Data flow: a path -> a temporary one beside it -> the path, by one rename.
Paper: none.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from geodiff_plugin._checks import FolderError, MissingFileError

__all__ = ["atomic_path"]


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to; rename it to ``path`` when the block ends well.

    The temporary file lies in the same folder (a rename across file systems is a copy) and keeps the
    suffix, from which writers guess the format. On any error, Ctrl-C included, it is removed and an older
    file at ``path`` stays as it was.

    Args:
        path: the file to appear.

    Yields:
        The path to write to.

    Raises:
        FileNotFoundError: the folder does not exist.
        IsADirectoryError: ``path`` is a folder.
    """
    target = Path(path)
    if os.path.isdir(target):
        raise FolderError(f"The output must be a file; got the folder {target}. Name a file inside of it.")
    if not os.path.isdir(target.parent):
        raise MissingFileError(
            f"The output must be in an existing folder; got {target}. Make the folder {target.parent} first."
        )
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
