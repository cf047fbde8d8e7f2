"""``geodiff eval figure NAME``: options and their help.

Hop: argv -> ``FigureOptions`` -> ``evaluation.figures``.
Paper: Figures of S5.2, S5.3, S7.3, S9.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geodiff_plugin.cli.eval import options as o

__all__ = ["add_figures"]

_OWN = ("name", "largest", "updates", "clouds")


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
    datasets: o.Datasets = None,
    scenes: o.Scenes = None,
    limit: o.Limit = None,
    largest: Annotated[float, typer.Option("--max", help="gs-sweep: the last g_s, metres.")] = 80.0,
    updates: Annotated[str, typer.Option(help="inner-steps: updates per step, comma-separated.")] = (
        "1,2,5,10,20,40"
    ),
    clouds: Annotated[
        bool, typer.Option("--clouds", help="qualitative, ablation: point clouds from another view too.")
    ] = False,
    prior: o.Prior = "bundled",
    space: o.Space = None,
    ensemble: o.Ensemble = 1,
    seed: o.Seed = 0,
    steps: o.Steps = None,
    resolution: o.Resolution = None,
    views: o.Views = 2,
    perturb: o.Perturb = None,
    device: o.Device = "auto",
    dtype: o.Dtype = "float32",
    out: o.Out = Path("geodiff-eval"),
    quiet: o.Quiet = False,
) -> None:
    """Draw one figure as PNG, with its numbers as JSON beside it."""
    typed = locals()
    from geodiff_plugin._checks import bad_value
    from geodiff_plugin.evaluation.figures import FigureOptions, run_figure

    numbers = o.names(updates)
    if not all(number.isdecimal() for number in numbers):
        bad_value("updates", "whole numbers, comma-separated", repr(updates))
    run = o.pairs_options({key: value for key, value in typed.items() if key not in _OWN})
    path = run_figure(name, FigureOptions(run, largest, tuple(map(int, numbers)), clouds))
    if not quiet:
        typer.echo(path)


def add_figures(app: typer.Typer) -> None:
    """Add ``figure`` to ``geodiff eval``."""
    app.command("figure")(_figure)
