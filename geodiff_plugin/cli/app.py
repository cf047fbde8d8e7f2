"""The ``geodiff`` command: its subcommands, which import torch when they run, and options of most of them."""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Callable
from dataclasses import MISSING, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions, start_pair, with_folder
from geodiff_plugin.jobs.telling import say, silent
from geodiff_plugin.options import OUTPUT, SPACES, Command, PriorOptions, declare, help_of, imported

_out = partial(declare, panel=OUTPUT)


def _imported(where: str) -> Any:
    """As ``imported``, with threads as a command wants them."""
    # OpenMP's threads spin while they wait, which on a busy machine takes the core from the thread that they
    # wait for; asleep they cost one call in ten on an idle machine and save half of it on a busy one.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return imported(where)


def _later(where: str) -> Callable[[Any], None]:
    """Calls such a function with the values of the options by their names."""
    return lambda options: _imported(where)(**vars(options))


def _depth(options: DepthOptions) -> None:
    from geodiff_plugin.formats.recordings import is_bag
    from geodiff_plugin.jobs.pairs import is_many, start_many

    if not is_bag(options.left):
        names = ("topic_left", "topic_right", "tolerance", "encoding")
        options.refuse(names, "left out where LEFT is not a bag", cure="It is for bags.")
    if is_bag(options.left):
        _imported("cli.run.run_bag")(options)
    elif is_many(options.left):
        options = replace(options, out=options.out or Path("geodiff-out"))
        refs = start_many(options, silent if options.quiet else say)
        _imported("cli.run.run_many")(options, refs)
    else:
        cure = "Give folders, a list, videos or a bag."
        options.refuse(["steady"], "given with several pairs in order", "one pair", cure)
        options = with_folder(options, "geodiff-out")
        with start_pair(options) as folder:
            started = time.perf_counter()
            _imported("cli.run.run_depth")(options, folder, started)


def _capture(options: CaptureOptions) -> None:
    _imported("cli.run.run_capture")(options)


@dataclass(frozen=True, kw_only=True)
class _Demo:
    out: Path | None = _out(None, "Folder; geodiff-demo, or -2 and so on where that is taken.", "--out", "-o")
    overwrite: bool = _out(False, "Write into a folder that holds files.")
    quiet: bool = _out(False, "No progress bar.", "--quiet", "-q")

    def run(self) -> None:
        pair = Path(__file__).resolve().parents[1] / "bundled" / "pair"
        left, right, calib = (pair / name for name in ("left.png", "right.png", "calib.txt"))
        options = DepthOptions(left=left, right=right, calib=(calib,), device="cpu", **vars(self))
        options = with_folder(options, "geodiff-demo")
        with start_pair(options) as folder:
            _imported("cli.demo.run_demo")(options, folder)


@dataclass(frozen=True, kw_only=True)
class _Info:
    prior: str | None = declare(None, "Describe this prior as well.")
    space: str | None = declare(None, "Space of its map, in place of what its folder says.", choices=SPACES)
    knobs: bool = declare(False, "List the knobs of the guidance instead: default, range, what each does.")


@dataclass(frozen=True, kw_only=True)
class _Video:
    frames: tuple[Path, ...] = declare(MISSING, "Results of geodiff depth, or maps.", "", metavar="FRAME...")
    out: Path = _out(Path("depth.webp"), "The video: .mp4 (OpenCV), .webp or .gif.", "--out", "-o")
    fps: float = declare(10.0, "Frames a second.")
    near: float | None = declare(None, "Depth of the last colour, metres.")
    far: float | None = declare(None, "Depth of the first colour, metres.")
    overwrite: bool = _out(False, "Replace a file of that name.")


@dataclass(frozen=True, kw_only=True)
class _Submit:
    results: tuple[Path, ...] = declare(MISSING, "Folders of geodiff depth.", "", metavar="RESULT...")
    to: str = declare(MISSING, "The benchmark: middlebury or eth3d.", choices=("middlebury", "eth3d"))
    out: Path = _out(MISSING, "Folder for its files.", "--out", "-o")
    method: str = declare("GeoDiff", "Name of the method in Middlebury's files.")


@dataclass(frozen=True, kw_only=True)
class _Page:
    prior: tuple[str, ...] = declare(("bundled",), "A prior that visitors may choose; repeatable.")
    device: str = declare("auto", help_of("device"))
    host: str = declare("127.0.0.1", "Address to listen on; 0.0.0.0 lets other machines in.")
    port: int | None = declare(None, "Port; by default the first free one.", low=1, high=65535)
    browser: bool = declare(False, "Open the page in a browser.")


@dataclass(frozen=True, kw_only=True)
class _Convert:
    paths: tuple[Path, ...] = declare(
        MISSING,
        "SRC: checkpoint (.ckpt, .pth) or a folder of .bin weights. BASE: Qwen-Image-Edit-2509; CHECKPOINT: "
        "its trainables.safetensors. DST: the folder to appear, for --prior.",
        "",
        metavar="SRC DST | marigold-v2 BASE CHECKPOINT DST",
    )
    part: str | None = declare(None, "File, folder or hub id of what SRC lacks (priors.md).", "--with")
    space: str | None = declare(None, "marigold-v2: space of its map.", choices=SPACES)


COMMANDS = {
    "depth": Command(DepthOptions, _depth, "Metric depth of LEFT guided by RIGHT; of one pair, or of many."),
    "capture": Command(CaptureOptions, _capture, "Depth of a capture's frames, and one cloud of all."),
    "demo": Command(_Demo, _Demo.run, "Run on a rendered pair of the package, and print how good it is."),
    "info": Command(_Info, _later("cli.info.run_info"), "Versions, devices, priors and what is cached."),
    "bench": Command(PriorOptions, _later("cli.demo.run_bench"), "What guidance costs in seconds."),
    "video": Command(_Video, _later("cli.results.run_video"), "Join depth maps of a sequence into a video."),
    "submit": Command(_Submit, _later("cli.results.run_submit"), "Write files for Middlebury and ETH3D."),
    "app": Command(_Page, _later("app.launch.run_app"), "Serve a web page to measure on (extra app)."),
    "convert": Command(_Convert, _later("cli.results.run_convert"), "Convert weights to a --prior folder."),
    "eval": Command(None, lambda _: _imported("cli.eval.eval_app"), "Measure it and others on data sets."),
}
ABOUT = "Depth in metres from two photographs and their cameras, with any Marigold-style diffusion prior."
app = new_group(ABOUT, COMMANDS, outermost=True)


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
    """Run the command line on ``argv``, by default that of the process, and leave by ``SystemExit``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding lacks is no error
            stream.reconfigure(errors="backslashreplace")
    app(args=argv, prog_name="geodiff")
