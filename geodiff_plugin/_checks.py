"""The one voice of every user-facing error: name, expected, got, likely cure.

Hop: an argument as the user gave it -> the same argument, or ``ValueError``/``TypeError``.
Paper: none.
"""

from __future__ import annotations

from typing import NoReturn

__all__ = ["bad_type", "bad_value"]


def _sentence(name: str, expected: str, got: object, cure: str) -> str:
    return f"{name} must be {expected}; got {got}." + (f" {cure}" if cure else "")


def bad_value(name: str, expected: str, got: object, cure: str = "") -> NoReturn:
    """Raise ``ValueError``: ``<name> must be <expected>; got <got>. <cure>``."""
    raise ValueError(_sentence(name, expected, got, cure))


def bad_type(name: str, expected: str, got: object, cure: str = "") -> NoReturn:
    """Raise ``TypeError`` with the same sentence, naming the type of what came."""
    raise TypeError(_sentence(name, expected, f"{type(got).__name__}", cure))
