"""Declares settings: dataclass fields with a default, help, check and effect.

``GuidanceConfig`` (``config``) and the options of every command (``options``, ``jobs.options``,
``evaluation.options``) consist of such fields. The command line (``cli.commands``), the web app, the ComfyUI
node, reports and caches read these declarations through ``settings_of``. Nothing here imports torch.

Layer 0: imports only checks; everything above imports it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from enum import StrEnum
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from geodiff_plugin._internal.checks import (
    bad_type,
    check_choice,
    check_flag,
    check_number,
    check_positive,
    number_text,
)

#: The default section of a setting.
DEFAULT_SECTION = "Options"


class Affects(StrEnum):
    """The results that become stale when a setting changes."""

    NOTHING = "nothing"  # stored results stay valid, up to rounding
    INPUTS = "inputs"  # the content of the files that it names
    POSES = "poses"  # the poses of a capture, and all results computed with them
    EVIDENCE = "evidence"  # the evidence from the views (phase 1), and all results computed from it
    RESULT = "result"  # the result


@dataclass(frozen=True)
class Setting:
    """The declaration of one setting.

    Attributes:
        help: what it does, for ``--help`` and the tables in docs/reference/parameters.md.
        flags: how it is typed, if not ``--name-with-dashes``; ``("",)`` for an argument without a name.
        section: its heading in ``--help`` and in the tables.
        affects: what becomes stale when it changes; commands that store nothing declare nothing.
        low: minimum of a number.
        high: maximum of a number; given with ``low``.
        above_0: unit of a number that must be finite and above 0.
        choices: allowed values; empty for any value.
        own_check: function of value and name that returns the value to keep, for other checks.
        own_values: description of the values that ``own_check`` accepts.
        comma_separated: whether a tuple is typed with commas; otherwise its option is repeated.
        metavar: placeholder of the value in ``--help`` (default: a word for its type).
        bare: value of an option that is typed without one; empty if it needs a value.
        unset: meaning of ``None``; empty if ``None`` means no value.
        paper: the paper's value in the tables; ``"{}"`` is replaced by the value in the preset ``PAPER``.
        name: name of the field. ``settings_of`` fills in this and the following attributes.
        default: default of the field; ``MISSING`` if a value is required.
        kind: type of the value, or of each entry of a tuple.
        several: whether the value is a tuple of any length.
    """

    help: str
    flags: tuple[str, ...] = ()
    section: str = DEFAULT_SECTION
    affects: Affects | None = None
    low: float | None = None
    high: float | None = None
    above_0: str = ""
    choices: tuple[str, ...] = ()
    own_check: Callable[[Any, str], Any] | None = None
    own_values: str = ""
    comma_separated: bool = False
    metavar: str | None = None
    bare: str = ""
    unset: str = ""
    paper: str = "{}"
    name: str = ""
    default: Any = None
    kind: Any = None
    several: bool = False

    @property
    def is_argument(self) -> bool:
        """Whether the setting is a positional argument."""
        return self.flags == ("",)

    @property
    def flag(self) -> str:
        """The flag as typed: ``--min-confidence``, or ``LEFT`` for a positional argument."""
        if self.is_argument:
            return self.name.upper()
        return self.flags[0] if self.flags else f"--{self.name.replace('_', '-')}"

    @property
    def values(self) -> str:
        """Description of the allowed values; empty for any value."""
        words = self.own_values or ", ".join(f"`{choice}`" for choice in self.choices)
        if self.low is not None and self.high is not None:
            words = f"{'integer, ' * (self.kind is int)}[{number_text(self.low)}, {number_text(self.high)}]"
        elif self.kind is bool:
            words = "bool"
        return f"{words}, or `None`" if self.unset else words

    def check(self, value: Any, name: str) -> Any:
        """Check a value and return the value to keep; ``InputError`` names the setting ``name``."""
        if value is None and self.default in (None, MISSING):
            return None
        if not self.several:
            return self._check_one(value, name)
        if not isinstance(value, (tuple, list)):
            bad_type(name, "a tuple", value)
        return tuple(self._check_one(entry, name) for entry in value)

    def _check_one(self, value: Any, name: str) -> Any:
        if self.own_check is not None:
            return self.own_check(value, name)
        if self.choices:
            return check_choice(value, name, self.choices)
        if self.low is not None and self.high is not None:
            return self.kind(check_number(value, name, self.low, self.high, integer=self.kind is int))
        if self.above_0:
            return float(check_positive(value, name, self.above_0))
        return check_flag(value, name) if self.kind is bool else value


def setting(default: Any, help_text: str, *flags: str, **rules: Any) -> Any:
    """Create a dataclass field that declares a setting; ``rules`` are attributes of ``Setting``.

    ``default`` is ``MISSING`` if a value is required.
    """
    return dataclasses.field(default=default, metadata={"setting": Setting(help_text, flags, **rules)})


#: Cache of ``settings_of``.
_KNOWN: dict[type, Mapping[str, Setting]] = {}


def settings_of(record: type) -> Mapping[str, Setting]:
    """Return the settings of a dataclass by name, in field order; other fields are omitted."""
    if record not in _KNOWN:
        types = get_type_hints(record)
        _KNOWN[record] = {
            field.name: _bound(field.metadata["setting"], field, types[field.name])
            for field in fields(record)
            if "setting" in field.metadata
        }
    return _KNOWN[record]


def _bound(declared: Setting, field: dataclasses.Field[Any], annotation: Any) -> Setting:
    """Complete a declaration with the name, default and type of its field."""
    kind, several = _kind_of(annotation)
    return dataclasses.replace(declared, name=field.name, default=field.default, kind=kind, several=several)


def _kind_of(annotation: Any) -> tuple[Any, bool]:
    """Return the type without ``None`` (for a tuple, of its entries), and whether it is a tuple."""
    if isinstance(annotation, UnionType):
        annotation = next(each for each in get_args(annotation) if each is not type(None))
    if get_origin(annotation) is tuple and Ellipsis in get_args(annotation):
        return get_args(annotation)[0], True
    return annotation, False


def names_affecting(record: type, affected: Affects) -> list[str]:
    """Return the names of the settings of a dataclass with this effect."""
    return [name for name, declared in settings_of(record).items() if declared.affects is affected]


def check_settings(record: Any, name_of: Callable[[Setting], str] = lambda declared: declared.flag) -> None:
    """Check the value of every setting of a dataclass; ``name_of`` gives the names in errors."""
    for name, declared in settings_of(type(record)).items():
        declared.check(getattr(record, name), name_of(declared))
