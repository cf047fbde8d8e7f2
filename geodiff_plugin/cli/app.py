"""The ``geodiff`` command: every subcommand with its options and their help.

Hop: argv -> a function of ``geodiff_plugin.cli`` -> exit code 0, 2 (bad input) or 130 (Ctrl-C).
Paper: none.

Torch and diffusers are imported inside the commands, so that ``--help`` and ``--version`` answer at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.cli.voice import DoorGroup

__all__ = ["app", "main"]

CAMERAS, RUN, OUTPUT = "Cameras", "Prior and run", "Output"
OUT = ("--out", "-o")

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
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Two photographs and their cameras to depth in metres, by any Marigold-style diffusion prior."""


def _option(help_text: str, panel: str, *names: str) -> Any:
    return typer.Option(*names, help=help_text, rich_help_panel=panel, show_default=True)


def _folder(typed: Path | None, default: str, overwrite: bool) -> Path:
    """The folder that was named, else the default, with a number where it is taken."""
    from geodiff_plugin.formats.out_folder import free_folder

    if typed is not None:
        return typed
    return Path(default) if overwrite else free_folder(Path(default))


@app.command()
def depth(
    left: Annotated[
        Path, typer.Argument(metavar="LEFT", help="Left image; it gets the depth. EXIF turns are applied.")
    ],
    right: Annotated[
        Path | None,
        typer.Argument(metavar="RIGHT", help="Right image, of any size; not needed with --points."),
    ] = None,
    calib: Annotated[
        list[Path] | None,
        _option(
            "Calibration file in any known format, or COLMAP folder; twice if each view has its own.",
            CAMERAS,
            "--calib",
        ),
    ] = None,
    cameras: Annotated[
        str | None, _option("Left and right camera of a file of many, as 2,3.", CAMERAS, "--cameras")
    ] = None,
    fx: Annotated[float | None, _option("Focal length, pixels.", CAMERAS, "--fx")] = None,
    fy: Annotated[float | None, _option("Focal length, pixels.", CAMERAS, "--fy")] = None,
    cx: Annotated[float | None, _option("Principal point, pixels.", CAMERAS, "--cx")] = None,
    cy: Annotated[float | None, _option("Principal point, pixels.", CAMERAS, "--cy")] = None,
    baseline: Annotated[
        float | None,
        _option(
            "Distance of the cameras, metres, right one to the right; also scales --calib.",
            CAMERAS,
            "--baseline",
        ),
    ] = None,
    k: Annotated[Path | None, _option("3x3 intrinsics, text or .npy.", CAMERAS, "--K")] = None,
    e: Annotated[
        Path | None, _option("4x4 pose of the right camera in the left one's frame, metres.", CAMERAS, "--E")
    ] = None,
    k_right: Annotated[
        Path | None, _option("3x3 intrinsics of the right image, if they differ.", CAMERAS, "--K-right")
    ] = None,
    distortion: Annotated[
        list[str] | None,
        _option(
            "Lens: k1,k2,p1,p2[,k3...] or fisheye:k1,k2,k3,k4; twice for two lenses.", CAMERAS, "--distortion"
        ),
    ] = None,
    estimate_pose: Annotated[
        bool,
        _option(
            "Find the cameras' poses from the photographs (needs the extra pose).", CAMERAS, "--estimate-pose"
        ),
    ] = False,
    fov: Annotated[
        float | None,
        _option("Horizontal field of view, degrees, where EXIF tells no focal length.", CAMERAS, "--fov"),
    ] = None,
    known_length: Annotated[
        str | None,
        _option(
            "Distance of two pixels of LEFT, X1,Y1,X2,Y2,METRES, for --baseline.", CAMERAS, "--known-length"
        ),
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
            "Space in which the prior's map is affine, if its folder does not say: depth, disparity ...",
            RUN,
            "--space",
        ),
    ] = None,
    option: Annotated[
        list[str] | None,
        _option(
            "An option that only this prior has, as NAME=VALUE (GeoWizard: domain=outdoor).", RUN, "--option"
        ),
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
            "Known depths: a map of LEFT (PNG, PFM, .npy) or points (.npy, text, .ply, .bin).",
            RUN,
            "--points",
        ),
    ] = None,
    points_scale: Annotated[
        float | None,
        _option("Units of that file in a metre: 1000 for mm, 256 for KITTI's PNG.", RUN, "--points-scale"),
    ] = None,
    points_calib: Annotated[
        list[Path] | None,
        _option("KITTI's lidar calibration, for a .bin; twice for one of two files.", RUN, "--points-calib"),
    ] = None,
    cropped: Annotated[
        bool, _option("The principal point may lie outside: the images are crops.", CAMERAS, "--cropped")
    ] = False,
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
        _option(
            "A knob of the guidance (geodiff info --knobs), as inner_steps=0; repeatable.", RUN, "--knob"
        ),
    ] = None,
    min_confidence: Annotated[
        float, _option("Least confidence of a point in the cloud, 0 to 1.", OUTPUT, "--min-confidence")
    ] = 0.0,
    out: Annotated[
        Path | None,
        _option("Folder for the results; geodiff-out, or -2 and so on where it is taken.", OUTPUT, *OUT),
    ] = None,
    overwrite: Annotated[
        bool, _option("Write into a folder that holds files.", OUTPUT, "--overwrite")
    ] = False,
    strict: Annotated[
        bool, _option("A result that is not to be trusted is an error.", OUTPUT, "--strict")
    ] = False,
    export: Annotated[
        list[str] | None,
        _option("Also write the cloud and cameras as glb or colmap; repeatable.", OUTPUT, "--export"),
    ] = None,
    show: Annotated[
        str | None,
        _option(
            "Open the cloud and cameras in rerun or viser, or auto for what is installed.", OUTPUT, "--show"
        ),
    ] = None,
    quiet: Annotated[bool, _option("No progress bar, no summary.", OUTPUT, "--quiet", "-q")] = False,
    json: Annotated[bool, _option("Print the report instead of the summary.", OUTPUT, "--json")] = False,
) -> None:
    """Estimate the metric depth of LEFT with RIGHT as its guide."""
    typed = locals()
    from geodiff_plugin.cli.arguments import DepthArguments
    from geodiff_plugin.cli.begin import begun

    typed["out"] = _folder(out, "geodiff-out", overwrite)
    repeated = ("calib", "view", "view_k", "view_e", "option", "knob", "points_calib", "export", "distortion")
    arguments = DepthArguments(**typed | {name: tuple(typed[name] or ()) for name in repeated})
    with begun(arguments) as held:
        from geodiff_plugin.cli.depth import run_depth

        run_depth(arguments, held)


@app.command()
def demo(
    out: Annotated[
        Path | None,
        _option("Folder for the results; geodiff-demo, or -2 and so on where it is taken.", OUTPUT, *OUT),
    ] = None,
    overwrite: Annotated[
        bool, _option("Write into a folder that holds files.", OUTPUT, "--overwrite")
    ] = False,
    quiet: Annotated[bool, _option("No progress bar.", OUTPUT, "--quiet", "-q")] = False,
) -> None:
    """Run on a rendered pair that ships with the package, offline, and print how good it is."""
    from geodiff_plugin.cli.arguments import demo_arguments
    from geodiff_plugin.cli.begin import begun

    arguments = demo_arguments(_folder(out, "geodiff-demo", overwrite), overwrite, quiet)
    with begun(arguments) as held:
        from geodiff_plugin.cli.demo import run_demo

        run_demo(arguments, held)


@app.command()
def info(
    prior: Annotated[str | None, _option("Describe this prior as well.", RUN, "--prior")] = None,
    space: Annotated[
        str | None, _option("Space in which its map is affine, if its folder does not say.", RUN, "--space")
    ] = None,
    knobs: Annotated[
        bool,
        _option("List the knobs of the guidance instead: default, range, what each does.", RUN, "--knobs"),
    ] = False,
) -> None:
    """Print versions, devices, priors and what is cached."""
    if knobs:
        from geodiff_plugin.guidance.knobs import knob_lines

        typer.echo("\n".join(knob_lines()))
        return
    from geodiff_plugin.cli.info import run_info

    run_info(prior, space)


@app.command()
def bench(
    points: Annotated[
        int | None,
        _option("Complete this many known depths instead, guided and by a fitted LoRA.", RUN, "--points"),
    ] = None,
    prior: Annotated[
        str | None, _option("With --points: a Marigold V2; by default a tiny random one.", RUN, "--prior")
    ] = None,
    device: Annotated[str, _option("auto, cpu, cuda, cuda:N or mps.", RUN, "--device")] = "auto",
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
    out: Annotated[Path, _option("The video: .mp4 (OpenCV), .webp or .gif.", OUTPUT, "--out", "-o")] = Path(
        "depth.webp"
    ),
    fps: Annotated[float, _option("Frames a second.", OUTPUT, "--fps")] = 10.0,
    near: Annotated[float | None, _option("Depth of the last colour, metres.", OUTPUT, "--near")] = None,
    far: Annotated[float | None, _option("Depth of the first colour, metres.", OUTPUT, "--far")] = None,
    photographs: Annotated[
        bool, _option("Show the left images beside the depth.", OUTPUT, "--photographs")
    ] = False,
) -> None:
    """Join the depth maps of a sequence into a video, in one range of colours."""
    from geodiff_plugin.cli.video import run_video

    run_video(frames, out, fps, near, far, photographs)


@app.command("app")
def page(
    prior: Annotated[
        list[str] | None, _option("A prior that visitors may choose; repeatable.", RUN, "--prior")
    ] = None,
    device: Annotated[str, _option("auto, cpu, cuda, cuda:N or mps.", RUN, "--device")] = "auto",
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    port: Annotated[int | None, typer.Option("--port", help="Port; by default the first free one.")] = None,
    browser: Annotated[bool, typer.Option("--browser", help="Open the page in a browser.")] = False,
) -> None:
    """Serve a page on which one drops two photographs and measures (extra: app)."""
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
            "--with", help="The part that SRC lacks (docs/reference/priors.md): a file, a folder or a hub id."
        ),
    ] = None,
    space: Annotated[
        str | None,
        typer.Option("--space", help="marigold-v2: what it is affine in, if CHECKPOINT's folder is renamed."),
    ] = None,
    lora: Annotated[
        str | None,
        typer.Option("--lora", help="marigold-v2: merged (default), apart (peft), or 4bit (CUDA)."),
    ] = None,
) -> None:
    """Convert weights that come pickled or in parts; only this command reads pickles, and runs nothing."""
    from geodiff_plugin.cli.convert import run_convert

    run_convert(paths, part, space, lora)


def main(argv: list[str] | None = None) -> None:
    """Run the command line and leave by ``SystemExit``.

    Args:
        argv: arguments without the program's name; ``None`` for those of the process.
    """
    app(args=argv, prog_name="geodiff")
