"""``geodiff eval figure NAME``: options and their help.

Data flow: argv -> ``FigureOptions`` -> ``evaluation.figures``.
Paper: Figures of S5.2, S5.3, S7.3, S9.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.eval import options as o

__all__ = ["add_figures"]


@o.takes(*o.SAMPLES, "prior", *o.SETTINGS, "perturb", "out", "quiet", prior="bundled")
def _figure(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="gs-sweep, inner-steps, ablation, exposure, qualitative, epipolar or terms."
        ),
    ],
    data: o.Data = Path("synthetic:1"),
    methods: Annotated[
        str | None,
        typer.Option(help="Of exposure, ablation, qualitative: comma-separated, instead of their own."),
    ] = None,
    largest: Annotated[float, typer.Option("--max", help="gs-sweep: the last g_s, metres.")] = 80.0,
    updates: Annotated[str, typer.Option(help="inner-steps: updates per step, comma-separated.")] = (
        "1,2,5,10,20,40"
    ),
    clouds: Annotated[
        bool, typer.Option("--clouds", help="qualitative, ablation: point clouds from another view too.")
    ] = False,
    **shared: Any,
) -> None:
    """Draw one figure as PNG, with its numbers as JSON beside it."""
    from geodiff_plugin._checks import bad_value
    from geodiff_plugin.evaluation.figures import FigureOptions, run_figure

    numbers = o.names(updates)
    if not all(number.isdecimal() for number in numbers):
        bad_value("updates", "whole numbers, comma-separated", repr(updates))
    run = o.pairs_options({"data": data, "methods": methods, **shared})
    path = run_figure(name, FigureOptions(run, largest, tuple(map(int, numbers)), clouds))
    if not shared["quiet"]:
        typer.echo(path)


def add_figures(app: typer.Typer) -> None:
    """Add ``figure`` to ``geodiff eval``."""
    app.command("figure")(_figure)
