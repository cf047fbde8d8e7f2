"""``geodiff capture``: depth of the frames of a walk with a camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from geodiff_plugin.cli.options import CAMERAS, OUT, OUTPUT, RUN, Device, Overwrite, option

__all__ = ["add_capture"]


def _capture(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="COLMAP model, transforms.json (nerfstudio, Polycam, Record3D, instant-ngp) or its folder, "
            "folder of 7-Scenes, ScanNet or TUM RGB-D, video with --trajectory, or folder of images.",
        ),
    ],
    out: Annotated[Path, option("Folder for the results, one folder a frame.", OUTPUT, *OUT)] = Path(
        "geodiff-capture"
    ),
    frames: Annotated[
        str | None,
        option(
            "Which frames get depth: NAME,NAME by file stem, or FIRST:LAST:STEP; all by default.",
            RUN,
            "--frames",
        ),
    ] = None,
    neighbours: Annotated[int, option("Right views of a frame, at most.", RUN, "--neighbours")] = 4,
    poses: Annotated[
        str, option("refined: solved together over the capture; given: as they are.", CAMERAS, "--poses")
    ] = "refined",
    points: Annotated[
        str,
        option(
            "Known depths: none, model (points of a COLMAP model), depth (maps it names).", RUN, "--points"
        ),
    ] = "none",
    metres_per_unit: Annotated[
        float | None, option("Length of one unit of the poses, metres.", CAMERAS, "--metres-per-unit")
    ] = None,
    known_length: Annotated[
        str | None,
        option(
            "A distance in the scene, NAME:X1,Y1,X2,Y2,METRES by pixels of a frame.",
            CAMERAS,
            "--known-length",
        ),
    ] = None,
    distance: Annotated[
        str | None, option("Distance of two cameras, NAME,NAME,METRES.", CAMERAS, "--distance")
    ] = None,
    k: Annotated[Path | None, option("3x3 intrinsics, text or .npy.", CAMERAS, "--K")] = None,
    fov: Annotated[float | None, option("Horizontal field of view, degrees.", CAMERAS, "--fov")] = None,
    trajectory: Annotated[
        Path | None,
        option(
            "Of a video: lines of seconds tx ty tz qx qy qz qw, camera-to-world.", CAMERAS, "--trajectory"
        ),
    ] = None,
    prior: Annotated[str, option("'bundled', a hub id or a folder.", RUN, "--prior")] = "bundled",
    steps: Annotated[
        int | None, option("Denoising steps; by default the prior's own, at least 4.", RUN, "--steps")
    ] = None,
    seed: Annotated[int, option("Seed of the noise.", RUN, "--seed")] = 0,
    device: Device = "auto",
    processes: Annotated[
        int | None, option("Processes that share the frames; by default one a core.", RUN, "--processes")
    ] = None,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, option("No progress bar.", OUTPUT, "--quiet", "-q")] = False,
    as_json: Annotated[bool, option("Print the report instead of a summary.", OUTPUT, "--json")] = False,
) -> None:
    """Depth of every frame of a capture, with poses solved together, and one cloud of all."""
    from geodiff_plugin.capture.run import CaptureOptions

    given = dict(locals())
    options = CaptureOptions(**{name: given[name] for name in CaptureOptions.__dataclass_fields__})
    report = _run(options)
    print(json.dumps(report, indent=2) if as_json else _summary(report, options.out))
    if any("error" in frame for frame in report["frames"]):
        raise typer.Exit(1)


def _write(folder: Path, output: Any, image: np.ndarray) -> dict[str, Any]:
    from geodiff_plugin.cli.outputs import write_maps

    return write_maps(folder, output, image)


def _run(options: Any) -> dict[str, Any]:
    from geodiff_plugin.capture.run import run_capture
    from geodiff_plugin.cli.messages import collected_warnings, say

    warnings: list[str] = []
    with collected_warnings(warnings):
        return run_capture(options, _write, say)


def _summary(report: dict[str, Any], out: Path) -> str:
    done = [frame for frame in report["frames"] if "error" not in frame]
    unit = "m" if report["unit"] else "units of the poses"
    line = f"{len(done)} of {len(report['frames'])} frames"
    if done:
        depths = sorted(frame["depth"]["median"] for frame in done)
        line += f", median depth {depths[len(depths) // 2]:.2f} {unit}"
    return f"{line} -> {out}/"


def add_capture(app: typer.Typer) -> None:
    """Register ``geodiff capture``."""
    app.command("capture")(_capture)
