"""Stereo JPEG and PNG (``.jps``, ``.pns``): both views side by side, the right one first by default.

Source: the JPS table of ``lib/Image/ExifTool/JPEG.pm`` of exiftool/exiftool.
"""

from __future__ import annotations

import re
from pathlib import Path

from geodiff_plugin._checks import bad_value

SUFFIXES = (".jps", ".pns")
#: Bytes in which the head of a JPS file stands.
HEAD_BYTES = 65536
#: Segment APP3 with its mark, the length of the block, and its bytes: separation, flags, layout, kind.
SEGMENT = re.compile(rb"\xff\xe3..(?:_JPSJPS_)..(.)(.)(.)(.)", re.DOTALL)
#: The kind of a picture with two views.
STEREO = 1
#: What layouts other than 2, both views side by side, are called.
OTHER_LAYOUTS = {
    1: "interleaved rows",
    3: "one view above the other",
    4: "an anaglyph, whose views have lost their colours",
}
#: The flag of a picture whose left half shows the left view.
LEFT_FIRST = 4


def has_right_view_first(path: Path, name: str) -> bool:
    """Whether the left half of a picture with both views side by side shows the right one.

    So does a ``.jps`` or ``.pns`` file unless its head says otherwise; other files begin with the left view.
    """
    if path.suffix.lower() not in SUFFIXES:
        return False
    with path.open("rb") as opened:
        segment = SEGMENT.search(opened.read(HEAD_BYTES))
    if segment is None:
        return True
    flags, layout, kind = (segment.group(number)[0] for number in (2, 3, 4))
    if kind == STEREO and layout in OTHER_LAYOUTS:
        got = f"{path}, which holds {OTHER_LAYOUTS[layout]}"
        bad_value(name, "both views side by side", got, "Give two pictures as LEFT and RIGHT.")
    return not flags & LEFT_FIRST
