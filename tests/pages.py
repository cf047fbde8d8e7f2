"""Pages of the documentation with a generated part between two lines."""

import os
from pathlib import Path


def with_generated(text: str, begin: str, generated: str, end: str) -> str:
    """The text of a page with the part between the lines ``begin`` and ``end`` replaced."""
    before, found_begin, rest = text.partition(begin)
    _, found_end, after = rest.partition(end)
    if not (found_begin and found_end):
        raise ValueError(f"the page has no lines {begin.strip()} and {end.strip()}")
    return f"{before}{begin}{generated}{end}{after}"


def check_generated(page: Path, begin: str, generated: str, end: str) -> None:
    """Assert that the generated part of a page is up to date; with ``GEODIFF_WRITE`` set, write it first."""
    expected = with_generated(page.read_text(encoding="utf-8"), begin, generated, end)
    if os.environ.get("GEODIFF_WRITE"):
        page.write_text(expected, encoding="utf-8")
    assert page.read_text(encoding="utf-8") == expected
