"""Define the ``geodiff`` command and its subcommands, which import torch only when they run."""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Callable
from dataclasses import MISSING, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from geodiff_plugin._internal.lazy import fewer_imports, gc_frozen, imported
from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.jobs import (
    CaptureOptions,
    DepthOptions,
    LiveOptions,
    say,
    silent,
    start_pair,
    with_folder,
)
from geodiff_plugin.options import (
    DTYPES,
    OUTPUT,
    SPACES,
    Command,
    PriorOptions,
    ServerOptions,
    SpeedOptions,
)
from geodiff_plugin.settings import setting, settings_of

_out = partial(setting, section=OUTPUT)


def _imported(where: str) -> Any:
    """Import an object like ``imported``, with the thread settings of a command."""
    # Waiting OpenMP threads spin by default, which on a busy machine takes cores from the threads they wait
    # for. Passive waiting makes a call 10 % slower on an idle machine and twice as fast on a busy one.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with gc_frozen(), fewer_imports():
        return imported(where)


def _later(where: str) -> Callable[[Any], None]:
    """Create a command function that imports ``where`` and calls it with the options as keywords."""
    return lambda options: _imported(where)(**vars(options))


def _depth(options: DepthOptions) -> None:
    from geodiff_plugin.formats import is_bag
    from geodiff_plugin.jobs import is_many, start_many

    if not is_bag(options.left):
        names = ("left_topic", "right_topic", "tolerance", "encoding")
        options.raise_input_error(names, "{} needs a bag as LEFT.")
    if is_bag(options.left):
        _imported("cli.run.run_bag")(options)
    elif is_many(options.left):
        options = replace(options, out=options.out or Path("geodiff-out"))
        refs = start_many(options, silent if options.quiet else say)
        to_parquet = options.engine == "ray" and options.format != "folders"
        _imported("cli.run.run_parquet" if to_parquet else "cli.run.run_many")(options, refs)
    else:
        options.raise_input_error(
            ["temporal_smoothing"], "{} needs a sequence of frames: folders, a list, videos or a bag."
        )
        options.raise_input_error(["offset"], "{} applies to two videos.")
        options.raise_input_error(["shard", "engine"], "{} needs many pairs: pass folders, a list or videos.")
        options = with_folder(options, "geodiff-out")
        with start_pair(options) as folder:
            started = time.perf_counter()
            _imported("cli.run.run_depth")(options, folder, started)


def _live(options: LiveOptions) -> None:
    options.check_all()
    _imported("cli.live.run_live")(options)


def _capture(options: CaptureOptions) -> None:
    _imported("cli.run.run_capture")(options)


@dataclass(frozen=True, kw_only=True)
class _Demo:
    out: Path | None = _out(
        None, "Output folder (default: geodiff-demo, numbered if it exists).", "--out", "-o"
    )
    overwrite: bool = _out(False, "Write into a non-empty folder.")
    quiet: bool = _out(False, "Hide the progress bar.", "--quiet", "-q")
    real: bool = setting(False, "Run on three pairs from a real stereo camera, without ground truth.")

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
        """Return the options of ``geodiff depth`` for a bundled pair."""
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
    """Options of ``geodiff bench``."""


@dataclass(frozen=True, kw_only=True)
class _Info:
    prior: str | None = setting(None, "Also describe this prior.")
    space: str | None = setting(
        None,
        "Quantity that the prior predicts up to scale and shift (default: from its config).",
        choices=SPACES,
    )
    parameters: bool = setting(
        False, "Instead, list the guidance parameters with their defaults, ranges and meanings."
    )


@dataclass(frozen=True, kw_only=True)
class _Video:
    frames: tuple[Path, ...] = setting(
        MISSING, "Output folders of geodiff depth, or depth maps as .npy, in order.", "", metavar="FRAME"
    )
    out: Path = _out(Path("depth.webp"), "Output video: .mp4, .webp or .gif.", "--out", "-o")
    fps: float = setting(10.0, "Frames per second.")
    near: float | None = setting(
        None, "Nearest depth of the colour map, in metres (default: nearest depth of all maps)."
    )
    far: float | None = setting(
        None, "Farthest depth of the colour map, in metres (default: farthest depth of all maps)."
    )
    overwrite: bool = _out(False, "Replace an existing file.")


@dataclass(frozen=True, kw_only=True)
class _Submit:
    results: tuple[Path, ...] = setting(MISSING, "Output folders of geodiff depth.", "", metavar="RESULT")
    to: str = setting(MISSING, "Benchmark: middlebury or eth3d.", choices=("middlebury", "eth3d"))
    out: Path = _out(MISSING, "Output folder.", "--out", "-o")
    method: str = setting("GeoDiff", "Method name in Middlebury files.")


@dataclass(frozen=True, kw_only=True)
class _Merge:
    folder: Path = setting(MISSING, "Output folder of geodiff depth --shard.", "", metavar="DIR")
    json: bool = _out(False, "Print the rows as JSON instead of a table.")


@dataclass(frozen=True, kw_only=True)
class _Page(ServerOptions):
    prior: tuple[str, ...] = setting(("bundled",), "Prior to offer in the web app; repeatable.")
    device: str = setting("auto", settings_of(PriorOptions)["device"].help)
    dtype: str = setting("float32", settings_of(PriorOptions)["dtype"].help, choices=DTYPES)
    browser: bool = setting(False, "Open the web app in a browser.")


@dataclass(frozen=True, kw_only=True)
class _Convert:
    paths: tuple[Path, ...] = setting(
        MISSING,
        "SRC DST, where SRC is a checkpoint (.ckpt, .pth) or a folder with .bin weights, and DST is the "
        "folder to create for --prior. For Marigold V2: marigold-v2 BASE CHECKPOINT DST, where BASE is a "
        "Qwen-Image-Edit-2509 folder and CHECKPOINT is Marigold V2's trainables.safetensors.",
        "",
        metavar="PATH",
    )
    part: str | None = setting(
        None,
        "File, folder or Hugging Face model ID with the parts that are missing from SRC (see the priors page "
        "of the documentation).",
        "--with",
    )
    space: str | None = setting(
        None,
        "Quantity that marigold-v2 predicts up to scale and shift (default: from the checkpoint's folder "
        "name).",
        choices=SPACES,
    )


COMMANDS = {
    "depth": Command(
        DepthOptions,
        _depth,
        "Estimate metric depth for LEFT, guided by RIGHT, for one pair or many.\n\nFor example: geodiff "
        "depth left.png right.png --calib calib.txt",
    ),
    "capture": Command(
        CaptureOptions,
        _capture,
        "Estimate metric depth for all frames of a capture and fuse it into a point cloud (needs the extra "
        "'capture').",
    ),
    "live": Command(
        LiveOptions,
        _live,
        "Estimate metric depth from a stereo camera, a video or a stream, frame by frame.\n\n"
        "For example: geodiff live --source 0 --side-by-side --calib calib.txt",
    ),
    "demo": Command(_Demo, _Demo.run, "Run on the bundled pair with ground truth, or on real pairs."),
    "info": Command(_Info, _later("cli.info.run_info"), "Show versions, devices and priors."),
    "bench": Command(
        _Bench,
        lambda options: _imported("cli.demo.run_bench")(options),
        "Measure guidance overhead and throughput.",
    ),
    "video": Command(_Video, _later("cli.results.run_video"), "Create a video from depth maps."),
    "merge": Command(
        _Merge, _later("cli.results.run_merge"), "Merge the result tables written by geodiff depth --shard."
    ),
    "submit": Command(
        _Submit,
        _later("cli.results.run_submit"),
        "Export results for Middlebury or ETH3D submission.",
    ),
    "app": Command(_Page, _later("app.launch.run_app"), "Launch the web app (needs the extra 'app')."),
    "convert": Command(
        _Convert, _later("cli.results.run_convert"), "Convert downloaded weights into a folder for --prior."
    ),
    "eval": Command(
        None,
        lambda _: _imported("cli.eval.eval_app"),
        "Evaluate this package and other methods on datasets.",
    ),
}
ABOUT = "Metric depth from a monocular depth model and a second view, known depths or a moving camera."
app = click.version_option(package_name="geodiff-plugin", message="%(package)s %(version)s")(
    new_group(ABOUT, COMMANDS, outermost=True)
)


def main(argv: list[str] | None = None) -> None:
    """Run the command line on ``argv`` (default: ``sys.argv``) and raise ``SystemExit``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names outside the terminal's encoding are escaped
            stream.reconfigure(errors="backslashreplace")
    app.main(args=argv, prog_name="geodiff")
