"""``geodiff eval sequence``: options and their help.

Data flow: argv -> ``SequenceOptions`` -> ``evaluation.sequence`` -> its page, printed.
Paper: none.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from geodiff_plugin.cli.eval.options import Device, Out, names

__all__ = ["add_sequence"]


def sequence(
    scenes: Annotated[int, typer.Option(min=1, help="Rendered scenes.")] = 4,
    frames: Annotated[int, typer.Option(min=2, help="Frames of each.")] = 6,
    ways: Annotated[
        str | None,
        typer.Option(help="Comma-separated: alone, alone-half, scale, warm, warm-50, warm-75."),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Denoising steps of a frame alone.")] = 4,
    prior: Annotated[str, typer.Option(help="'bundled', a hub id or a folder.")] = "bundled",
    seed: Annotated[int, typer.Option(help="Of the noise, the same for every frame.")] = 0,
    device: Device = "auto",
    out: Out = Path("geodiff-eval"),
    results: Annotated[Path | None, typer.Option(help="Write the Markdown page here as well.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Depth of a moving rig: every frame alone, or each from the frame before; error, flicker, seconds."""
    from geodiff_plugin.cli.eval.printing import print_page
    from geodiff_plugin.evaluation.sequence import WAYS, SequenceOptions, run_sequence

    options = SequenceOptions(
        command=shlex.join(["geodiff", *sys.argv[1:]]),
        scenes=scenes,
        frames=frames,
        ways=names(ways) or tuple(WAYS),
        steps=steps,
        prior=prior,
        seed=seed,
        device=device,
        out=out,
        results=results,
        quiet=quiet,
    )
    print_page(run_sequence(options))


def add_sequence(app: typer.Typer) -> None:
    """Add the command to ``geodiff eval``."""
    app.command("sequence")(sequence)
