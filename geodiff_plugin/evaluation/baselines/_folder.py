"""Fingerprint of a folder's files, for the key of a result.

Data flow: folder -> names, sizes and times of change -> short hash.
Paper: none.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

__all__ = ["folder_fingerprint"]


def folder_fingerprint(folder: Path) -> str:
    """16 hexadecimal digits that change with any file of the folder; empty where there is no such folder."""
    if not os.path.isdir(folder):
        return ""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        status = path.stat()
        digest.update(f"{path.relative_to(folder)} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]
