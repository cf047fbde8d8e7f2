"""``geodiff eval trust``: options and their help.

Data flow: argv -> ``TrustOptions`` -> ``evaluation.trust``.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geodiff_plugin.cli.eval import options as o

__all__ = ["add_trust"]

_SETTINGS = ("space", "seed", "steps", "dtype")


@o.takes(
    "limit",
    "prior",
    *_SETTINGS,
    "device",
    "out",
    "results",
    "quiet",
    prior="bundled",
    out=Path("geodiff-trust"),
)
def _trust(
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of real pairs; none by default.")
    ] = None,
    rendered: Annotated[int, typer.Option(help="Rendered pairs, every other one rectified.", min=0)] = 60,
    width: Annotated[int, typer.Option(help="Width of the rendered pairs, pixels.", min=64)] = 512,
    kinds: Annotated[
        str | None, typer.Option(help="Comma-separated kinds of wrong calibration; ten by default.")
    ] = None,
    **shared: Any,
) -> None:
    """How many wrong calibrations are detected, and how many right ones are not trusted."""
    from geodiff_plugin.cli.eval.printing import print_page
    from geodiff_plugin.evaluation.baselines import Settings
    from geodiff_plugin.evaluation.trust import TEN, TrustOptions, run_trust
    from geodiff_plugin.runtime.machine import pick_device

    chosen = {name: shared[name] for name in _SETTINGS}
    settings = Settings(shared["prior"], **chosen, device=str(pick_device(shared["device"])))
    limit, out, quiet, results = (shared[name] for name in ("limit", "out", "quiet", "results"))
    kinds_given = o.names(kinds) or TEN
    options = TrustOptions(data, rendered, width, kinds_given, limit, settings, out, quiet, results)
    page = run_trust(options)
    if not quiet:
        print_page(page)


def add_trust(app: typer.Typer) -> None:
    """Add the command to ``geodiff eval``."""
    app.command("trust")(_trust)
