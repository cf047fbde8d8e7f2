"""The ``geodiff`` command: its subcommands, with the options of those that have few.

Torch and diffusers are imported inside the commands, so that ``--help`` and ``--version`` answer at once.
"""

from __future__ import annotations

import dataclasses
import io
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from geodiff_plugin._checks import InputError
from geodiff_plugin.capture.options import CaptureOptions
from geodiff_plugin.cli.commands import add_command
from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.cli.options import DepthOptions, demo_options, start_pair
from geodiff_plugin.cli.terminal import EXIT_BAD_INPUT, EXIT_INTERRUPTED, StopWatch, say
from geodiff_plugin.options import OUTPUT, RUN

__all__ = ["app", "main", "new_group"]


class CommandGroup(TyperGroup):
    """A group of subcommands: bad input is one line and exit code 2, Ctrl-C is exit code 130."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen subcommand."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            say("geodiff: interrupted; the same command resumes")
            sys.exit(EXIT_INTERRUPTED)
        except InputError as error:  # any other is a defect, and keeps its traceback
            say(f"geodiff: {error}")
            sys.exit(EXIT_BAD_INPUT)


def new_group(help_text: str) -> typer.Typer:
    """A group whose commands are added by ``add_command``."""
    return typer.Typer(
        cls=CommandGroup,
        help=help_text,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def _out_folder(typed: Path | None, default: str, overwrite: bool) -> Path:
    """The folder that was named, else the default, with a number where it is taken."""
    from geodiff_plugin.formats.out import free_folder

    if typed is not None:
        return typed
    return Path(default) if overwrite else free_folder(Path(default))


def prepare_torch(quiet: bool) -> None:
    """What is to be settled before torch is imported, and said while that takes its seconds.

    OpenMP's threads spin while they wait, which on a busy machine takes the core from the thread that they
    wait for; asleep they cost one call in ten on an idle machine and save half of it on a busy one.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if not quiet and "torch" not in sys.modules and sys.stderr.isatty():
        sys.stderr.write("loading torch and diffusers ...\r")
        sys.stderr.flush()


app = new_group(
    "Depth in metres from two photographs and their cameras, with any Marigold-style diffusion prior."
)

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.", rich_help_panel=OUTPUT)]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:N or mps.", rich_help_panel=RUN)]


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
    pass


def _run_depth(options: DepthOptions) -> None:
    from geodiff_plugin.cli.pairs import is_many, start_many
    from geodiff_plugin.formats.bags import is_bag

    if is_bag(options.left):
        prepare_torch(options.quiet)
        from geodiff_plugin.cli.bag import run_bag

        run_bag(options)
        return
    names = ("topic_left", "topic_right")
    options.refuse(names, "left out where LEFT is no bag", "given", "Images are LEFT and RIGHT.")
    if is_many(options.left):
        options = dataclasses.replace(options, out=options.out or Path("geodiff-out"))
        refs = start_many(options)
        prepare_torch(options.quiet)
        from geodiff_plugin.cli.many import run_many

        run_many(options, refs)
        return
    out = _out_folder(options.out, "geodiff-out", options.overwrite)
    options = dataclasses.replace(options, out=out)
    watch = StopWatch()
    with start_pair(options) as folder:
        with watch.stage("start"):
            prepare_torch(options.quiet)
            from geodiff_plugin.cli.depth import run_depth

        run_depth(options, folder, watch)


add_command(
    app,
    "depth",
    DepthOptions,
    _run_depth,
    "Estimate the metric depth of LEFT with RIGHT as its guide; of one pair, or of many.",
)


def _run_capture(options: CaptureOptions) -> None:
    prepare_torch(options.quiet)
    from geodiff_plugin.cli.capture import run_and_report

    run_and_report(options)


add_command(
    app,
    "capture",
    CaptureOptions,
    _run_capture,
    "Depth of every frame of a capture, with poses solved together, and one cloud of all.",
)


@app.command()
def demo(
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Folder for the results; geodiff-demo, or -2 and so on where taken."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that holds files.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Run on a rendered pair that ships with the package, offline, and print how good it is."""
    options = demo_options(_out_folder(out, "geodiff-demo", overwrite), overwrite, quiet)
    with start_pair(options) as folder:
        prepare_torch(quiet)
        from geodiff_plugin.cli.demo import run_demo

        run_demo(options, folder)


@app.command()
def info(
    prior: Annotated[str | None, typer.Option(help="Describe this prior as well.")] = None,
    space: Annotated[
        str | None, typer.Option(help="Space in which its map is affine, if its folder does not say.")
    ] = None,
    knobs: Annotated[
        bool,
        typer.Option(
            "--knobs", help="List the knobs of the guidance instead: default, range, what each does."
        ),
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
def bench(device: Device = "auto") -> None:
    """Measure what guidance costs, in seconds and peak memory, and where the seconds of a command go."""
    prepare_torch(True)
    from geodiff_plugin.cli.bench import run_bench

    run_bench(device)


@app.command()
def video(
    frames: Annotated[
        list[Path],
        typer.Argument(metavar="FRAME...", help="Folders of geodiff depth, or .npy maps, in order."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The video: .mp4 (OpenCV), .webp or .gif.")] = Path(
        "depth.webp"
    ),
    fps: Annotated[float, typer.Option(help="Frames a second.")] = 10.0,
    near: Annotated[float | None, typer.Option(help="Depth of the last colour, metres.")] = None,
    far: Annotated[float | None, typer.Option(help="Depth of the first colour, metres.")] = None,
    photographs: Annotated[
        bool, typer.Option("--photographs", help="Show the left images beside the depth.")
    ] = False,
) -> None:
    """Join the depth maps of a sequence into a video, in one range of colours."""
    from geodiff_plugin.cli.video import run_video

    run_video(frames, out, fps, near, far, photographs)


@app.command()
def submit(
    results: Annotated[list[Path], typer.Argument(metavar="RESULT...", help="Folders of geodiff depth.")],
    to: Annotated[str, typer.Option(help="The benchmark: middlebury or eth3d.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for its files.")],
    method: Annotated[str, typer.Option(help="Name of the method in Middlebury's files.")] = "GeoDiff",
) -> None:
    """Write disparities and times as the benchmarks of Middlebury and ETH3D take them."""
    from geodiff_plugin.cli.submit import run_submit

    run_submit(results, to, out, method)


@app.command("app")
def page(
    prior: Annotated[
        list[str] | None, typer.Option(help="A prior that visitors may choose; repeatable.")
    ] = None,
    device: Device = "auto",
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    port: Annotated[int | None, typer.Option(help="Port; by default the first free one.")] = None,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in a browser.")] = False,
) -> None:
    """Serve a web page: drop two photographs and measure in their depth (needs the extra app)."""
    prepare_torch(False)
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
            help="marigold-v2: space of its map, if the name of CHECKPOINT's folder does not say it."
        ),
    ] = None,
) -> None:
    """Convert pickled or split weights to a folder for --prior; no code in a pickle is run."""
    from geodiff_plugin.cli.convert import run_convert

    run_convert(paths, part, space)


app.add_typer(eval_app, name="eval")


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave by ``SystemExit``.

    Args:
        argv: arguments without the program's name; ``None`` for those of the process.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding lacks is no error
            stream.reconfigure(errors="backslashreplace")
    app(args=argv, prog_name="geodiff")
