"""``geodiff eval strength``: options and their help.

Data flow: argv -> ``StrengthOptions`` -> ``evaluation.strength`` -> its page, printed.
Paper: none.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.eval import options as o

__all__ = ["add_strength"]


@o.takes("out", "results", "quiet")
def strength(
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of data sets, or synthetic:N; may be repeated."),
    ] = None,
    strengths: Annotated[
        str | None,
        typer.Option(help="Comma-separated: exact, 2%, 5%, 10%, 20%, blur, gamma."),
    ] = None,
    space: Annotated[str, typer.Option(help="Affine in disparity, depth or log.")] = "disparity",
    follow: Annotated[
        float, typer.Option(help="How far the prior's later answers follow their input, 0 to 1.")
    ] = 0.3,
    methods: Annotated[
        str | None, typer.Option(help="Comma-separated methods that use a prior, see geodiff eval list.")
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Denoising steps.")] = 4,
    resolution: Annotated[int, typer.Option(min=64, help="Longer side for the prior, px.")] = 384,
    seed: Annotated[int, typer.Option(help="Of the noise, and of the prior's error.")] = 0,
    limit: Annotated[int | None, typer.Option(min=1, help="At most this many pairs of each --data.")] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="PNG: error against the prior's error, and lit surfaces."),
    ] = None,
    **shared: Any,
) -> None:
    """Accuracy with emulated priors from exact to weak: aligned to the truth, fitted once, and guided."""
    from geodiff_plugin.cli.eval.printing import print_page
    from geodiff_plugin.evaluation.emulated import STRENGTHS
    from geodiff_plugin.evaluation.strength import METHODS, StrengthOptions, run_strength

    options = StrengthOptions(
        data=tuple(data or [Path("synthetic:4")]),
        command=shlex.join(["geodiff", *sys.argv[1:]]),
        strengths=tuple(STRENGTHS) if strengths is None else o.names(strengths),
        space=space,
        follow=follow,
        methods=METHODS if methods is None else o.names(methods),
        steps=steps,
        resolution=resolution,
        seed=seed,
        limit=limit,
        figure=figure,
        **shared,
    )
    page = run_strength(options)
    if not options.quiet:
        print_page(page)


def add_strength(app: typer.Typer) -> None:
    """Add the command to ``geodiff eval``."""
    app.command("strength")(strength)
