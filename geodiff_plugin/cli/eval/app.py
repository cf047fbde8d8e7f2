"""The ``geodiff eval`` commands: options and their help.

Data flow: argv -> ``PairsOptions`` -> ``evaluation.commands`` -> its page, printed.
Paper: S5 (experiments).

Torch and diffusers are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.eval import options as o
from geodiff_plugin.cli.eval.figures import add_figures
from geodiff_plugin.cli.eval.poses import add_poses
from geodiff_plugin.cli.eval.sequence import add_sequence
from geodiff_plugin.cli.eval.strength import add_strength
from geodiff_plugin.cli.eval.tables import add_tables
from geodiff_plugin.cli.eval.trust import add_trust

__all__ = ["eval_app"]

eval_app = typer.Typer(
    help="Measure this package and its peers on data sets in their official layouts.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@eval_app.command("pairs")
@o.takes(
    *o.SAMPLES,
    *("sample", "pairs", "pixel_centre", "crop", "prior", *o.SETTINGS, "seeds", "pose", "perturb"),
    *("out", "results", "skip_broken", "save_depth", "quiet"),
)
def pairs(
    data: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of data sets, or synthetic:N.")],
    methods: Annotated[
        str | None, typer.Option(help="Comma-separated, see geodiff eval list; five of them by default.")
    ] = None,
    **shared: Any,
) -> None:
    """Measure methods side by side on every metric pair below DIR."""
    from geodiff_plugin.evaluation.commands import run_pairs
    from geodiff_plugin.evaluation.options import PAIRS_METHODS

    chosen = methods or ",".join(PAIRS_METHODS)
    o.run_and_print(run_pairs, o.pairs_options({"data": data, "methods": chosen, **shared}))


add_tables(eval_app)
add_strength(eval_app)
add_sequence(eval_app)
add_figures(eval_app)
add_trust(eval_app)
add_poses(eval_app)


@eval_app.command("list")
def list_(
    data: Annotated[Path | None, typer.Option(help="Folder to look into.")] = None,
) -> None:
    """Say for every data set whether it is there and how to obtain it, and list the methods."""
    from geodiff_plugin.cli.eval.listing import run_list

    run_list(data)
