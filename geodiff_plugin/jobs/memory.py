"""A picture that does not fit the memory is said in one sentence, with its size and what helps."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from geodiff_plugin._checks import InputError

#: How libraries put it that have no error of their own for it: torch's allocators, OpenCV, C++, the system.
WORDS = re.compile(
    r"out of memory|can't allocate|cannot allocate|insufficient memory|bad_alloc", re.IGNORECASE
)
CURE = "Make the pictures smaller (half as wide and high they need a quarter), or free memory"


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or what caused it, says that memory ran out."""
    while error is not None:
        if isinstance(error, MemoryError) or WORDS.search(str(error)):
            return True
        error = error.__cause__
    return False


@contextmanager
def fitting_memory(what: str, size: tuple[int, int], cure: str = "") -> Iterator[None]:
    """Turn running out of memory into an ``InputError`` that names what was worked on, and its size.

    ``size`` is ``(width, height)`` pixels; ``cure`` is what else helps, beside ``CURE``.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, InputError) or not is_out_of_memory(error):
            raise
        width, height = size
        megapixels = width * height / 1e6
        sentence = f"{what} of {width}x{height} pixels ({megapixels:.1f} megapixels) does not fit the memory."
        raise InputError(f"{sentence} {CURE}{cure}.") from error
