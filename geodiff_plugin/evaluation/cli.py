"""The ``geodiff eval`` commands: options and their help.

Hop: argv -> ``PairsOptions`` -> ``evaluation.commands``.
Paper: S5 (experiments).

Torch and diffusers are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["eval_app"]

eval_app = typer.Typer(
    help="Measure this package and its peers on data sets in their official layouts.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())


@eval_app.command("pairs")
def pairs(
    data: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with one or several data sets.")],
    methods: Annotated[
        str | None, typer.Option(help="Comma-separated, see geodiff eval list; five of them by default.")
    ] = None,
    datasets: Annotated[
        str | None, typer.Option(help="Comma-separated; all that DIR has by default.")
    ] = None,
    scenes: Annotated[str | None, typer.Option(help="Comma-separated parts of sample names to keep.")] = None,
    limit: Annotated[int | None, typer.Option(help="At most so many samples.")] = None,
    sample: Annotated[int | None, typer.Option(help="Draw so many samples with the seed.")] = None,
    view_pairs: Annotated[
        str, typer.Option("--pairs", help="Of a group of posed views: default (the first two) or all.")
    ] = "default",
    pixel_centre: Annotated[
        float, typer.Option(help="First pixel's centre in posed cameras; 0.5 for COLMAP's.")
    ] = 0.0,
    prior: Annotated[str, typer.Option(help="'bundled', a hub id or a folder.")] = "bundled",
    ensemble: Annotated[int, typer.Option(help="Ensemble members.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    steps: Annotated[int | None, typer.Option(help="Denoising steps; the prior's own by default.")] = None,
    resolution: Annotated[int | None, typer.Option(help="Longer side for the prior, pixels.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda or mps.")] = "cpu",
    dtype: Annotated[str, typer.Option(help="float32, bfloat16 or float16.")] = "float32",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Records and tables; resumed where it exists.")
    ] = Path("geodiff-eval"),
    results: Annotated[Path | None, typer.Option(help="Write the Markdown page here as well.")] = None,
    skip_broken: Annotated[
        bool, typer.Option("--skip-broken", help="Go on after a broken sample and count it.")
    ] = False,
    save_depth: Annotated[bool, typer.Option("--save-depth", help="Write every depth map as .npy.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No bar and no table on the screen.")] = False,
) -> None:
    """Measure methods side by side on every metric pair below DIR."""
    from geodiff_plugin.evaluation.baselines import Settings
    from geodiff_plugin.evaluation.commands import PAIRS_METHODS, PairsOptions, run_pairs

    settings = Settings(prior, ensemble, seed, steps, resolution, device, dtype)
    chosen = _names(methods) or PAIRS_METHODS
    run_pairs(
        PairsOptions(
            data=data,
            methods=chosen,
            datasets=_names(datasets),
            scenes=_names(scenes),
            limit=limit,
            sample=sample,
            pairs=view_pairs,
            pixel_centre=pixel_centre,
            settings=settings,
            out=out,
            results=results,
            skip_broken=skip_broken,
            save_depth=save_depth,
            quiet=quiet,
        )
    )


@eval_app.command("list")
def list_(
    data: Annotated[Path | None, typer.Option(help="Folder to look into.")] = None,
) -> None:
    """Say for every data set whether it is there and how to obtain it, and list the methods."""
    from geodiff_plugin.evaluation.commands import run_list

    run_list(data)
