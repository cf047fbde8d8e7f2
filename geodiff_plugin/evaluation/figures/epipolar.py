"""Figure of one pair: epipolar lines and residuals by the pose as given and as refined.

Data flow: a sample with a perturbed pose -> matches -> lines in the right image, residuals in the left one.
Paper: none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from geodiff_plugin.evaluation.datasets import load
from geodiff_plugin.evaluation.datasets.perturbed import perturbed_ref
from geodiff_plugin.evaluation.figures.base import Drawing, FigureOptions, references
from geodiff_plugin.evaluation.figures.canvas import new_figure, show_image
from geodiff_plugin.guidance.posing import pose_views
from geodiff_plugin.pose.matches import grey_views, sparse_tracks
from geodiff_plugin.pose.tracks import Tracks, project_tracks, residuals_px
from geodiff_plugin.types import CameraView

__all__ = ["draw_epipolar"]

#: How wrong the pose is given where the command does not say.
PERTURBED = (1.5, 0.1)
_LINES, _SHOWN_PX = 14, 5.0


def _spread(tracks: Tracks, residual: np.ndarray) -> np.ndarray:
    """Indices of matches all over the image, outliers left out."""
    chosen: list[int] = []
    for i in np.argsort(residual):
        away = [np.linalg.norm(tracks.left_px[i] - tracks.left_px[j]) for j in chosen]
        if len(chosen) < _LINES and all(d > 0.15 * tracks.left_px.max() for d in away):
            chosen.append(int(i))
    return np.array(chosen)


def _line(tracks: Tracks, i: int, T: np.ndarray) -> np.ndarray:
    """``(2, 2)``: two right pixels on the epipolar line of track ``i``, around its match."""
    at = tracks.kept(np.array([i, i]))
    depth = np.array([0.0, 1.0]) / np.linalg.norm(T[:3, 3])
    ends = project_tracks(at.rays, depth * 1e-3, at.K_rights[0], T).px
    along = (ends[1] - ends[0]) / max(np.linalg.norm(ends[1] - ends[0]), 1e-12)
    foot = ends[0] + ((tracks.right_px[0, i] - ends[0]) @ along) * along
    return np.stack([foot - 40 * along, foot + 40 * along])


def draw_epipolar(options: FigureOptions) -> Drawing:
    """Lines and matches in the right image above, residuals of all matches in the left image below."""
    first = references(options)[0]
    sample = load(first if options.run.perturb else perturbed_ref(first, PERTURBED))
    left, right = (torch.from_numpy(v).permute(2, 0, 1) / 255 for v in (sample.left, sample.right))
    K_left, K_right, T = (
        torch.as_tensor(m).float() for m in (sample.K_left, sample.K_right, np.linalg.inv(sample.E))
    )
    rights = [CameraView(right, K_right, T)]
    _, report = pose_views(left, rights, K_left)
    views = grey_views(left, rights, K_left)
    tracks = sparse_tracks(views)
    Ts = {"as given": np.linalg.inv(report.E_given[0]), "as refined": np.linalg.inv(report.E[0])}
    residuals = {name: residuals_px(tracks, pose[None])[0] for name, pose in Ts.items()}
    chosen = _spread(tracks, residuals["as refined"])
    figure = new_figure(8.0, 6.4)
    axes = figure.subplots(2, 2)
    drawn: Any = None
    for column, (name, pose) in enumerate(Ts.items()):
        median = float(np.median(residuals[name]))
        show_image(axes[0, column], views.rights[0], f"right image, {name}: {median:.2f} px")
        axes[0, column].images[0].set_cmap("gray")
        for i in chosen:
            axes[0, column].plot(*_line(tracks, i, pose).T, color="#f0a020", linewidth=1)
            axes[0, column].plot(*tracks.right_px[0, i], "+", color="#20c0f0", markersize=7)
        show_image(axes[1, column], views.left, "distance of the matches from their lines, px")
        axes[1, column].images[0].set_cmap("gray")
        shown = np.minimum(residuals[name], _SHOWN_PX)
        drawn = axes[1, column].scatter(
            *tracks.left_px.T, c=shown, s=9, cmap="viridis", vmin=0, vmax=_SHOWN_PX
        )
        for row in range(2):
            axes[row, column].set_xlim(0, views.left.shape[1] - 1)
            axes[row, column].set_ylim(views.left.shape[0] - 1, 0)
    figure.colorbar(drawn, ax=axes[1].tolist(), shrink=0.8)
    numbers = {name: float(np.median(values)) for name, values in residuals.items()}
    return Drawing(figure, {"sample": sample.label, "status": report.status, "median_px": numbers})
