"""``geodiff eval table1 | table2 | table3 | ablation | parts | flatness | cost``: options and their help.

Data flow: argv -> ``PairsOptions`` -> ``evaluation.experiments`` or ``evaluation.cost``.
Paper: Tables 1 to 4.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import typer

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.eval import options as o

__all__ = ["add_tables"]

_HELP = {
    "table1": "Table 1: KITTI-Stereo, Booster and Middlebury, in metres and aligned.",
    "table2": "Table 2: Booster, beside stereo.",
    "table3": "Table 3: two posed views, Tanks and Temples.",
    "ablation": "Table 4, and one change at a time: gradients, rules, terms, no diffusion.",
    "parts": "What each part of the default is worth: one left out at a time.",
    "flatness": "How flat the default lies: every number of it at half and at twice its value.",
    "cost": "Seconds and peak memory, plain against guided, as ratios.",
}
_DATA = {
    name: Path(f"synthetic:{n}") for name, n in {"ablation": 4, "parts": 4, "flatness": 4, "cost": 3}.items()
}
"""Data by default; the paper's tables have none, since their sets must be obtained first."""


def _run(name: str, typed: dict[str, Any]) -> None:
    from geodiff_plugin.evaluation.cost import run_cost
    from geodiff_plugin.evaluation.experiments import how_to_obtain, run_changes, run_experiment

    if typed["data"] is None:
        bad_value("data", "given, as --data DIR", "nothing", how_to_obtain(name))
    options = o.pairs_options(typed)
    if name == "cost":
        o.run_and_print(run_cost, options)
    elif name in ("parts", "flatness"):
        o.run_and_print(partial(run_changes, name), options)
    else:
        o.run_and_print(partial(run_experiment, name), options)


def _command(name: str) -> Callable[..., None]:
    default_data = _DATA.get(name)

    @o.takes(
        *("methods", *o.SAMPLES),
        *("sample", "pairs", "pixel_centre", "crop", "prior", *o.SETTINGS),
        *("out", "skip_broken", "save_depth", "quiet"),
        pairs="all" if name == "table3" else "default",
    )
    def command(data: o.Data = default_data, **shared: Any) -> None:
        _run(name, {"data": data, **shared})

    command.__doc__ = _HELP[name]
    return command


def add_tables(app: typer.Typer) -> None:
    """Add one command per table of the paper, the tables of changes, and the cost, to ``geodiff eval``."""
    for name in _HELP:
        app.command(name)(_command(name))
