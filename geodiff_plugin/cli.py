"""The ``geodiff`` command: every subcommand with its options and their help.

Hop: argv -> a function of ``geodiff_plugin.commands`` -> exit code 0, 2 (bad input) or 130 (Ctrl-C).
Paper: none.

Torch and diffusers are imported inside the commands, so that ``--help`` and ``--version`` answer at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.commands.voice import DoorGroup
from geodiff_plugin.evaluation.cli import eval_app

__all__ = ["app", "main"]

CAMERAS, RUN, OUTPUT = "Cameras", "Prior and run", "Output"

app = typer.Typer(
    cls=DoorGroup,
    help="Two photographs and their cameras to depth in metres, by any Marigold-style diffusion prior.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(eval_app, name="eval")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"geodiff-plugin {version('geodiff-plugin')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print it and exit.")
    ] = False,
) -> None:
    """Two photographs and their cameras to depth in metres, by any Marigold-style diffusion prior."""


def _option(help_text: str, panel: str, *names: str) -> Any:
    return typer.Option(*names, help=help_text, rich_help_panel=panel, show_default=True)


@app.command()
def depth(
    left: Annotated[
        Path, typer.Argument(metavar="LEFT", help="Left image; it gets the depth. EXIF turns are applied.")
    ],
    right: Annotated[Path, typer.Argument(metavar="RIGHT", help="Right image, of any size.")],
    calib: Annotated[
        list[Path] | None,
        _option(
            "Calibration file, format told by its content; twice for one file a view.", CAMERAS, "--calib"
        ),
    ] = None,
    cameras: Annotated[
        str | None, _option("Left and right camera of a KITTI file, as 2,3.", CAMERAS, "--cameras")
    ] = None,
    fx: Annotated[float | None, _option("Focal length, pixels.", CAMERAS, "--fx")] = None,
    fy: Annotated[float | None, _option("Focal length, pixels.", CAMERAS, "--fy")] = None,
    cx: Annotated[float | None, _option("Principal point, pixels.", CAMERAS, "--cx")] = None,
    cy: Annotated[float | None, _option("Principal point, pixels.", CAMERAS, "--cy")] = None,
    baseline: Annotated[
        float | None,
        _option("Distance of the cameras, metres; right one to the right.", CAMERAS, "--baseline"),
    ] = None,
    k: Annotated[Path | None, _option("3x3 intrinsics, text or .npy.", CAMERAS, "--K")] = None,
    e: Annotated[
        Path | None, _option("4x4 pose of the right camera in the left one's frame, metres.", CAMERAS, "--E")
    ] = None,
    k_right: Annotated[
        Path | None, _option("3x3 intrinsics of the right image, if they differ.", CAMERAS, "--K-right")
    ] = None,
    view: Annotated[
        list[Path] | None, _option("A further view, with --view-E; repeat both for each.", CAMERAS, "--view")
    ] = None,
    view_k: Annotated[
        list[Path] | None, _option("3x3 intrinsics of each --view; LEFT's if none.", CAMERAS, "--view-K")
    ] = None,
    view_e: Annotated[
        list[Path] | None,
        _option("4x4 pose of each --view in the left camera's frame, metres.", CAMERAS, "--view-E"),
    ] = None,
    prior: Annotated[
        str, _option("'bundled', a hub id or a folder; KEY:folder says which kind.", RUN, "--prior")
    ] = "bundled",
    space: Annotated[
        str | None,
        _option(
            "What the prior is affine in, if its folder does not tell: depth, disparity ...", RUN, "--space"
        ),
    ] = None,
    option: Annotated[
        list[str] | None,
        _option("What this prior alone takes, as NAME=VALUE (GeoWizard: domain=outdoor).", RUN, "--option"),
    ] = None,
    steps: Annotated[
        int | None, _option("Denoising steps; by default the prior's own, at least 4.", RUN, "--steps")
    ] = None,
    ensemble: Annotated[
        int, _option("Members; from 2 on their spread is written as uncertainty.", RUN, "--ensemble")
    ] = 1,
    resolution: Annotated[
        int | None,
        _option("Longer side for the prior, pixels; 0: as the image.", RUN, "--resolution"),
    ] = None,
    points: Annotated[
        Path | None,
        _option(
            "Known depths: map of LEFT (mm PNG, PFM, .npy) or N x 3 (.npy, text), metres.",
            RUN,
            "--points",
        ),
    ] = None,
    near: Annotated[float | None, _option("Nearest depth to search, metres.", RUN, "--near")] = None,
    far: Annotated[float | None, _option("Farthest depth to search, metres.", RUN, "--far")] = None,
    seed: Annotated[int, _option("Seed of the noise.", RUN, "--seed")] = 0,
    device: Annotated[str, _option("auto, cpu, cuda, cuda:N or mps.", RUN, "--device")] = "auto",
    dtype: Annotated[str, _option("float32, float16 or bfloat16.", RUN, "--dtype")] = "float32",
    preset: Annotated[
        str, _option("default, or paper (Algorithm 1 as printed).", RUN, "--preset")
    ] = "default",
    knob: Annotated[
        list[str] | None,
        _option("A knob of the guidance (docs/knobs.md), as inner_steps=0; repeatable.", RUN, "--knob"),
    ] = None,
    min_confidence: Annotated[
        float, _option("Points of the cloud have at least this, 0 to 1.", OUTPUT, "--min-confidence")
    ] = 0.0,
    out: Annotated[Path, _option("Folder for the results.", OUTPUT, "--out", "-o")] = Path("geodiff-out"),
    overwrite: Annotated[
        bool, _option("Write into a folder that holds files.", OUTPUT, "--overwrite")
    ] = False,
    quiet: Annotated[bool, _option("No progress bar, no summary.", OUTPUT, "--quiet", "-q")] = False,
    json: Annotated[bool, _option("Print the report instead of the summary.", OUTPUT, "--json")] = False,
) -> None:
    """Estimate the metric depth of LEFT with RIGHT as its guide."""
    typed = locals()
    from geodiff_plugin.commands.arguments import DepthArguments
    from geodiff_plugin.commands.depth import run_depth

    repeated = ("calib", "view", "view_k", "view_e", "option", "knob")
    run_depth(DepthArguments(**typed | {name: tuple(typed[name] or ()) for name in repeated}))


@app.command()
def demo(
    out: Annotated[Path, _option("Folder for the results.", OUTPUT, "--out", "-o")] = Path("geodiff-demo"),
    quiet: Annotated[bool, _option("No progress bar.", OUTPUT, "--quiet", "-q")] = False,
) -> None:
    """Run on a rendered pair that ships with the package, offline, and print how good it is."""
    from geodiff_plugin.commands.demo import run_demo

    run_demo(out, quiet)


@app.command()
def info(
    prior: Annotated[str | None, _option("Tell of this prior as well.", RUN, "--prior")] = None,
    space: Annotated[
        str | None, _option("What it is affine in, if its folder does not tell.", RUN, "--space")
    ] = None,
) -> None:
    """Print versions, devices, priors and what is cached."""
    from geodiff_plugin.commands.info import run_info

    run_info(prior, space)


@app.command()
def bench(
    full_size: Annotated[
        bool, _option("Marigold v1-1 with random weights, not the bundled prior.", RUN, "--full-size")
    ] = False,
    device: Annotated[str, _option("auto, cpu, cuda, cuda:N or mps.", RUN, "--device")] = "auto",
) -> None:
    """Measure what guidance costs: seconds and peak memory, guided / plain, for both gradients."""
    from geodiff_plugin.commands.bench import run_bench

    run_bench(full_size, device)


@app.command()
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="Checkpoint (.ckpt, .pth), or a folder of .bin weights.")
    ],
    target: Annotated[
        Path, typer.Argument(metavar="DST", help="Folder of safetensors to appear, for --prior.")
    ],
    part: Annotated[
        str | None,
        typer.Option("--with", help="What SRC lacks (docs/priors.md): a file, a folder or a hub id."),
    ] = None,
) -> None:
    """Convert weights that come pickled; only this command reads such files, and runs nothing in them."""
    from geodiff_plugin.commands.convert import run_convert

    run_convert(source, target, part)


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave by ``SystemExit``.

    Args:
        argv: arguments without the program's name; ``None`` for those of the process.
    """
    app(args=argv, prog_name="geodiff")
