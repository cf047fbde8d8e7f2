"""``geodiff eval poses``: options and their help.

Data flow: argv -> ``PosesOptions`` -> ``evaluation.poses``.
Paper: none.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.eval import options as o

__all__ = ["add_poses"]

_SETTINGS = ("space", "seed", "steps", "resolution", "dtype")
_SHARED = ("limit", "prior", *_SETTINGS, "device", "out", "results", "quiet")


#: Smaller images have too few matches to say anything about poses.
_SMALLEST_PX = 64


def _width_and_height(text: str) -> tuple[int, int]:
    """``WIDTHxHEIGHT`` as typed.

    Raises:
        ValueError: not two whole numbers of at least 64.
    """
    found = re.fullmatch(r"\s*(\d{1,5})\s*x\s*(\d{1,5})\s*", text)
    width, height = (int(number) for number in found.groups()) if found else (0, 0)
    if min(width, height) < _SMALLEST_PX:
        expected = f"WIDTHxHEIGHT in pixels, each at least {_SMALLEST_PX}"
        bad_value("--rendered-size", expected, repr(text), "256x192 has a quarter of the usual pixels.")
    return width, height


@o.takes(*_SHARED, prior="bundled", out=Path("geodiff-poses"))
def _poses(
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of real pairs; none by default.")
    ] = None,
    rendered: Annotated[int, typer.Option(help="Rendered pairs in a general pose.", min=0)] = 60,
    rendered_size: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT", help="Size of rendered pairs; smaller is faster. [default: 512x384]"
        ),
    ] = None,
    perturb: Annotated[
        str, typer.Option(metavar="DEGREES,SHARE", help="Rendered: largest turn, and shift / baseline.")
    ] = "1.5,0.1",
    drift: Annotated[
        str,
        typer.Option(metavar="DEGREES,PIXELS", help="Rectified: turn, shift of the right image; 0,0: none."),
    ] = "0.3,1.5",
    **shared: Any,
) -> None:
    """Accuracy with poses as given, perturbed, refined and estimated, and of rigs that have drifted."""
    from geodiff_plugin.cli.eval.printing import print_page
    from geodiff_plugin.evaluation.baselines import Settings
    from geodiff_plugin.evaluation.datasets.perturbed import drift_of, perturbation
    from geodiff_plugin.evaluation.poses import PosesOptions, run_poses
    from geodiff_plugin.runtime.machine import pick_device

    chosen = {name: shared[name] for name in _SETTINGS}
    settings = Settings(shared["prior"], **chosen, device=str(pick_device(shared["device"])))
    limit, out, results, quiet = (shared[name] for name in ("limit", "out", "results", "quiet"))
    changes = perturbation(perturb), drift_of(drift)
    size = None if rendered_size is None else _width_and_height(rendered_size)
    options = PosesOptions(data, rendered, *changes, limit, settings, out, results, quiet, size)
    page = run_poses(options)
    if not quiet:
        print_page(page)


def add_poses(app: typer.Typer) -> None:
    """Add the command to ``geodiff eval``."""
    app.command("poses")(_poses)
