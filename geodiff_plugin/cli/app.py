"""The ``geodiff`` command: its subcommands, with the options of those that have few.

Torch and diffusers are imported inside the commands, so that ``--help`` and ``--version`` answer at once.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.capture.options import CaptureOptions
from geodiff_plugin.cli.commands import Command, new_group
from geodiff_plugin.cli.options import DepthOptions, start_pair
from geodiff_plugin.cli.terminal import StopWatch
from geodiff_plugin.formats.out import free_folder
from geodiff_plugin.options import OUTPUT, check_options, declare, help_of


def prepare_torch(quiet: bool) -> None:
    """What is to be settled before torch is imported, and said while that takes its seconds.

    OpenMP's threads spin while they wait, which on a busy machine takes the core from the thread that they
    wait for; asleep they cost one call in ten on an idle machine and save half of it on a busy one.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if not quiet and "torch" not in sys.modules and sys.stderr.isatty():
        sys.stderr.write("loading torch and diffusers ...\r")
        sys.stderr.flush()


def _with_folder(options: DepthOptions, default: str) -> DepthOptions:
    """With the folder that was named, else the default, with a number where that is taken."""
    if options.out is not None:
        return options
    return replace(options, out=Path(default) if options.overwrite else free_folder(Path(default)))


def _depth(options: DepthOptions) -> None:
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
        options = replace(options, out=options.out or Path("geodiff-out"))
        refs = start_many(options)
        prepare_torch(options.quiet)
        from geodiff_plugin.cli.many import run_many

        run_many(options, refs)
        return
    options, watch = _with_folder(options, "geodiff-out"), StopWatch()
    with start_pair(options) as folder:
        with watch.stage("start"):
            prepare_torch(options.quiet)
            from geodiff_plugin.cli.depth import run_depth

        run_depth(options, folder, watch)


def _capture(options: CaptureOptions) -> None:
    prepare_torch(options.quiet)
    from geodiff_plugin.cli.capture import run_and_report

    run_and_report(options)


@dataclass(frozen=True, kw_only=True)
class _Demo:
    out: Path | None = declare(
        None, "Folder; geodiff-demo, or -2 and so on where that is taken.", "--out", "-o", panel=OUTPUT
    )
    overwrite: bool = declare(False, "Write into a folder that holds files.", panel=OUTPUT)
    quiet: bool = declare(False, "No progress bar.", "--quiet", "-q", panel=OUTPUT)

    def run(self) -> None:
        pair = Path(__file__).resolve().parents[1] / "bundled" / "pair"
        files: dict[str, Any] = {
            "left": pair / "left.png",
            "right": pair / "right.png",
            "calib": (pair / "calib.txt",),
        }
        options = _with_folder(DepthOptions(**files, device="cpu", **vars(self)), "geodiff-demo")
        with start_pair(options) as folder:
            prepare_torch(options.quiet)
            from geodiff_plugin.cli.demo import run_demo

            run_demo(options, folder)


@dataclass(frozen=True, kw_only=True)
class _Info:
    prior: str | None = declare(None, "Describe this prior as well.")
    space: str | None = declare(None, "Space in which its map is affine, if its folder does not say.")
    knobs: bool = declare(False, "List the knobs of the guidance instead: default, range, what each does.")

    def run(self) -> None:
        if self.knobs:
            from geodiff_plugin.config import knob_lines

            typer.echo("\n".join(knob_lines()))
            return
        from geodiff_plugin.cli.info import run_info

        run_info(self.prior, self.space)


@dataclass(frozen=True, kw_only=True)
class _Bench:
    device: str = declare("auto", help_of("device"))

    def run(self) -> None:
        prepare_torch(True)
        from geodiff_plugin.cli.bench import run_bench

        run_bench(self.device)


@dataclass(frozen=True, kw_only=True)
class _Video:
    frames: tuple[Path, ...] = declare(
        MISSING, "Folders of geodiff depth, or .npy maps, in order.", "", metavar="FRAME..."
    )
    out: Path = declare(
        Path("depth.webp"), "The video: .mp4 (OpenCV), .webp or .gif.", "--out", "-o", panel=OUTPUT
    )
    fps: float = declare(10.0, "Frames a second.")
    near: float | None = declare(None, "Depth of the last colour, metres.")
    far: float | None = declare(None, "Depth of the first colour, metres.")
    photographs: bool = declare(False, "Show the left images beside the depth.")

    def run(self) -> None:
        from geodiff_plugin.cli.video import run_video

        run_video(**vars(self))


@dataclass(frozen=True, kw_only=True)
class _Submit:
    results: tuple[Path, ...] = declare(MISSING, "Folders of geodiff depth.", "", metavar="RESULT...")
    to: str = declare(MISSING, "The benchmark: middlebury or eth3d.")
    out: Path = declare(MISSING, "Folder for its files.", "--out", "-o", panel=OUTPUT)
    method: str = declare("GeoDiff", "Name of the method in Middlebury's files.")

    def run(self) -> None:
        from geodiff_plugin.cli.submit import run_submit

        run_submit(self.results, self.to, self.out, self.method)


@dataclass(frozen=True, kw_only=True)
class _Page:
    prior: tuple[str, ...] = declare((), "A prior that visitors may choose; repeatable.")
    device: str = declare("auto", help_of("device"))
    host: str = declare("127.0.0.1", "Address to listen on; 0.0.0.0 lets other machines in.")
    port: int | None = declare(None, "Port; by default the first free one.", low=1, high=65535)
    browser: bool = declare(False, "Open the page in a browser.")

    def run(self) -> None:
        check_options(self)
        prepare_torch(False)
        from geodiff_plugin.app.launch import run_app

        run_app(self.prior or ("bundled",), self.device, self.host, self.port, self.browser)


@dataclass(frozen=True, kw_only=True)
class _Convert:
    paths: tuple[Path, ...] = declare(
        MISSING,
        "SRC: checkpoint (.ckpt, .pth) or a folder of .bin weights. BASE: Qwen-Image-Edit-2509; CHECKPOINT: "
        "its trainables.safetensors. DST: the folder to appear, for --prior.",
        "",
        metavar="SRC DST | marigold-v2 BASE CHECKPOINT DST",
    )
    part: str | None = declare(
        None, "What is not in SRC (docs/reference/priors.md): a file, a folder or a hub id.", "--with"
    )
    space: str | None = declare(None, "marigold-v2: space of its map, if CHECKPOINT's folder does not say.")

    def run(self) -> None:
        from geodiff_plugin.cli.convert import run_convert

        run_convert(self.paths, self.part, self.space)


def _eval(_: None) -> typer.Typer:
    from geodiff_plugin.cli.eval import eval_app

    return eval_app


COMMANDS: dict[str, tuple[type | None, Callable[[Any], Any], str]] = {
    "depth": (DepthOptions, _depth, "Metric depth of LEFT with RIGHT as its guide; of one pair, or of many."),
    "capture": (
        CaptureOptions,
        _capture,
        "Depth of every frame of a capture, with poses solved together, and one cloud of all.",
    ),
    "demo": (
        _Demo,
        _Demo.run,
        "Run on a rendered pair of the package's own, and print how good it is.",
    ),
    "info": (_Info, _Info.run, "Print versions, devices, priors and what is cached."),
    "bench": (_Bench, _Bench.run, "What guidance costs in seconds and memory, and a command's seconds."),
    "video": (_Video, _Video.run, "Join the depth maps of a sequence into a video, in one range of colours."),
    "submit": (
        _Submit,
        _Submit.run,
        "Write disparities and times as Middlebury and ETH3D take them.",
    ),
    "app": (_Page, _Page.run, "Serve a web page: drop two photographs, and measure (needs the extra app)."),
    "convert": (
        _Convert,
        _Convert.run,
        "Convert pickled or split weights to a folder for --prior.",
    ),
    "eval": (None, _eval, "Measure this package and its peers on data sets in their official layouts."),
}
app = new_group(
    "Depth in metres from two photographs and their cameras, with any Marigold-style diffusion prior.",
    {name: Command(*command) for name, command in COMMANDS.items()},
    outermost=True,
)


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


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave by ``SystemExit``.

    Args:
        argv: arguments without the program's name; ``None`` for those of the process.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding lacks is no error
            stream.reconfigure(errors="backslashreplace")
    app(args=argv, prog_name="geodiff")
