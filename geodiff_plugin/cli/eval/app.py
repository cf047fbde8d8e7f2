"""The ``geodiff eval`` commands, built from ``evaluation.options.COMMANDS``.

Torch and diffusers are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.commands import add_command
from geodiff_plugin.evaluation.options import COMMANDS
from geodiff_plugin.formats.out import check_out

__all__ = ["eval_app"]

eval_app = typer.Typer(
    help="Measure this package and its peers on data sets in their official layouts.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _run(name: str, options: Any) -> None:
    check_out(options.out)
    result = COMMANDS[name](name, options)
    if result is None or options.quiet:
        return
    if isinstance(result, Path):
        typer.echo(result)
    else:
        from geodiff_plugin.cli.eval.printing import print_page

        print_page(result)


for _name, _command in COMMANDS.items():
    add_command(eval_app, _name, _command.options, partial(_run, _name), _command.about)


@eval_app.command("list")
def list_(
    data: Annotated[Path | None, typer.Option(help="Folder to look into.")] = None,
) -> None:
    """Say for every data set whether it is there and how to obtain it, and list the methods."""
    from geodiff_plugin.cli.eval.listing import run_list

    run_list(data)
