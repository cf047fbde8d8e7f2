"""Options that several commands of ``geodiff`` share, and their help panels.

Data flow: a help text -> an option of typer.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = ["CAMERAS", "OUT", "OUTPUT", "RUN", "Device", "Overwrite", "option", "out_folder"]

CAMERAS, RUN, OUTPUT = "Cameras", "Prior and run", "Output"
OUT = ("--out", "-o")


def option(help_text: str, panel: str, *names: str) -> Any:
    """An option under one of the headings of the help."""
    return typer.Option(*names, help=help_text, rich_help_panel=panel, show_default=True)


def out_folder(typed: Path | None, default: str, overwrite: bool) -> Path:
    """The folder that was named, else the default, with a number where it is taken."""
    from geodiff_plugin.formats.out import free_folder

    if typed is not None:
        return typed
    return Path(default) if overwrite else free_folder(Path(default))


Device = Annotated[str, option("auto, cpu, cuda, cuda:N or mps.", RUN, "--device")]
Overwrite = Annotated[
    bool, option("Write into a folder that holds files; do finished pairs anew.", OUTPUT, "--overwrite")
]
