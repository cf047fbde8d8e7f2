"""``geodiff eval capture``: options and their help."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["add_capture"]


def capture(
    data: Annotated[
        Path, typer.Argument(metavar="DIR", help="A capture that names depth maps (16-bit PNG, millimetres).")
    ],
    frames: Annotated[str | None, typer.Option(help="NAME,NAME or FIRST:LAST:STEP; all by default.")] = None,
    neighbours: Annotated[str, typer.Option(help="Comma-separated numbers of right views.")] = "2,3,5",
    rows: Annotated[str | None, typer.Option(help="Comma-separated: given, pairs, capture.")] = None,
    prior: Annotated[str, typer.Option(help="'bundled', a hub id or a folder.")] = "bundled",
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:N or mps.")] = "auto",
    out: Annotated[Path, typer.Option(help="Folder of the records.")] = Path("geodiff-eval"),
    results: Annotated[Path | None, typer.Option(help="Write the Markdown page here as well.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Depth of a capture with its poses as given, refined by pairs, and solved together (extra capture)."""
    from geodiff_plugin._checks import bad_value, check_choice
    from geodiff_plugin.cli.eval.printing import print_page
    from geodiff_plugin.evaluation.capture import ROWS, CaptureEvalOptions, run_capture_eval

    chosen = tuple(rows.replace(" ", "").split(",")) if rows else tuple(ROWS)
    for row in chosen:
        check_choice(row, "--rows", ROWS)
    if not all(number.strip().isdigit() and int(number) > 0 for number in neighbours.split(",")):
        bad_value("--neighbours", "numbers above 0, such as 2,3,5", repr(neighbours))
    options = CaptureEvalOptions(
        command=shlex.join(["geodiff", *sys.argv[1:]]),
        data=data,
        frames=frames,
        neighbours=tuple(int(number) for number in neighbours.split(",")),
        rows=chosen,
        prior=prior,
        seed=seed,
        device=device,
        out=out,
        results=results,
        quiet=quiet,
    )
    print_page(run_capture_eval(options))


def add_capture(app: typer.Typer) -> None:
    """Add the command to ``geodiff eval``."""
    app.command("capture")(capture)
