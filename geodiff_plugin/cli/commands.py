"""Create click commands from records of options.

An option is a field declared with ``settings.setting``. ``_parameter`` creates the click option for it.
``new_command`` creates a command that calls ``Command.run`` with the record of the typed options. A group
creates a command only when it is called, so that ``--help`` is immediate.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any

import click

from geodiff_plugin._internal.checks import InputError, bad_value
from geodiff_plugin.cli.terminal import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED
from geodiff_plugin.jobs import MEMORY_HINT, Terminated, ending_on_sigterm, is_out_of_memory, say
from geodiff_plugin.options import OUTPUT, SECTIONS, Command
from geodiff_plugin.settings import DEFAULT_SECTION, Setting, check_settings, settings_of

#: Settings of every command: ``-h`` is short for ``--help``, and help lines have at most 100 characters.
CONTEXT: dict[str, Any] = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
#: Placeholders of values in help by type.
METAVARS = {Path: "PATH", int: "NUMBER", float: "NUMBER"}
#: Expected single and comma-separated numbers in error messages, by type.
NUMBERS = {
    int: ("an integer", "comma-separated integers"),
    float: ("a number", "comma-separated numbers"),
}
#: Replacement for hyphens in help while lines are wrapped, because ``--view-E`` or a hub id must not be
#: split.
NO_BREAK = "\N{NON-BREAKING HYPHEN}"


def new_group(help_text: str, commands: Mapping[str, Command], outermost: bool = False) -> click.Group:
    """Create a group of commands; the outermost group reports errors."""
    kind = _OutermostGroup if outermost else _Group
    return kind(help_text, commands)


class _Group(click.Group):
    """A group that lists its commands without creating them."""

    def __init__(self, help_text: str, table: Mapping[str, Command]) -> None:
        listed = [click.Command(name, short_help=each.about.split("\n")[0]) for name, each in table.items()]
        super().__init__(commands=listed, help=help_text, no_args_is_help=True, context_settings=CONTEXT)
        self.table = table

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the table."""
        return list(self.table)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Create the typed command with its options."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else new_command(name, self.table[name]), rest


class _OutermostGroup(_Group):
    """A group that reports bad input in one line with exit code 2, Ctrl-C with 130 and SIGTERM with 143."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen subcommand."""
        try:
            with ending_on_sigterm():
                return super().invoke(ctx)
        except Terminated:
            say("geodiff: terminated. Run the same command again to resume or restart.")
            sys.exit(EXIT_TERMINATED)
        except KeyboardInterrupt:
            say("geodiff: interrupted. Run the same command again to resume or restart.")
            sys.exit(EXIT_INTERRUPTED)
        except InputError as error:  # any other error is a bug and keeps its traceback
            say(f"geodiff: {error}")
            sys.exit(EXIT_BAD_INPUT)
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            say(f"geodiff: out of memory. {MEMORY_HINT}.")
            sys.exit(EXIT_BAD_INPUT)


class _Command(click.Command):
    """A command whose help has one section per group of options."""

    def __init__(self, name: str, options: Mapping[str, Setting], **more: Any) -> None:
        parameters = [_parameter(option) for option in options.values()]
        super().__init__(name, params=parameters, context_settings=CONTEXT, **more)
        self.options = options
        self.sections = {name: option.section for name, option in options.items()}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the words. An option that may lack a value takes the next word only if it is a choice."""
        bare = {option.flag: option for option in self.options.values() if option.bare}
        words = [
            f"{word}={bare[word].bare}" if word in bare and after not in bare[word].choices else word
            for word, after in zip(args, [*args[1:], ""], strict=False)
        ]
        return super().parse_args(ctx, words)

    def get_help(self, ctx: click.Context) -> str:
        """Return the help text."""
        return super().get_help(ctx).replace(NO_BREAK, "-")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one section per group of options; ``--help`` is listed with the output options."""
        of_help = OUTPUT if OUTPUT in self.sections.values() else DEFAULT_SECTION
        rows: dict[str, list[tuple[str, str]]] = {section: [] for section in SECTIONS}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and isinstance(parameter, click.Option):
                rows[self.sections.get(str(parameter.name), of_help)].append(record)
        for section, shown in rows.items():
            if shown:
                with formatter.section(section):
                    formatter.write_dl(shown)


def new_command(name: str, command: Command) -> click.Command:
    """Create a command with its options, or the group that it represents."""
    if command.options is None:
        group: click.Group = command.run(None)
        return group
    record = command.options

    def call(**typed: Any) -> None:
        options = record(**typed)
        check_settings(options)
        command.run(options)

    return _Command(name, settings_of(record), callback=call, help=command.about)


def _parameter(option: Setting) -> click.Parameter:
    """Create the click option or argument for a setting."""
    required = option.default is MISSING
    default = _default_text(option)
    sentence = f"{option.help} [default: {default}]" if default else option.help
    common: dict[str, Any] = {"help": sentence.replace("-", NO_BREAK), "required": required}
    if not required:
        common["default"] = option.default
    return _argument(option, common) if option.is_argument else _option(option, common)


def _argument(option: Setting, common: dict[str, Any]) -> click.Argument:
    """Create the click argument for a setting; ``common`` are arguments that every parameter has."""
    metavar = option.metavar or option.flag
    if option.several:
        metavar += "..."
    if not common["required"]:
        metavar = f"[{metavar}]"
    count = -1 if option.several else 1
    return click.Argument([option.name], type=_Typed(option), metavar=metavar, nargs=count, **common)


def _option(option: Setting, common: dict[str, Any]) -> click.Option:
    """Create the click option for a setting; ``common`` are arguments that every parameter has."""
    names = [option.name, *(option.flags or (option.flag,))]
    if option.kind is bool:
        return click.Option(names, is_flag=True, **common)
    is_repeated = option.several and not option.comma_separated
    return click.Option(names, type=_Typed(option), metavar=option.metavar, multiple=is_repeated, **common)


def _default_text(option: Setting) -> str:
    """Return the default as shown in help; empty for none."""
    if option.default in (None, (), MISSING) or option.kind is bool:
        return ""
    if option.several:
        everything = set(option.default) == set(option.choices)
        return "all" if everything else ", ".join(map(str, option.default))
    return str(option.default)


class _Typed(click.ParamType[Any]):
    """Parser for the typed value of a setting. Bad values raise ``InputError``, as in all checks."""

    def __init__(self, option: Setting) -> None:
        self.option = option
        self.name = METAVARS.get(option.kind, "TEXT")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse a typed value; a default is already parsed."""
        if not isinstance(value, str):
            return value
        kind, several = self.option.kind, self.option.comma_separated
        try:
            if several:
                return tuple(kind(part.strip()) for part in value.split(",") if part.strip())
            return kind(value)
        except ValueError:
            hint = "" if several else _hint_for_number(value)
            bad_value(self.option.flag, NUMBERS[kind][several], repr(value), hint)


def _hint_for_number(typed: str) -> str:
    """Return a hint for a decimal comma or a number with a unit."""
    if "," in typed:
        return "Use a decimal point: 0.12."
    return "Enter only the number; --help states its unit." if typed[:1].isdigit() else ""
