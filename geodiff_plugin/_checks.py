"""Error messages and checks of user input: every message says name, expected, got and the likely cure."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from numbers import Integral, Real
from typing import Any, NoReturn

from geodiff_plugin.messages import Message

LONGEST_GOT = 400
#: What ``warn`` says goes to the innermost ``noted`` block too.
_NOTED: ContextVar[list[Message] | None] = ContextVar("noted", default=None)


class InputError(ValueError):
    """An input that cannot be used; the message says what is wrong and how to correct it."""


class InputTypeError(InputError, TypeError):
    """An input of the wrong type."""


class UnknownFormatError(InputError):
    """A file in none of the formats that can be read."""


class InputFileError(InputError, OSError):
    """A file or folder that cannot be read or written."""


class MissingFileError(InputFileError, FileNotFoundError):
    """A file or folder that does not exist."""


def bad_value(
    name: str, expected: str, got: object, cure: str = "", error: type[InputError] = InputError
) -> NoReturn:
    """Raise ``<name> must be <expected>; got <got>. <cure>``, of ``got`` one line of limited length."""
    text = " ".join(str(got).split())  # arrays are printed over several lines; file names may hold line ends
    text = text if len(text) <= LONGEST_GOT else f"{text[:LONGEST_GOT]}..."
    raise error(f"{name} must be {expected}; got {text}." + (f" {cure}" if cure else ""))


def bad_type(name: str, expected: str, got: object, cure: str = "") -> NoReturn:
    """Raise ``InputTypeError`` with the same sentence: of a text what it says, of others the type."""
    kind = f"the text {got!r}" if isinstance(got, str) else type(got).__name__
    bad_value(name, expected, kind, cure, InputTypeError)


def refuse(sentences: str) -> NoReturn:
    """Raise ``InputError`` with whole sentences, where the form of ``bad_value`` would read badly."""
    raise InputError(sentences)


def warn(message: Message, *, stacklevel: int = 2) -> None:
    """Warn, and tell the ``noted`` block around."""
    noticed = _NOTED.get()
    if noticed is not None and message not in noticed:
        noticed.append(message)
    warnings.warn(message, stacklevel=stacklevel + 1)


@contextmanager
def noted() -> Iterator[list[Message]]:
    """Every message that ``warn`` is given inside, each sentence once; blocks may be nested."""
    noticed: list[Message] = []
    outer = _NOTED.get()
    token = _NOTED.set(noticed)
    try:
        yield noticed
    finally:
        _NOTED.reset(token)
        if outer is not None:
            outer += [message for message in noticed if message not in outer]


def _check_kind(value: Any, name: str, integer: bool) -> None:
    kind: Any = Integral if integer else Real
    if isinstance(value, bool) or not isinstance(value, kind):
        bad_type(name, "an integer" if integer else "a number", value)


def number_text(number: float) -> str:
    """A number as people write it: 4294967296, where ``g`` alone would round it to 4.29497e+09."""
    return f"{number:.15g}"


def check_number(value: Any, name: str, low: float, high: float, *, integer: bool = False) -> Any:
    """A finite number in ``[low, high]``, returned as it came."""
    _check_kind(value, name, integer)
    # Whole numbers may be longer than any float: compared, not converted. NaN is not within anything.
    if not low <= value <= high or value in (float("inf"), float("-inf")):
        endless = isinstance(value, int) and value.bit_length() > 128
        got = "a whole number of more than 128 bits" if endless else value
        bad_value(name, f"between {number_text(low)} and {number_text(high)}", got)
    return value


def check_positive(value: Any, name: str, unit: str) -> Any:
    """A finite number above 0, returned as it came."""
    _check_kind(value, name, False)
    if not 0 < value < float("inf"):
        bad_value(name, f"a finite number of {unit} above 0", value)
    return value


def check_flag(value: Any, name: str) -> bool:
    """``True`` or ``False``; a number or a text is neither."""
    if type(value).__name__ not in ("bool", "bool_"):  # the latter is numpy's, which is not imported here
        bad_type(name, "True or False", value)
    return bool(value)


def check_size(value: Any, name: str) -> tuple[int, int] | None:
    """``None`` or ``(width, height)`` in pixels, as a tuple."""
    if value is None:
        return None
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        bad_type(name, "None or a pair (width, height)", value)
    for side in value:
        check_number(side, name, 1, 1 << 24, integer=True)
    return value[0], value[1]


def check_choice(value: Any, name: str, choices: Any) -> Any:
    """One of ``choices``, returned as it came."""
    # What came may have no hash, and an array is equal to a word element by element.
    if not any(isinstance(value, type(choice)) and value == choice for choice in choices):
        bad_value(name, "one of " + ", ".join(sorted(map(str, choices))), repr(value))
    return value


def check_range(value: Any, name: str) -> tuple[float, float]:
    """A pair of numbers ``0 < low < high``, as a tuple of floats."""
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        bad_type(name, "a pair of numbers (low, high)", value)
    low, high = (float(check_number(number, name, 1e-12, 1e12)) for number in value)
    if low >= high:
        bad_value(name, "a pair with 0 < low < high", (low, high))
    return low, high
