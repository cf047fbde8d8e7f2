"""Commands of typer from dataclasses of options, each built when it is typed: ``--help`` answers at once."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

import typer
import typer.main
from typer.core import TyperCommand, TyperGroup

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.cli.terminal import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED
from geodiff_plugin.jobs.memory import CURE, is_out_of_memory
from geodiff_plugin.jobs.stopping import Terminated, ending_on_sigterm
from geodiff_plugin.jobs.telling import say
from geodiff_plugin.options import (
    OTHERS,
    OUTPUT,
    PANELS,
    Command,
    OptionRules,
    check_options,
    flag_of,
    rules_of,
)

APPEARANCE: dict[str, Any] = {
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
#: What help calls the values of an option.
METAVARS = {bool: "", Path: "PATH", int: "NUMBER", float: "NUMBER"}


#: How a number of a type is called that is typed wrong.
NUMBERS = {int: "a whole number", float: "a number"}


class _Group(TyperGroup):
    table: Mapping[str, Command]

    def get_help_option(self, ctx: Any) -> Any:
        """``--help``, which takes no value to be named."""
        option = super().get_help_option(ctx)
        vars(option).update(metavar="")
        return option

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that was typed, with its options."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else _built(name, self.table[name]), rest


class _OutermostGroup(_Group):
    """Bad input is one line and exit code 2, Ctrl-C is exit code 130, SIGTERM 143."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen subcommand."""
        try:
            with ending_on_sigterm():
                return super().invoke(ctx)
        except Terminated:
            say("geodiff: terminated; the same command resumes")
            sys.exit(EXIT_TERMINATED)
        except KeyboardInterrupt:
            say("geodiff: interrupted; the same command resumes")
            sys.exit(EXIT_INTERRUPTED)
        except InputError as error:  # any other is a defect, and keeps its traceback
            say(f"geodiff: {error}")
            sys.exit(EXIT_BAD_INPUT)
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            say(f"geodiff: the memory is not enough. {CURE}.")
            sys.exit(EXIT_BAD_INPUT)


class _Single(TyperCommand):
    def get_help_option(self, ctx: Any) -> Any:
        """``--help``, among the options of output instead of in a group of its own."""
        option = super().get_help_option(ctx)
        panels = {getattr(each, "rich_help_panel", None) for each in self.params}
        vars(option).update(metavar="", rich_help_panel=OUTPUT if OUTPUT in panels else OTHERS)
        return option


def new_group(help_text: str, commands: Mapping[str, Command], outermost: bool = False) -> typer.Typer:
    """A group of commands by their names; errors are told by the outermost one."""
    kind = type("Group", (_OutermostGroup if outermost else _Group,), {"table": commands})
    group = typer.Typer(cls=kind, help=help_text, no_args_is_help=True, **APPEARANCE)
    for name, command in commands.items():
        group.command(name, help=command.about)(lambda: None)
    return group


def _built(name: str, command: Command) -> Any:
    if command.options is None:
        return typer.main.get_command(command.run(None))
    options, kinds = command.options, get_type_hints(command.options)
    known = _in_order(options)

    def call(**typed: Any) -> None:
        values = {
            field.name: _value(field, rules, typed[field.name], kinds[field.name])
            for field, rules in known.items()
        }
        made = options(**values)
        check_options(made)
        command.run(made)

    parameters = [_parameter(field, rules, kinds[field.name]) for field, rules in known.items()]
    vars(call)["__signature__"] = Signature(parameters)
    single = typer.Typer(**APPEARANCE)
    single.command(name, cls=_Single, help=command.about)(call)
    return typer.main.get_command(single)


def _in_order(options: type) -> dict[dataclasses.Field[Any], OptionRules]:
    """The options that are declared, with their rules: arguments first, then group by group."""
    known = {field: rules for field in dataclasses.fields(options) if (rules := rules_of(field)) is not None}

    def place(field: dataclasses.Field[Any]) -> tuple[bool, int]:
        return not known[field].is_argument, PANELS.index(known[field].panel)

    return {field: known[field] for field in sorted(known, key=place)}


def _parameter(field: dataclasses.Field[Any], rules: OptionRules, kind: Any) -> Parameter:
    """An option or argument of typer for a field of a dataclass of options."""
    required, default = field.default is dataclasses.MISSING, cast(Any, field.default)
    about: dict[str, Any] = {
        "metavar": _metavar(kind) if rules.metavar is None else rules.metavar,
        "help": rules.help,
    }
    if rules.split:
        if default:  # in the sentence: lines of help break at blanks alone, and it is typed without them
            listed = "all" if set(default) == set(rules.choices) else ", ".join(map(str, default))
            about["help"] = f"{rules.help.removesuffix('.')} (default: {listed})."
        kind, default = str | None, ",".join(map(str, default)) or None
    elif get_origin(kind) is tuple:
        kind = list[get_args(kind)[0]]  # type: ignore[misc]
        kind, default = (kind, default) if required else (kind | None, list(default) or None)
    elif _number(kind):  # read by _value, which says what was typed
        kind, default = str | None, default if required or default is None else str(default)
    if rules.is_argument:
        typed: Any = typer.Argument(**about)
    else:
        flags = rules.flags or (flag_of(field),)
        typed = typer.Option(*flags, **about, rich_help_panel=rules.panel, show_default=not rules.split)
    default = Parameter.empty if required else default
    return Parameter(field.name, Parameter.KEYWORD_ONLY, annotation=Annotated[kind, typed], default=default)


def _metavar(kind: Any) -> str:
    """What an option takes, in a word; nothing for one that is switched on."""
    kinds = {kind, *get_args(kind), *(inner for each in get_args(kind) for inner in get_args(each))}
    return next((word for name, word in METAVARS.items() if name in kinds), "TEXT")


def _number(kind: Any) -> Any:
    """``int`` or ``float``, where a field is one number; else ``None``."""
    return next((number for number in NUMBERS if number in (kind, *get_args(kind))), None)


def _value(field: dataclasses.Field[Any], rules: OptionRules, value: Any, kind: Any) -> Any:
    """What was typed, as the field has it."""
    if rules.split:
        parts = [part.strip() for part in (value or "").split(",") if part.strip()]
        if get_args(kind)[0] is int and not all(part.isdecimal() for part in parts):
            bad_value(flag_of(field), "whole numbers, comma-separated", repr(value))
        return tuple(get_args(kind)[0](part) for part in parts)
    if get_origin(kind) is tuple:
        return tuple(value or ())
    number = _number(kind)
    if number is None or value is None:
        return value
    try:
        return number(value)
    except ValueError:
        bad_value(flag_of(field), NUMBERS[number], repr(value), _cure_of_number(value))


def _cure_of_number(typed: str) -> str:
    """What to type instead of a decimal comma, or of a number with its unit."""
    if "," in typed:
        return "Decimals follow a point: 0.12."
    return "Give the number alone; --help names its unit." if typed[:1].isdigit() else ""
