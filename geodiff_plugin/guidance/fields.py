"""Fields of a configuration: default, valid range, help text, value in the paper.

Data flow: a field's description -> its check, its row in docs/reference/knobs.md and in ``geodiff info
    --knobs``.
Paper: none.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_flag, check_number, check_range

__all__ = [
    "AS_SET",
    "TINY",
    "Checked",
    "FrozenDict",
    "Knob",
    "by_name",
    "choice",
    "close_names",
    "flag",
    "integer",
]
__all__ += ["key_of", "number", "pair", "text"]

Check = Callable[[Any, str], Any]

#: Least of what is divided by.
TINY = 1e-9
#: The paper's column shows the value of the preset; other texts stand for themselves, ``{}`` for the value.
AS_SET = "{}"


@dataclass(frozen=True)
class Knob:
    """What is known about one field.

    Attributes:
        doc: one line on what it does, with its source where it has one.
        values: what it may be, in words.
        check: value and name -> the value as it is kept; raises ``InputError``.
        paper: what the paper says of it; ``"{}"`` stands for the value of the ``PAPER`` preset.
        unset: what ``None`` becomes when the guidance is used, in words; empty where ``None`` is not allowed.
    """

    doc: str
    values: str
    check: Check
    paper: str = AS_SET
    unset: str = ""

    @classmethod
    def of(cls, described: Field[Any]) -> Knob:
        """The description of a field."""
        return described.metadata["knob"]


class FrozenDict(dict[str, Any]):
    """A dict that stays as it was made, so that a configuration can hold it; equal to a dict of its items."""

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a configuration does not change; make another one with changed(...)")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _refuse

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[type[FrozenDict], tuple[dict[str, Any]]]:
        return FrozenDict, (dict(self),)


class Checked:
    """A frozen dataclass whose fields are checked, and brought into one form, when it is made."""

    def __post_init__(self) -> None:
        for one in fields(self):  # type: ignore[arg-type]
            if "knob" in one.metadata:
                value = Knob.of(one).check(getattr(self, one.name), one.name)
                object.__setattr__(self, one.name, value)


def _described(default: Any, knob: Knob) -> Any:
    if knob.unset:
        check = knob.check
        knob = Knob(
            knob.doc,
            f"{knob.values}, or `None`",
            lambda value, name: None if value is None else check(value, name),
            knob.paper,
            knob.unset,
        )
    return field(default=default, metadata={"knob": knob})


def _range_text(low: float, high: float) -> str:
    return f">= {low:g}" if math.isinf(high) else f"[{low:g}, {high:g}]"


def number(
    default: float | None, low: float, high: float, doc: str, *, paper: str = AS_SET, unset: str = ""
) -> Any:
    """A finite number in ``[low, high]``; ``None`` too where ``unset`` says what it becomes."""

    def check(value: Any, name: str) -> float:
        return float(check_number(value, name, low, high))

    return _described(default, Knob(doc, _range_text(low, high), check, paper, unset))


def integer(
    default: int | None, low: int, high: int, doc: str, *, paper: str = AS_SET, unset: str = ""
) -> Any:
    """A whole number in ``[low, high]``; ``None`` too where ``unset`` says what it becomes."""

    def check(value: Any, name: str) -> int:
        return int(check_number(value, name, low, high, integer=True))

    return _described(default, Knob(doc, f"integer, {_range_text(low, high)}", check, paper, unset))


def flag(default: bool, doc: str, *, paper: str = AS_SET) -> Any:
    """``True`` or ``False``, nothing that only counts as one of them."""
    return _described(default, Knob(doc, "bool", check_flag, paper))


def choice(default: str, choices: tuple[str, ...], doc: str, *, paper: str = AS_SET) -> Any:
    """One of some names."""
    values = ", ".join(f"`{name}`" for name in choices)
    return _described(default, Knob(doc, values, lambda v, name: check_choice(v, name, choices), paper))


def key_of(default: str, table: str, doc: str, *, paper: str = AS_SET) -> Any:
    """A key of a table that lies above the configuration and may grow; checked by who has the table."""

    def check(value: Any, name: str) -> str:
        return value if isinstance(value, str) else bad_type(name, f"a key of {table}", value)

    return _described(default, Knob(doc, f"key of `{table}`", check, paper))


def text(default: str, values: str, doc: str, *, paper: str = AS_SET) -> Any:
    """A text that is not empty; what it may be is only known where it is used."""

    def check(value: Any, name: str) -> str:
        if isinstance(value, Path):
            value = str(value)
        return value if isinstance(value, str) and value else bad_type(name, f"a text ({values})", value)

    return _described(default, Knob(doc, values, check, paper))


def pair(
    default: tuple[float, float] | None, doc: str, *, unit: str = "", paper: str = AS_SET, unset: str = ""
) -> Any:
    """Two numbers, ``0 < low < high``; a list is taken for a tuple."""

    def check(value: Any, name: str) -> tuple[float, float]:
        return check_range(value, name) or bad_type(name, "a pair of numbers (low, high)", value)

    values = "pair with 0 < low < high" + (f", {unit}" if unit else "")
    return _described(default, Knob(doc, values, check, paper, unset))


def by_name(default: Mapping[str, Any], values: str, each: Check, doc: str, *, paper: str = AS_SET) -> Any:
    """A dict with names as keys, every value checked by ``each``."""

    def check(value: Any, name: str) -> FrozenDict:
        if not isinstance(value, Mapping):
            bad_type(name, f"a dict, {values}", value)
        for key in value:
            if not isinstance(key, str):
                bad_value(f"a key of {name}", "a text", repr(key))
        return FrozenDict({key: each(entry, f"{name}[{key!r}]") for key, entry in value.items()})

    return _described(FrozenDict(default), Knob(doc, values, check, paper))


def close_names(name: str, known: Iterable[str]) -> str:
    """Names that exist, those that look like ``name`` first, as a sentence."""
    known = list(known)
    near = difflib.get_close_matches(name, known, 3, 0.6)
    hint = f"Did you mean {' or '.join(near)}? " if near else ""
    return f"{hint}There are: {', '.join(known)}."
