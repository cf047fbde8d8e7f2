"""Figures of one pair: epipolar lines as given and refined, and the parts of a guided call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.algorithm.state import Trajectory
from geodiff_plugin.algorithm.terms import CAUCHY
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, posed_views, prior_space
from geodiff_plugin.evaluation.datasets import StereoSample, load
from geodiff_plugin.evaluation.datasets.changed import perturbed_ref
from geodiff_plugin.evaluation.figures.canvas import (
    COLOURS,
    Drawing,
    depth_bar,
    error_bar,
    mark,
    new_figure,
    references,
    samples,
    show_depth,
    show_error,
    show_image,
    show_values,
    value_bar,
)
from geodiff_plugin.evaluation.figures.maps import CELL_IN
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.geometry import hidden_in_right, warp_right_to_left
from geodiff_plugin.guidance.evidence import pose_views
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.plotting import depth_range
from geodiff_plugin.pose.matches import grey_views, sparse_tracks
from geodiff_plugin.pose.tracks import Tracks, project_tracks, residuals_px
from geodiff_plugin.scale.space import AffineState
from geodiff_plugin.types import CameraView, StepReport

__all__ = ["TermByTerm", "draw_epipolar", "draw_terms", "term_by_term"]

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
    sample = load(first if options.perturb else perturbed_ref(first, PERTURBED))
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
    return (figure, {"sample": sample.label, "status": report.status, "median_px": numbers})


#: The largest mean absolute difference of colours that has a colour of its own.
WORST_DIFFERENCE = 0.2
HIDDEN_COLOUR = COLOURS[5]


class TermByTerm(NamedTuple):
    """One guided call taken apart; ``(h, w)`` is the grid of the losses, ``(H, W)`` the left image's.

    Attributes:
        first_m: ``(H, W)`` metres, the prior's own estimate in the first guided step, scaled by the search.
        matches_m: ``(h, w)`` metres, depth that the views say by themselves; NaN where nothing.
        match_weight: ``(h, w)`` in [0, 1], confidence of the matches less reflections; NaN if none.
        denoised_m: ``(H, W)`` metres, the decoded result, before it is refined.
        final_m: ``(H, W)`` metres.
        residual: ``(h, w)`` planes of the sweep, ``final_m`` against the matches; above 0 is nearer.
        difference: ``(H, W)`` in [0, 1], the photometric error of ``final_m``; NaN where no camera sees it.
        hidden: ``(H, W)`` bool, behind another part of ``final_m`` in every right view that reaches it.
        confidence: ``(H, W)`` in [0, 1].
        history: one report a round of updates.
    """

    first_m: np.ndarray
    matches_m: np.ndarray
    match_weight: np.ndarray
    denoised_m: np.ndarray
    final_m: np.ndarray
    residual: np.ndarray
    difference: np.ndarray
    hidden: np.ndarray
    confidence: np.ndarray
    history: tuple[StepReport, ...]


def _followed(
    pipe: Any, left: Image.Image, guidance: GeometryGuidance, settings: Settings
) -> tuple[Any, list[Tensor]]:
    """Output of a guided call, and the metric depth ``(1, 1, h', w')`` after each step that has one."""
    seen: list[Tensor] = []

    def keep(_pipe: Any, _step: int, _timestep: Any, values: dict[str, Tensor | None]) -> None:
        if (depth_m := values["metric_depth"]) is not None:
            seen.append(depth_m.detach().float().cpu())

    arguments = call_arguments(settings)
    return pipe(left, guidance=guidance, callback_on_step_end=keep, **arguments), seen


def _hidden(guidance: GeometryGuidance, depth_m: Tensor) -> Tensor:
    """``(1, 1, H, W)`` bool: right views reach the pixel, and in all of those something else covers it."""
    further, K_left, _ = guidance.inputs[0].on(depth_m.device)
    reached = clear = torch.zeros_like(depth_m, dtype=torch.bool)
    for image, K_right, T in further:
        cameras = (K_left[None], K_right[None], T[None])
        covered = hidden_in_right(depth_m, *cameras, (image.shape[-2], image.shape[-1]))
        visible = warp_right_to_left(image[None], depth_m, *cameras).visible
        reached, clear = reached | visible, clear | (visible & ~covered)
    return reached & ~clear


def _resized(values: Tensor, size: tuple[int, ...]) -> Tensor:
    return F.interpolate(values, size, mode="bilinear", align_corners=False)


@torch.no_grad()
def term_by_term(sample: StereoSample, settings: Settings, priors: PriorCache) -> TermByTerm:
    """Guide one pair by the default preset and keep what it went through.

    The estimate of the first guided step is that of a second call, which searches in every step and whose
    updates have size 0: the steps before are the prior's own in either.

    Raises:
        ValueError: an ensemble, whose members differ in every map but the last.
    """
    if settings.ensemble != 1:
        bad_value("ensemble", "1 for this figure", settings.ensemble)
    pipe, left = priors.get(settings), Image.fromarray(sample.left)
    views, size = posed_views(sample, settings.views), sample.left.shape[:2]
    guidance = GeometryGuidance(*views)
    unmoved = GeometryGuidance(*views, correct=False, inner_steps=1, optimize_latents=False, step_affine=0)
    held, estimates = _followed(pipe, left, unmoved, settings)
    out, steps = _followed(pipe, left, guidance, settings)
    evidence = guidance.prepare(as_image_01(sample.left, "left")[None])
    trajectory = Trajectory(guidance.config, evidence, [0], prior_space(pipe))
    first = out.history[0].step
    start = held.history[first]
    found = AffineState(*(value.cpu() for value in (start.s_hat, start.t_hat, start.g_s)))
    relative = trajectory.metric.relative(estimates[first], found)
    trajectory.prepare(relative, relative)
    first_m = trajectory.metric(relative, trajectory.affine)
    matches, usable = trajectory.matches, trajectory.usable_matches
    assert matches is not None and usable is not None  # two views always have some
    there = (matches.confidence > 0) & (matches.inverse_depth > 0)
    final_m = torch.from_numpy(out.prediction).permute(0, 3, 1, 2).float()
    inverse_m = 1.0 / _resized(final_m, matches.size)

    def where_matched(values: Tensor) -> np.ndarray:
        return torch.where(there, values, torch.full_like(values, torch.nan))[0, 0].numpy()

    return TermByTerm(
        first_m=_resized(first_m, size)[0, 0].numpy(),
        matches_m=where_matched(1.0 / matches.inverse_depth),
        match_weight=where_matched(usable.confidence),
        denoised_m=_resized(steps[-1], size)[0, 0].numpy(),
        final_m=out.prediction[0, ..., 0],
        residual=where_matched((inverse_m - matches.inverse_depth) / matches.plane_step.view(-1, 1, 1, 1)),
        difference=np.where(out.visible[0, ..., 0], out.photometric_error[0, ..., 0], np.nan),
        hidden=_hidden(guidance, final_m)[0, 0].numpy(),
        confidence=out.confidence[0, ..., 0],
        history=tuple(out.history),
    )


def _maps(figure: Any, sample: StereoSample, parts: TermByTerm, abs_rel: dict[str, float]) -> None:
    """Depths in the upper row, in the same colours; under them what they are compared with."""
    figure.suptitle(f"{sample.label}, default preset", x=0.005, ha="left", fontsize=9)
    upper, lower = figure.subplots(2, 6)
    for axes in lower:
        axes.set_anchor("N")  # level with the one that has no bar below
    truth = np.where(sample.valid, sample.depth_m, np.nan)
    near, far = depth_range(truth, sample.valid)
    show_image(upper[0], sample.left, "left image")
    show_image(lower[0], sample.right, "right image")
    drawn = show_depth(upper[1], truth, near, far, "truth")
    show_depth(upper[2], parts.first_m, near, far, f"prior's first estimate\nAbsRel {abs_rel['first']:.3f}")
    show_depth(upper[3], parts.matches_m, near, far, "matches\n(grey: none)")
    show_depth(upper[4], parts.denoised_m, near, far, f"denoised\nAbsRel {abs_rel['denoised']:.3f}")
    show_depth(upper[5], parts.final_m, near, far, f"refined\nAbsRel {abs_rel['final']:.3f}")
    depth_bar(figure, drawn, upper, near, far)
    title = "photometric error\n(blue: hidden, grey: unseen)"
    shown = show_values(lower[1], parts.difference, title, "inferno", 0.0, WORST_DIFFERENCE)
    mark(lower[1], parts.hidden, HIDDEN_COLOUR)
    value_bar(figure, shown, lower[1], "mean absolute difference", "max")
    title, most = "refined against matches\n(red: nearer)", CAUCHY
    shown = show_values(lower[2], parts.residual, title, "RdBu_r", -most, most)
    value_bar(figure, shown, lower[2], "planes of the sweep", "both")
    shown = show_values(lower[3], parts.match_weight, "weight of the matches", "viridis", 0.0, 1.0)
    value_bar(figure, shown, lower[3], "confidence, 0 for reflections")
    shown = show_values(lower[4], parts.confidence, "confidence of refined", "viridis", 0.0, 1.0)
    value_bar(figure, shown, lower[4], "probability of an error < 10 %")
    shown = show_error(lower[5], parts.final_m, sample.depth_m, sample.valid, "error of refined")
    error_bar(figure, shown, [lower[5]], "bottom")


def _curves(figure: Any, history: Sequence[StepReport], values: dict[str, list[float]]) -> None:
    """One small plot a term, each with its own unit, from 0."""
    figure.suptitle("terms of the loss in every guided step", fontsize=9)
    repeated = len({report.step for report in history}) < len(history)
    count = [i + 1 if repeated else report.step + 1 for i, report in enumerate(history)]
    for index, (axes, (name, own)) in enumerate(
        zip(figure.subplots(1, len(values), squeeze=False)[0], values.items(), strict=True)
    ):
        axes.plot(count, own, color=COLOURS[index % len(COLOURS)], marker="o", markersize=4, clip_on=False)
        axes.set_title(name, fontsize=9)
        axes.set_xticks(count)
        axes.set_xlabel("round of updates" if repeated else "denoising step", fontsize=8)
        axes.set_ylim(0.0, 1.1 * max(own) or 1.0)
        if not any(own):
            axes.set_yticks([0])
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.3)


def draw_terms(options: FigureOptions) -> Drawing:
    """Draw the first sample.

    Raises:
        ValueError: no sample, or an ensemble.
    """
    sample = samples(options)[0]
    parts = term_by_term(sample, options.settings, PriorCache())
    depths = {"first": parts.first_m, "denoised": parts.denoised_m, "final": parts.final_m}
    abs_rel = {
        name: evaluate_depth(depth_m, sample.depth_m, sample.valid)["abs_rel"]
        for name, depth_m in depths.items()
    }
    values = {name: [float(r.terms[name]) for r in parts.history] for name in parts.history[0].terms}
    values["weighted sum"] = [float(report.loss) for report in parts.history]
    high = CELL_IN * sample.left.shape[0] / sample.left.shape[1]
    heights = 2 * high + 1.55, 1.5
    figure = new_figure(6 * CELL_IN + 0.9, sum(heights))
    upper, lower = figure.subfigures(2, 1, height_ratios=heights)
    _maps(upper, sample, parts, abs_rel)
    _curves(lower, parts.history, values)
    matched = np.isfinite(parts.match_weight)
    numbers = {"sample": sample.label, "abs_rel": abs_rel, "matched": float(matched.mean())}
    numbers["match_weight"] = float(parts.match_weight[matched].mean()) if matched.any() else 0.0
    numbers |= {"hidden": float(parts.hidden.mean()), "terms": values}
    return (figure, numbers)
