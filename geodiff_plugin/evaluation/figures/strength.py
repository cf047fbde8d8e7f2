"""Guided error against the prior's own, and what its surfaces look like: ``geodiff eval strength --figure``.

Data flow: records of ``evaluation.strength`` + shaded depth of one pair -> figure.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.figures.canvas import COLOURS, new_figure, save_png

__all__ = ["draw_strength", "shaded"]

LIGHT = np.array([-0.4, -0.5, 0.77])


def shaded(depth_m: np.ndarray, focal_px: float) -> np.ndarray:
    """``(H, W)`` in [0, 1]: the surface lit from the upper left, so that roughness shows."""
    rows, columns = np.gradient(np.log(np.maximum(depth_m, 1e-6)))
    normal = np.stack([-columns * focal_px, -rows * focal_px, np.ones_like(rows)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.clip(normal @ LIGHT, 0.0, 1.0)


def draw_strength(
    records: Sequence[Mapping[str, Any]], oracle: str, pictures: Mapping[str, np.ndarray], path: Path
) -> None:
    """Write the figure.

    Args:
        records: of ``run_strength``.
        oracle: the method whose error is the abscissa.
        pictures: title -> shaded crop.
        path: PNG to write.
    """
    strengths = list(dict.fromkeys(r["strength"] for r in records))
    methods = [m for m in dict.fromkeys(r["method"] for r in records) if m != oracle]
    figure = new_figure(11.0, 4.4)
    grid = figure.add_gridspec(2, 4)
    axes = figure.add_subplot(grid[:, :2])

    def mean(strength: str, method: str) -> float:
        own = [r["abs_rel"] for r in records if (r["strength"], r["method"]) == (strength, method)]
        return float(np.mean(own))

    at = {s: mean(s, oracle) for s in strengths}
    ordered = sorted(strengths, key=at.__getitem__)
    for index, method in enumerate(methods):
        axes.plot(
            [at[s] for s in ordered],
            [mean(s, method) for s in ordered],
            color=COLOURS[index % len(COLOURS)],
            marker="osD^vP"[index % 6],
            markersize=4,
            label=find_method(method).title,
        )
    ends = (min(at.values()) * 0.8, max(at.values()) * 1.2)
    axes.plot(ends, ends, color="0.6", linestyle="--", linewidth=1, label=find_method(oracle).title)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("AbsRel of the prior, aligned by an oracle", fontsize=9)
    axes.set_ylabel("AbsRel in metres", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    for k, (title, picture) in enumerate(pictures.items()):
        row, column = divmod(k, 2)
        panel = figure.add_subplot(grid[row, 2 + column])
        panel.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        panel.set_title(title, fontsize=8)
        panel.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(figure, path)
