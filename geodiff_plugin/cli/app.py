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

from geodiff_plugin._lazy import imported, uncollected
from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions, start_pair, with_folder
from geodiff_plugin.jobs.telling import say, silent
from geodiff_plugin.options import (
    OUTPUT,
    SPACES,
    Command,
    PriorOptions,
    SpeedOptions,
    declare,
    help_of,
)

_out = partial(declare, panel=OUTPUT)


def _imported(where: str) -> Any:
    """As ``imported``, with threads as a command wants them."""
    # OpenMP's threads spin while they wait, which on a busy machine takes the core from the thread that they
    # wait for; asleep they cost one call in ten on an idle machine and save half of it on a busy one.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with uncollected():
        return imported(where)


def _later(where: str) -> Callable[[Any], None]:
    """Calls such a function with the values of the options by their names."""
    return lambda options: _imported(where)(**vars(options))


def _depth(options: DepthOptions) -> None:
    from geodiff_plugin.formats.recordings import is_bag
    from geodiff_plugin.jobs.pairs import is_many, start_many

    if not is_bag(options.left):
        names = ("topic_left", "topic_right", "tolerance", "encoding")
        options.refuse(names, "{} is for bags, and LEFT is none.")
    if is_bag(options.left):
        _imported("cli.run.run_bag")(options)
    elif is_many(options.left):
        options = replace(options, out=options.out or Path("geodiff-out"))
        refs = start_many(options, silent if options.quiet else say)
        to_parquet = options.engine == "ray" and options.layout != "folders"
        _imported("cli.run.run_parquet" if to_parquet else "cli.run.run_many")(options, refs)
    else:
        options.refuse(["steady"], "{} needs frames in order: folders, a list, videos or a bag.")
        options.refuse(["shard", "engine"], "{} is for many pairs: give folders, a list or videos.")
        options = with_folder(options, "geodiff-out")
        with start_pair(options) as folder:
            started = time.perf_counter()
            _imported("cli.run.run_depth")(options, folder, started)


def _capture(options: CaptureOptions) -> None:
    _imported("cli.run.run_capture")(options)


@dataclass(frozen=True, kw_only=True)
class _Demo:
    out: Path | None = _out(
        None, "Output folder (default: geodiff-demo, with a number if that exists).", "--out", "-o"
    )
    overwrite: bool = _out(False, "Write into a folder that holds files.")
    quiet: bool = _out(False, "Show no progress bar.", "--quiet", "-q")
    real: bool = declare(False, "Run on three pairs of a real stereo camera instead; no truth is known.")

    def run(self) -> None:
        bundled = Path(__file__).resolve().parents[1] / "bundled"
        options = self._options(bundled / "pair")
        if self.real:
            folders = sorted(path for path in (bundled / "real").iterdir() if path.is_dir())
            _imported("cli.demo.run_real_demo")([self._options(folder) for folder in folders], options.out)
        else:
            with start_pair(options) as folder:
                _imported("cli.demo.run_demo")(options, folder)

    def _options(self, pair: Path) -> DepthOptions:
        """What ``geodiff depth`` takes to run on such a folder."""
        left, right, calib = (pair / name for name in ("left.png", "right.png", "calib.txt"))
        options = DepthOptions(
            left=left,
            right=right,
            calib=(calib,),
            device="cpu",
            out=self.out,
            overwrite=self.overwrite,
            quiet=self.quiet,
        )
        return with_folder(options, "geodiff-demo")


@dataclass(frozen=True, kw_only=True)
class _Bench(SpeedOptions, PriorOptions):
    """What ``geodiff bench`` is told."""


@dataclass(frozen=True, kw_only=True)
class _Info:
    prior: str | None = declare(None, "Also describe this prior.")
    space: str | None = declare(
        None, "What its map is affine in, where its folder does not say.", choices=SPACES
    )
    knobs: bool = declare(False, "Instead list the knobs of the guidance, with default, range and meaning.")


@dataclass(frozen=True, kw_only=True)
class _Video:
    frames: tuple[Path, ...] = declare(
        MISSING, "Folders of geodiff depth, or depth maps as .npy, in order.", "", metavar="FRAME"
    )
    out: Path = _out(Path("depth.webp"), "The video: .mp4, .webp or .gif.", "--out", "-o")
    fps: float = declare(10.0, "Frames per second.")
    near: float | None = declare(
        None, "Near end of the colours, in metres (default: the nearest depth of the maps)."
    )
    far: float | None = declare(
        None, "Far end of the colours, in metres (default: the farthest depth of the maps)."
    )
    overwrite: bool = _out(False, "Replace an existing file.")


@dataclass(frozen=True, kw_only=True)
class _Submit:
    results: tuple[Path, ...] = declare(MISSING, "Folders that geodiff depth wrote.", "", metavar="RESULT")
    to: str = declare(MISSING, "Benchmark: middlebury or eth3d.", choices=("middlebury", "eth3d"))
    out: Path = _out(MISSING, "Output folder.", "--out", "-o")
    method: str = declare("GeoDiff", "Name of the method in the files of Middlebury.")


@dataclass(frozen=True, kw_only=True)
class _Merge:
    folder: Path = declare(MISSING, "Folder that geodiff depth --shard wrote to.", "", metavar="DIR")
    json: bool = _out(False, "Print the rows as JSON instead of the table.")


@dataclass(frozen=True, kw_only=True)
class _Page:
    prior: tuple[str, ...] = declare(
        ("bundled",), "Prior that visitors may choose; repeat it to offer several."
    )
    device: str = declare("auto", help_of("device"))
    host: str = declare("127.0.0.1", "Address to listen on; 0.0.0.0 lets other machines in.")
    port: int | None = declare(None, "Port (default: the first free one).", low=1, high=65535)
    browser: bool = declare(False, "Open the page in a browser.")


@dataclass(frozen=True, kw_only=True)
class _Convert:
    paths: tuple[Path, ...] = declare(
        MISSING,
        "SRC DST: a checkpoint (.ckpt, .pth) or a folder of .bin weights, and the new folder for --prior. Or "
        "marigold-v2 BASE CHECKPOINT DST: a folder of Qwen-Image-Edit-2509, the trainables.safetensors of "
        "Marigold V2, and the new folder.",
        "",
        metavar="PATH",
    )
    part: str | None = declare(
        None, "What SRC lacks: a file, folder or hub id (docs/reference/priors.md).", "--with"
    )
    space: str | None = declare(None, "What the map of marigold-v2 is affine in.", choices=SPACES)


COMMANDS = {
    "depth": Command(
        DepthOptions,
        _depth,
        "Metric depth of LEFT, guided by RIGHT: one pair, or many.\n\n"
        "For example: geodiff depth left.png right.png --calib calib.txt",
    ),
    "capture": Command(
        CaptureOptions, _capture, "Metric depth of the frames of a capture, and one point cloud."
    ),
    "demo": Command(_Demo, _Demo.run, "Run on the bundled pair, whose depth is known, or on real pairs."),
    "info": Command(_Info, _later("cli.info.run_info"), "Show versions, devices and priors."),
    "bench": Command(
        _Bench,
        lambda options: _imported("cli.demo.run_bench")(options),
        "Measure how much time guidance adds.",
    ),
    "video": Command(_Video, _later("cli.results.run_video"), "Join the depth maps of frames into a video."),
    "merge": Command(
        _Merge, _later("cli.results.run_merge"), "Join the tables that geodiff depth --shard wrote."
    ),
    "submit": Command(
        _Submit,
        _later("cli.results.run_submit"),
        "Write results in the form in which Middlebury or ETH3D takes them.",
    ),
    "app": Command(
        _Page, _later("app.launch.run_app"), "Serve the page that measures in the browser (extra 'app')."
    ),
    "convert": Command(
        _Convert, _later("cli.results.run_convert"), "Turn downloaded weights into a folder for --prior."
    ),
    "eval": Command(
        None,
        lambda _: _imported("cli.eval.eval_app"),
        "Evaluate this package and other methods on data sets.",
    ),
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
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            metavar="",
            help="Print the version and exit.",
        ),
    ] = False,
) -> None:
    pass


def main(argv: list[str] | None = None) -> None:
    """Run the command line on ``argv``, by default that of the process, and leave by ``SystemExit``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding lacks is no error
            stream.reconfigure(errors="backslashreplace")
    app(args=argv, prog_name="geodiff")
