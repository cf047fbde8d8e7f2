"""The paper's figures on any data set, one function each, one table (paper Figure 6, S7.3, S9)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from geodiff_plugin._checks import check_choice
from geodiff_plugin.evaluation.experiment import run_facts
from geodiff_plugin.evaluation.figures.canvas import Drawing, save_png
from geodiff_plugin.evaluation.figures.curves import draw_exposure, draw_gs_sweep, draw_inner_steps
from geodiff_plugin.evaluation.figures.maps import draw_ablation, draw_qualitative
from geodiff_plugin.evaluation.figures.one_pair import draw_epipolar, draw_terms
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.formats.out import write_text

FIGURES: dict[str, Callable[[FigureOptions], Drawing]] = {
    "gs-sweep": draw_gs_sweep,
    "inner-steps": draw_inner_steps,
    "ablation": draw_ablation,
    "exposure": draw_exposure,
    "qualitative": draw_qualitative,
    "epipolar": draw_epipolar,
    "terms": draw_terms,
}
"""Every figure by name."""


def run_figure(name: str, options: FigureOptions) -> Path:
    """Draw the figure ``options.name``, write it as PNG and its numbers as JSON, and return the PNG's path.

    Raises:
        ValueError: an unknown figure, no samples, bad options.
        OSError: missing or unreadable files.
    """
    figure, numbers = FIGURES[check_choice(options.name, "the figure", FIGURES)](options)
    path = options.out / f"figure-{options.name}.png"
    save_png(figure, path)
    facts = run_facts(name, options)
    write_text(path.with_suffix(".json"), json.dumps(facts | numbers, indent=1) + "\n")
    return path
