"""The laboratory: ``geodiff eval`` with rendered pairs as a data set, and experiments on the package itself.

python -m tests.lab pairs synthetic:3
python -m tests.lab strength --help
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import partial
from typing import Any

import typer

from geodiff_plugin.cli.commands import APPEARANCE, new_group
from geodiff_plugin.cli.eval import LIST, run_and_show
from geodiff_plugin.evaluation.options import COMMANDS
from geodiff_plugin.options import Command
from tests.lab.options import SequenceOptions, StrengthOptions, TrustOptions

PROGRAM = "python -m tests.lab"


def _run(name: str, options: Any) -> Any:
    """The page of a laboratory, which is ``run`` of the module of its name."""
    return importlib.import_module(f"tests.lab.{name}").run(name, options)


def _surfaces(_: None) -> typer.Typer:
    from tests.lab.surfaces import main

    alone = typer.Typer(**APPEARANCE)
    alone.command()(main)
    return alone


#: Every laboratory, a line each; each has a module of its name here.
LABORATORIES = {
    "strength": Command(StrengthOptions, partial(_run, "strength"), "Emulated priors from exact to weak."),
    "surfaces": Command(None, _surfaces, "How flat planes are after every stage of a call."),
    "trust": Command(TrustOptions, partial(_run, "trust"), "How many wrong calibrations are detected."),
    "sequence": Command(
        SequenceOptions, partial(_run, "sequence"), "Frames of a moving rig: error, flicker."
    ),
}


def _typed_here(command: Command) -> Command:
    """The command as it runs here, where pages name this program; one with options of its own stays."""
    if command.options is None:
        return command
    return command._replace(run=lambda options: run_and_show(command.run, replace(options, program=PROGRAM)))


lab_app = new_group(
    "Measure this package on data sets, rendered pairs among them.",
    {name: _typed_here(command) for name, command in (COMMANDS | LABORATORIES).items()} | {"list": LIST},
    outermost=True,
)

if __name__ == "__main__":
    lab_app(prog_name=PROGRAM)
