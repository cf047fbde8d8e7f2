"""``geodiff depth``: every option with its help.

Data flow: argv -> ``DepthArguments`` -> ``cli.depth``.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geodiff_plugin.cli.options import CAMERAS, OUT, OUTPUT, RUN, Device, Overwrite, out_folder
from geodiff_plugin.cli.options import option as _option

__all__ = ["add_depth"]


def _depth(
    left: Annotated[
        Path,
        typer.Argument(
            metavar="LEFT",
            help="Left image, whose depth is estimated; its EXIF rotation is applied. Or a folder of images, "
            "a video, or a list with LEFT,RIGHT[,CALIB] per line.",
        ),
    ],
    right: Annotated[
        Path | None,
        typer.Argument(
            metavar="RIGHT",
            help="Right image, of any size; not needed with --points. Or a folder, or a video; without it, a "
            "video LEFT has both views side by side.",
        ),
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
        str | None, _option("Which two cameras of a file that has more, as 2,3.", CAMERAS, "--cameras")
    ] = None,
    fx: Annotated[float | None, _option("Focal length, pixels.", CAMERAS, "--fx")] = None,
    fy: Annotated[float | None, _option("Focal length, pixels.", CAMERAS, "--fy")] = None,
    cx: Annotated[float | None, _option("Principal point, pixels.", CAMERAS, "--cx")] = None,
    cy: Annotated[float | None, _option("Principal point, pixels.", CAMERAS, "--cy")] = None,
    baseline: Annotated[
        float | None,
        _option(
            "Distance of the cameras, metres, right one to the right; replaces that of --calib.",
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
        _option("Horizontal field of view, degrees, if EXIF has no focal length.", CAMERAS, "--fov"),
    ] = None,
    known_length: Annotated[
        str | None,
        _option(
            "Distance between two points of LEFT, X1,Y1,X2,Y2,METRES; instead of --baseline.",
            CAMERAS,
            "--known-length",
        ),
    ] = None,
    matcher: Annotated[
        str | None,
        _option(
            "Finds points in the photographs: sift, lightglue, superglue, a folder.", CAMERAS, "--matcher"
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
    view_distortion: Annotated[
        list[str] | None,
        _option("Lens of each --view, 0,0,0,0 for none; LEFT's if not given.", CAMERAS, "--view-distortion"),
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
        int,
        _option(
            "Number of members; with 2 or more, their spread is written as uncertainty.", RUN, "--ensemble"
        ),
    ] = 1,
    resolution: Annotated[
        int | None,
        _option("Longer side at which the prior works, pixels; 0: the image's own.", RUN, "--resolution"),
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
        _option(
            "How many units of that file are a metre: 1000 for mm, 256 for KITTI's PNG.",
            RUN,
            "--points-scale",
        ),
    ] = None,
    points_calib: Annotated[
        list[Path] | None,
        _option("KITTI's lidar calibration, for a .bin; twice if it is in two files.", RUN, "--points-calib"),
    ] = None,
    cropped: Annotated[
        bool, _option("The principal point may lie outside: the images are crops.", CAMERAS, "--cropped")
    ] = False,
    near: Annotated[float | None, _option("Nearest depth to search, metres.", RUN, "--near")] = None,
    far: Annotated[float | None, _option("Farthest depth to search, metres.", RUN, "--far")] = None,
    seed: Annotated[int, _option("Seed of the noise.", RUN, "--seed")] = 0,
    device: Device = "auto",
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
    overwrite: Overwrite = False,
    warm_start: Annotated[
        bool,
        _option(
            "Many pairs: start each from the result of the previous frame, in fewer steps.",
            RUN,
            "--warm-start",
        ),
    ] = False,
    strict: Annotated[
        bool, _option("End with an error if the result is not to be trusted.", OUTPUT, "--strict")
    ] = False,
    export: Annotated[
        list[str] | None,
        _option("Also write the cloud and cameras as glb or colmap; repeatable.", OUTPUT, "--export"),
    ] = None,
    show: Annotated[
        str | None,
        _option(
            "Open the cloud and cameras in rerun, viser, or auto (whichever is installed).", OUTPUT, "--show"
        ),
    ] = None,
    quiet: Annotated[bool, _option("No progress bar, no summary.", OUTPUT, "--quiet", "-q")] = False,
    json: Annotated[bool, _option("Print the report instead of the summary.", OUTPUT, "--json")] = False,
) -> None:
    """Estimate the metric depth of LEFT with RIGHT as its guide; of one pair, or of many."""
    typed = locals()
    from geodiff_plugin.cli.arguments import DepthArguments
    from geodiff_plugin.cli.many.pairs import is_many
    from geodiff_plugin.cli.start import start_many, start_run

    many = is_many(left)
    typed["out"] = Path("geodiff-out") if many and out is None else out_folder(out, "geodiff-out", overwrite)
    views = ("view", "view_k", "view_e", "view_distortion")
    repeated = ("calib", *views, "option", "knob", "points_calib", "export", "distortion")
    arguments = DepthArguments(**typed | {name: tuple(typed[name] or ()) for name in repeated})
    if many:
        refs = start_many(arguments)
        from geodiff_plugin.cli.many.run import run_many

        run_many(arguments, refs)
        return
    with start_run(arguments) as held:
        from geodiff_plugin.cli.depth import run_depth

        run_depth(arguments, held)


def add_depth(app: typer.Typer) -> None:
    """Add the command to ``geodiff``."""
    app.command("depth")(_depth)
