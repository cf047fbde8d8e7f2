"""Commands of typer from dataclasses of options."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from inspect import Parameter, Signature
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from geodiff_plugin._checks import bad_value
from geodiff_plugin.options import CAMERAS, OUTPUT, RUN, flag_of

__all__ = ["add_command"]


def _parameter(field: dataclasses.Field[Any], kind: Any) -> Parameter:
    """An option or argument of typer for a field of a dataclass of options."""
    rules = field.metadata
    default: Any = field.default
    flags = rules["flags"] or (flag_of(field),)
    if get_origin(kind) is tuple:
        if rules["split"]:
            kind, default = str | None, ",".join(map(str, default)) or None
        else:
            kind, default = list[get_args(kind)[0]] | None, list(default) or None  # type: ignore[misc]
    if flags == ("",):
        typed: Any = typer.Argument(metavar=rules["metavar"], help=rules["help"])
    else:
        typed = typer.Option(
            *flags, metavar=rules["metavar"], help=rules["help"], rich_help_panel=rules["panel"] or None
        )
    default = Parameter.empty if default is dataclasses.MISSING else default
    return Parameter(field.name, Parameter.KEYWORD_ONLY, annotation=Annotated[kind, typed], default=default)


def _value(field: dataclasses.Field[Any], value: Any, kind: Any) -> Any:
    """What was typed, as the field has it."""
    if get_origin(kind) is not tuple:
        return value
    if field.metadata["split"]:
        parts = [part.strip() for part in (value or "").split(",") if part.strip()]
        if get_args(kind)[0] is int and not all(part.isdecimal() for part in parts):
            bad_value(flag_of(field), "whole numbers, comma-separated", repr(value))
        return tuple(get_args(kind)[0](part) for part in parts)
    return tuple(value or ())


def add_command(group: typer.Typer, name: str, options: type, run: Callable[[Any], None], about: str) -> None:
    """Add a command whose options are the fields of a dataclass.

    Args:
        group: of the command.
        name: as typed.
        options: dataclass with fields of ``geodiff_plugin.options.declare``.
        run: called with an instance.
        about: what the command does, a sentence.
    """
    kinds = get_type_hints(options)
    panels = [CAMERAS, RUN, OUTPUT]
    known = [field for field in dataclasses.fields(options) if field.metadata]
    known.sort(key=lambda f: (flag_of(f)[0] == "-", panels.index(f.metadata["panel"] or RUN)))

    def call(**typed: Any) -> None:
        run(options(**{f.name: _value(f, typed[f.name], kinds[f.name]) for f in known}))

    vars(call)["__signature__"] = Signature([_parameter(field, kinds[field.name]) for field in known])
    group.command(name, help=about)(call)
