"""Check user input and raise errors that state what is wrong and, in most cases, how to correct it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from numbers import Integral, Real
from typing import Any, NoReturn, TypeVar

from geodiff_plugin.findings import Finding

#: Maximum number of characters of the value in a message.
MAX_GOT = 400
#: Hint for a negative baseline.
NEGATIVE_BASELINE = (
    "A negative baseline means that the left and right images are swapped. Swap them, and "
    "pass a positive baseline."
)
#: Findings passed to ``warn`` within the innermost ``captured_warnings`` block.
_CAPTURED: ContextVar[list[Finding] | None] = ContextVar("captured_warnings", default=None)
Problem = TypeVar("Problem", bound="InputError")


class InputError(ValueError):
    """An input that cannot be used.

    The message states what is wrong and, in most cases, how to correct it.

    Attributes:
        code: identifies the error for programs with messages of their own, such as the web app; often empty.
    """

    code: str = ""


class InputTypeError(InputError, TypeError):
    """An input of the wrong type."""


class UnknownPoseError(InputError):
    """Images whose poses cannot be estimated with the given intrinsics."""


class UnknownFormatError(InputError):
    """A file in an unsupported format."""


class InputFileError(InputError, OSError):
    """A file or folder that cannot be read or written."""


class MissingFileError(InputFileError, FileNotFoundError):
    """A file or folder that does not exist."""


def with_code(error: Problem, code: str) -> Problem:
    """Give an error its code."""
    error.code = code
    return error


def bad_value(
    name: str,
    expected: str,
    got: object,
    hint: str = "",
    error: type[InputError] = InputError,
    *,
    code: str = "",
) -> NoReturn:
    """Raise ``<name> must be <expected>; got <got>. <hint>``, with ``got`` shortened to one line."""
    text = " ".join(str(got).split())  # arrays print on several lines, and file names may contain newlines
    text = text if len(text) <= MAX_GOT else f"{text[:MAX_GOT]}..."
    raise with_code(error(f"{name} must be {expected}; got {text}." + (f" {hint}" if hint else "")), code)


def bad_type(name: str, expected: str, got: object, hint: str = "") -> NoReturn:
    """Raise ``InputTypeError`` in the form of ``bad_value``; ``got`` is shown as its type, a string as is."""
    kind = f"the string {got!r}" if isinstance(got, str) else type(got).__name__
    bad_value(name, expected, kind, hint, InputTypeError)


def raise_input_error(message: str, *, code: str = "") -> NoReturn:
    """Raise ``InputError`` with a message that does not fit the form of ``bad_value``."""
    raise with_code(InputError(message), code)


def warn(message: Finding, *, stacklevel: int = 2) -> None:
    """Issue a warning, and record it in the enclosing ``captured_warnings`` block."""
    captured = _CAPTURED.get()
    if captured is not None and message not in captured:
        captured.append(message)
    warnings.warn(message, stacklevel=stacklevel + 1)


@contextmanager
def captured_warnings() -> Iterator[list[Finding]]:
    """Collect the messages of all ``warn`` calls in the block, without duplicates. Blocks can be nested."""
    captured: list[Finding] = []
    outer = _CAPTURED.get()
    token = _CAPTURED.set(captured)
    try:
        yield captured
    finally:
        _CAPTURED.reset(token)
        if outer is not None:
            outer += [message for message in captured if message not in outer]


def _check_kind(value: Any, name: str, integer: bool) -> None:
    kind: Any = Integral if integer else Real
    if isinstance(value, bool) or not isinstance(value, kind):
        bad_type(name, "an integer" if integer else "a number", value)


def number_text(number: float) -> str:
    """Format a number with up to 15 digits: 4294967296, which ``g`` would round to 4.29497e+09."""
    return f"{number:.15g}"


def check_number(value: Any, name: str, low: float, high: float, *, integer: bool = False) -> Any:
    """Check that a value is a finite number in ``[low, high]``, and return it unchanged."""
    _check_kind(value, name, integer)
    # Integers may exceed the range of floats, so they are compared without conversion. NaN fails every
    # comparison.
    if not low <= value <= high or value in (float("inf"), float("-inf")):
        huge = isinstance(value, int) and value.bit_length() > 128
        got = "an integer of more than 128 bits" if huge else value
        bad_value(name, f"between {number_text(low)} and {number_text(high)}", got)
    return value


def check_positive(value: Any, name: str, unit: str, hint_below_0: str = "", *, code: str = "") -> Any:
    """Check that a value is a finite number above 0, and return it unchanged."""
    _check_kind(value, name, False)
    if not 0 < value < float("inf"):
        hint = hint_below_0 if value < 0 else ""
        bad_value(name, f"a finite number of {unit} above 0", value, hint, code=code)
    return value


def check_baseline_m(value: Any, name: str) -> float:
    """Check that the baseline of a rectified pair is a finite number of metres above 0."""
    return float(check_positive(value, name, "metres", NEGATIVE_BASELINE, code="baseline.sign"))


def check_flag(value: Any, name: str) -> bool:
    """Check that a value is ``True`` or ``False``, not a number or a string."""
    if type(value).__name__ not in ("bool", "bool_"):  # NumPy's bool_, without importing NumPy
        bad_type(name, "True or False", value)
    return bool(value)


def check_size(value: Any, name: str) -> tuple[int, int] | None:
    """Check that a value is ``None`` or ``(width, height)`` in pixels, and return it as a tuple."""
    if value is None:
        return None
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        bad_type(name, "None or a pair (width, height)", value)
    for side in value:
        check_number(side, name, 1, 1 << 24, integer=True)
    return value[0], value[1]


def check_choice(value: Any, name: str, choices: Any) -> Any:
    """Check that a value is one of ``choices``, and return it unchanged."""
    # The value may not be hashable, and an array compares with a string element by element.
    if not any(isinstance(value, type(choice)) and value == choice for choice in choices):
        bad_value(name, "one of " + ", ".join(sorted(map(str, choices))), repr(value))
    return value


def check_range(value: Any, name: str) -> tuple[float, float]:
    """Check that a value is a pair of numbers ``0 < low < high``, and return it as a tuple of floats."""
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        bad_type(name, "a pair of numbers (low, high)", value)
    low, high = (float(check_number(number, name, 1e-12, 1e12)) for number in value)
    if low >= high:
        bad_value(name, "a pair with 0 < low < high", (low, high))
    return low, high
