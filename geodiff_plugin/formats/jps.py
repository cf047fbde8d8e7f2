"""Reads the layout of stereo JPEG and PNG (``.jps``, ``.pns``): side by side, by default right view first.

Source: the JPS table of ``lib/Image/ExifTool/JPEG.pm`` of exiftool/exiftool.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.frame_packing import FULL, HALF, HALF_OVER_UNDER, OVER_UNDER

SUFFIXES = (".jps", ".pns")
#: Number of bytes that contain the header of a JPS file.
HEAD_BYTES = 65536
#: Matches segment APP3 with its marker, the block length, and bytes: separation, flags, layout, kind.
SEGMENT = re.compile(rb"\xff\xe3..(?:_JPSJPS_)..(.)(.)(.)(.)", re.DOTALL)
#: Kind of an image with two views.
STEREO = 1
#: Layouts that are read -> flag for views of half size, and the layouts of full and half size.
LAYOUTS = {2: (2, FULL, HALF), 3: (1, OVER_UNDER, HALF_OVER_UNDER)}
#: Layouts that are not read.
OTHER_LAYOUTS = {1: "interleaved rows", 4: "an anaglyph without full colours"}
#: Flag for left view first.
LEFT_FIRST = 4


class StoredLayout(NamedTuple):
    """What a file states about an image that holds both views."""

    right_first: bool = False
    layout: str | None = None  # one of ``frame_packing.FRAME_LAYOUTS``; None if the file does not state it


def read_jps(path: Path, name: str) -> StoredLayout:
    """Read how a file of both views holds them.

    The right view is first in ``.jps`` and ``.pns`` unless the header states otherwise; other files start
    with the left view.
    """
    if path.suffix.lower() not in SUFFIXES:
        return StoredLayout()
    with path.open("rb") as opened:
        segment = SEGMENT.search(opened.read(HEAD_BYTES))
    if segment is None:
        return StoredLayout(right_first=True)
    flags, layout, kind = (segment.group(number)[0] for number in (2, 3, 4))
    if kind == STEREO and layout in OTHER_LAYOUTS:
        got = f"{path}, which has {OTHER_LAYOUTS[layout]}"
        bad_value(name, "both views next to or above each other", got, "Pass two images as LEFT and RIGHT.")
    stated = None
    if kind == STEREO and layout in LAYOUTS:
        half, full_size, half_size = LAYOUTS[layout]
        stated = half_size if flags & half else full_size
    return StoredLayout(not flags & LEFT_FIRST, stated)
