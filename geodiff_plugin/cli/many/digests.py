"""Digests of the files that a pair is made from, by which a later run sees that one has changed.

Data flow: the arguments of a pair -> SHA-256 of every file that they name.
Paper: none.

Nothing here imports torch.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from geodiff_plugin.cli.arguments import MODEL_FILES, DepthArguments
from geodiff_plugin.formats.files import file_digest

__all__ = ["CAMERA_FILES", "PAIR_FILES", "file_digests"]

#: Arguments that name the files that cameras are read from.
CAMERA_FILES = ("calib", "k", "e", "k_right")
#: Arguments that name all files of a pair.
PAIR_FILES = ("left", "right", *CAMERA_FILES)


def file_digests(arguments: DepthArguments, names: tuple[str, ...] = PAIR_FILES) -> dict[str, str]:
    """SHA-256 of files by their paths as typed, without those that cannot be read: their readers say why.

    A file that did not change since its last digest, such as a rig's video or calibration, is not read again.

    Args:
        arguments: of one pair.
        names: of the arguments that count.
    """
    digests = {}
    for path in _paths(arguments, names):
        try:
            digests[str(path)] = file_digest(path)
        except OSError:
            continue
    return digests


def _paths(arguments: DepthArguments, names: tuple[str, ...]) -> Iterator[Path]:
    for name in names:
        value = getattr(arguments, name)
        for path in value if isinstance(value, tuple) else (value,):
            if path is not None and os.path.isdir(path):
                yield from (path / file for file in MODEL_FILES)
            elif path is not None:
                yield path
