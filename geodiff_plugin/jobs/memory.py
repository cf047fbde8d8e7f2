"""Reports images that do not fit in memory in one message, with their size and a hint."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from geodiff_plugin._internal.checks import InputError, with_code

#: Messages of libraries that have no error class for it: torch's allocators, OpenCV, C++, the system.
WORDS = re.compile(
    r"out of memory|can't allocate|cannot allocate|insufficient memory|bad_alloc", re.IGNORECASE
)
MEMORY_HINT = "Downscale the images (half the width and height needs a quarter of the memory), or free memory"


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether an error or its cause reports that memory ran out."""
    while error is not None:
        if isinstance(error, MemoryError) or WORDS.search(str(error)):
            return True
        error = error.__cause__
    return False


@contextmanager
def fitting_memory(what: str, size: tuple[int, int], hint: str = "") -> Iterator[None]:
    """Turn an out-of-memory error into an ``InputError`` that states the object and its size.

    ``size`` is ``(width, height)`` in pixels; ``hint`` is appended to ``MEMORY_HINT``.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, InputError) or not is_out_of_memory(error):
            raise
        width, height = size
        megapixels = width * height / 1e6
        sentence = f"{what} of {width}x{height} pixels ({megapixels:.1f} megapixels) does not fit in memory."
        raise with_code(InputError(f"{sentence} {MEMORY_HINT}{hint}."), "memory") from error
