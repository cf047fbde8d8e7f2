"""The paper's figures on any data set, one function each, one table.

Data flow: name + options -> ``figure-<name>.png`` and ``figure-<name>.json``.
Paper: Figure 6 (fig:ab1), fig:qualitative, supplementary figures of S7.3 and S9.
"""

from __future__ import annotations

import json
from pathlib import Path

from geodiff_plugin._checks import check_choice
from geodiff_plugin.evaluation.figures.base import FigureKind, FigureOptions
from geodiff_plugin.evaluation.figures.canvas import save_png
from geodiff_plugin.evaluation.figures.curves import draw_exposure, draw_inner_steps
from geodiff_plugin.evaluation.figures.epipolar import draw_epipolar
from geodiff_plugin.evaluation.figures.gs_sweep import draw_gs_sweep
from geodiff_plugin.evaluation.figures.maps import draw_ablation, draw_qualitative
from geodiff_plugin.evaluation.figures.terms import draw_terms
from geodiff_plugin.evaluation.options import command_line
from geodiff_plugin.evaluation.report import run_facts, write_text

__all__ = ["FIGURES", "FigureOptions", "run_figure"]

FIGURES: dict[str, FigureKind] = {
    "gs-sweep": FigureKind("L_geo and AbsRel against g_s, left images re-rendered", draw_gs_sweep),
    "inner-steps": FigureKind("error and seconds against updates per denoising step", draw_inner_steps),
    "ablation": FigureKind("the prior, reprojection only, guided", draw_ablation),
    "exposure": FigureKind("error against gain and gamma of the right view", draw_exposure),
    "qualitative": FigureKind(
        "depth and error of every method, with --clouds their points", draw_qualitative
    ),
    "epipolar": FigureKind("one pair: epipolar lines and residuals as given and refined", draw_epipolar),
    "terms": FigureKind("one pair: the prior, the matches, their belief, every loss term", draw_terms),
}
"""Every figure by name."""


def _head(name: str, options: FigureOptions) -> tuple[str, ...]:
    """Subcommand, data and the figure's own options."""
    head = ["eval", "figure", name, "--data", str(options.run.data)]
    if name == "gs-sweep":
        head += ["--max", f"{options.largest:g}"]
    if name == "inner-steps":
        head += ["--updates", ",".join(map(str, options.updates))]
    return (*head, "--clouds") if options.clouds else tuple(head)


def run_figure(name: str, options: FigureOptions) -> Path:
    """Draw one figure, and write it and its numbers.

    Returns:
        Path of the PNG.

    Raises:
        ValueError: an unknown figure, no samples, bad options.
        OSError: missing or unreadable files.
    """
    drawing = FIGURES[check_choice(name, "the figure", FIGURES)].draw(options)
    run = options.run
    path = run.out / f"figure-{name}.png"
    save_png(drawing.figure, path)
    facts = run_facts(command_line(run, _head(name, options), ()))
    write_text(path.with_suffix(".json"), json.dumps(facts | drawing.numbers, indent=1) + "\n")
    return path
