"""Run ``geodiff eval`` with rendered pairs as a data set, and experiments on the package itself.

python -m tests.lab pairs synthetic:3
python -m tests.lab strength --help
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import partial
from typing import Any

from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.cli.eval import LIST, run_and_show
from geodiff_plugin.evaluation.options import COMMANDS
from geodiff_plugin.options import Command
from tests.lab.options import (
    PriorMapsOptions,
    SequenceOptions,
    StrengthOptions,
    SurfacesOptions,
    TrustOptions,
)

PROGRAM = "python -m tests.lab"


def _run(name: str, options: Any) -> Any:
    """Run an experiment: ``run`` of the module with its name."""
    return importlib.import_module(f"tests.lab.{name.replace('-', '_')}").run(name, options)


#: Experiments; each is a module of this package with its name.
EXPERIMENTS = {
    "strength": Command(
        StrengthOptions, partial(_run, "strength"), "Effect of prior quality, with emulated priors."
    ),
    "prior-maps": Command(
        PriorMapsOptions, partial(_run, "prior-maps"), "Guided calls with depth maps that have errors."
    ),
    "surfaces": Command(
        SurfacesOptions,
        partial(_run, "surfaces"),
        "Planarity and smoothness of surfaces after every stage of a call.",
    ),
    "trust": Command(TrustOptions, partial(_run, "trust"), "How many wrong calibrations are detected."),
    "sequence": Command(
        SequenceOptions, partial(_run, "sequence"), "Error and flicker of frames from a moving rig."
    ),
}


def _with_program(command: Command) -> Command:
    """Return the command with this program's name on its pages, if it writes one."""
    if command.options is SurfacesOptions:
        return command
    return command._replace(run=lambda options: run_and_show(command.run, replace(options, program=PROGRAM)))


lab_app = new_group(
    "Measure this package on data sets, including rendered pairs.",
    {name: _with_program(command) for name, command in (COMMANDS | EXPERIMENTS).items()} | {"list": LIST},
    outermost=True,
)

if __name__ == "__main__":
    lab_app.main(prog_name=PROGRAM)
