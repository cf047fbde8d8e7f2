"""The ``geodiff`` command: its subcommands, with their options and help where these are few.

Data flow: argv -> a function of ``geodiff_plugin.cli`` -> exit code 0, 2 (bad input) or 130 (Ctrl-C).
Paper: none.

Torch and diffusers are imported inside the commands, so that ``--help`` and ``--version`` answer at once.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Annotated

import typer

from geodiff_plugin.cli.capture import add_capture
from geodiff_plugin.cli.depth_options import add_depth
from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.cli.messages import CommandGroup
from geodiff_plugin.cli.options import OUT, OUTPUT, RUN, Device, Overwrite, option, out_folder

__all__ = ["app", "main"]

app = typer.Typer(
    cls=CommandGroup,
    help="Depth in metres from two photographs and their cameras, with any Marigold-style diffusion prior.",
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
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Depth in metres from two photographs and their cameras, with any Marigold-style diffusion prior."""


add_depth(app)
add_capture(app)


@app.command()
def demo(
    out: Annotated[
        Path | None,
        option("Folder for the results; geodiff-demo, or -2 and so on where it is taken.", OUTPUT, *OUT),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, option("No progress bar.", OUTPUT, "--quiet", "-q")] = False,
) -> None:
    """Run on a rendered pair that ships with the package, offline, and print how good it is."""
    from geodiff_plugin.cli.arguments import demo_arguments
    from geodiff_plugin.cli.start import start_run

    arguments = demo_arguments(out_folder(out, "geodiff-demo", overwrite), overwrite, quiet)
    with start_run(arguments) as held:
        from geodiff_plugin.cli.demo import run_demo

        run_demo(arguments, held)


@app.command()
def info(
    prior: Annotated[str | None, option("Describe this prior as well.", RUN, "--prior")] = None,
    space: Annotated[
        str | None, option("Space in which its map is affine, if its folder does not say.", RUN, "--space")
    ] = None,
    knobs: Annotated[
        bool,
        option("List the knobs of the guidance instead: default, range, what each does.", RUN, "--knobs"),
    ] = False,
) -> None:
    """Print versions, devices, priors and what is cached."""
    if knobs:
        from geodiff_plugin.config import knob_lines

        typer.echo("\n".join(knob_lines()))
        return
    from geodiff_plugin.cli.info import run_info

    run_info(prior, space)


@app.command()
def bench(
    points: Annotated[
        int | None,
        option(
            "Complete depth from this many known points instead, guided and by a fitted LoRA.",
            RUN,
            "--points",
        ),
    ] = None,
    prior: Annotated[
        str | None, option("With --points: a Marigold V2; by default a tiny random one.", RUN, "--prior")
    ] = None,
    device: Device = "auto",
) -> None:
    """Measure what guidance costs: seconds and peak memory against the plain pipeline, for both gradients."""
    if points is not None:
        from geodiff_plugin.cli.bench_points import run_bench_points

        run_bench_points(points, prior, device)
        return
    from geodiff_plugin._checks import bad_value
    from geodiff_plugin.cli.bench import run_bench

    if prior is not None:
        bad_value("--prior", "given together with --points", "alone")
    run_bench(device)


@app.command()
def video(
    frames: Annotated[
        list[Path],
        typer.Argument(metavar="FRAME...", help="Folders of geodiff depth, or .npy maps, in order."),
    ],
    out: Annotated[Path, option("The video: .mp4 (OpenCV), .webp or .gif.", OUTPUT, "--out", "-o")] = Path(
        "depth.webp"
    ),
    fps: Annotated[float, option("Frames a second.", OUTPUT, "--fps")] = 10.0,
    near: Annotated[float | None, option("Depth of the last colour, metres.", OUTPUT, "--near")] = None,
    far: Annotated[float | None, option("Depth of the first colour, metres.", OUTPUT, "--far")] = None,
    photographs: Annotated[
        bool, option("Show the left images beside the depth.", OUTPUT, "--photographs")
    ] = False,
) -> None:
    """Join the depth maps of a sequence into a video, in one range of colours."""
    from geodiff_plugin.cli.video import run_video

    run_video(frames, out, fps, near, far, photographs)


@app.command("app")
def page(
    prior: Annotated[
        list[str] | None, option("A prior that visitors may choose; repeatable.", RUN, "--prior")
    ] = None,
    device: Device = "auto",
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    port: Annotated[int | None, typer.Option("--port", help="Port; by default the first free one.")] = None,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in a browser.")] = False,
) -> None:
    """Serve a web page: drop two photographs and measure in their depth (needs the extra app)."""
    from geodiff_plugin.app.launch import run_app

    run_app(tuple(prior or ("bundled",)), device, host, port, browser)


@app.command()
def convert(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="SRC DST | marigold-v2 BASE CHECKPOINT DST",
            help="SRC: checkpoint (.ckpt, .pth) or a folder of .bin weights. BASE: Qwen-Image-Edit-2509; "
            "CHECKPOINT: its trainables.safetensors. DST: the folder to appear, for --prior.",
        ),
    ],
    part: Annotated[
        str | None,
        typer.Option(
            "--with",
            help="The part that is not in SRC (docs/reference/priors.md): a file, a folder or a hub id.",
        ),
    ] = None,
    space: Annotated[
        str | None,
        typer.Option(
            "--space",
            help="marigold-v2: space of its map, if the name of CHECKPOINT's folder does not say it.",
        ),
    ] = None,
    lora: Annotated[
        str | None,
        typer.Option("--lora", help="marigold-v2: merged (default), apart (peft), or 4bit (CUDA)."),
    ] = None,
) -> None:
    """Convert pickled or split weights to a folder for --prior; no code in a pickle is run."""
    from geodiff_plugin.cli.convert import run_convert

    run_convert(paths, part, space, lora)


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave by ``SystemExit``.

    Args:
        argv: arguments without the program's name; ``None`` for those of the process.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding lacks is no error
            stream.reconfigure(errors="backslashreplace")
    app(args=argv, prog_name="geodiff")
