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
from geodiff_plugin.algorithm.terms import TERM_CAUCHY
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, posed_views, prior_space
from geodiff_plugin.evaluation.datasets import StereoSample, load
from geodiff_plugin.evaluation.datasets.changed import changed_ref
from geodiff_plugin.evaluation.figures.canvas import (
    COLOURS,
    ERROR,
    Drawing,
    colour_bar,
    depth_scale,
    known_depth,
    mark,
    new_figure,
    references,
    relative_error,
    samples,
    show_image,
    show_map,
    value_scale,
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

#: How wrong the pose is given where the command does not say.
PERTURBED = (1.5, 0.1)
_LINES, _SHOWN_PX = 14, 5.0


def _spread(tracks: Tracks, residual: np.ndarray) -> list[int]:
    """Indices of matches all over the image, outliers left out."""
    chosen: list[int] = []
    for i in np.argsort(residual):
        away = [np.linalg.norm(tracks.left_px[i] - tracks.left_px[j]) for j in chosen]
        if len(chosen) < _LINES and all(d > 0.15 * tracks.left_px.max() for d in away):
            chosen.append(int(i))
    return chosen


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
    sample = load(first if options.perturb else changed_ref(first, "perturbed", PERTURBED))
    left, right = (torch.from_numpy(v).permute(2, 0, 1) / 255 for v in (sample.left, sample.right))
    matrices = (sample.K_left, sample.K_right, np.linalg.inv(sample.E))
    K_left, K_right, T = (torch.as_tensor(matrix).float() for matrix in matrices)
    rights = [CameraView(right, K_right, T)]
    _, report = pose_views(left, rights, K_left)
    views = grey_views(left, rights, K_left)
    tracks = sparse_tracks(views)
    Ts = {"as given": np.linalg.inv(report.E_given[0]), "as refined": np.linalg.inv(report.E[0])}
    residuals = {name: residuals_px(tracks, pose[None])[0] for name, pose in Ts.items()}
    chosen, drawn = _spread(tracks, residuals["as refined"]), None
    figure = new_figure(8.0, 6.4)
    axes = figure.subplots(2, 2)
    for (name, pose), (upper, lower) in zip(Ts.items(), axes.T, strict=True):
        show_image(upper, views.rights[0], f"right image, {name}: {np.median(residuals[name]):.2f} px")
        show_image(lower, views.left, "distance of the matches from their lines, px")
        for i in chosen:
            upper.plot(*_line(tracks, i, pose).T, color="#f0a020", linewidth=1)
            upper.plot(*tracks.right_px[0, i], "+", color="#20c0f0", markersize=7)
        shown = np.minimum(residuals[name], _SHOWN_PX)
        drawn = lower.scatter(*tracks.left_px.T, c=shown, s=9, cmap="viridis", vmin=0, vmax=_SHOWN_PX)
        for own in (upper, lower):
            own.images[0].set_cmap("gray")
            own.set_xlim(0, views.left.shape[1] - 1)
            own.set_ylim(views.left.shape[0] - 1, 0)
    figure.colorbar(drawn, ax=axes[1].tolist(), shrink=0.8)
    numbers = {name: float(np.median(values)) for name, values in residuals.items()}
    return figure, {"sample": sample.label, "status": report.status, "median_px": numbers}


#: The largest mean absolute difference of colours that has a colour of its own.
WORST_DIFFERENCE = 0.2


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
    updates have size 0: the steps before are the prior's own in either. An ensemble is refused: its members
    differ in every map but the last.
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
    affine = AffineState(*(value.cpu() for value in (start.s_hat, start.t_hat, start.g_s)))
    relative = trajectory.metric.relative(estimates[first], affine)
    trajectory.prepare(relative, relative)
    first_m = trajectory.metric(relative, trajectory.affine)
    matches, usable = trajectory.matches, trajectory.usable_matches
    assert matches is not None and usable is not None  # two views always have some
    there = (matches.confidence > 0) & (matches.inverse_depth > 0)
    final_m = torch.from_numpy(out.prediction).permute(0, 3, 1, 2).float()
    residual = (1.0 / _resized(final_m, matches.size) - matches.inverse_depth) / matches.plane_step.view(
        -1, 1, 1, 1
    )
    of_matches = (1.0 / matches.inverse_depth, usable.confidence, residual)
    matches_m, weight, planes = (torch.where(there, values, torch.nan)[0, 0].numpy() for values in of_matches)
    return TermByTerm(
        first_m=_resized(first_m, size)[0, 0].numpy(),
        matches_m=matches_m,
        match_weight=weight,
        denoised_m=_resized(steps[-1], size)[0, 0].numpy(),
        final_m=out.prediction[0, ..., 0],
        residual=planes,
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
    scale = depth_scale(*depth_range(truth, sample.valid))
    show_image(upper[0], sample.left, "left image")
    show_image(lower[0], sample.right, "right image")
    depths = (
        (truth, "truth"),
        (parts.first_m, f"prior's first estimate\nAbsRel {abs_rel['first']:.3f}"),
        (parts.matches_m, "matches\n(grey: none)"),
        (parts.denoised_m, f"denoised\nAbsRel {abs_rel['denoised']:.3f}"),
        (parts.final_m, f"refined\nAbsRel {abs_rel['final']:.3f}"),
    )
    drawn = [show_map(a, known_depth(m), scale, t) for a, (m, t) in zip(upper[1:], depths, strict=True)]
    colour_bar(figure, drawn[0], upper, scale)
    difference = value_scale("inferno", 0.0, WORST_DIFFERENCE, "mean absolute difference")
    planes = value_scale("RdBu_r", -TERM_CAUCHY, TERM_CAUCHY, "planes of the sweep")
    weight = value_scale("viridis", 0.0, 1.0, "confidence, 0 for reflections")
    probability = value_scale("viridis", 0.0, 1.0, "probability of an error < 10 %")
    compared = (
        (parts.difference, difference, "photometric error\n(blue: hidden, grey: unseen)", "max"),
        (parts.residual, planes, "refined against matches\n(red: nearer)", "both"),
        (parts.match_weight, weight, "weight of the matches", "neither"),
        (parts.confidence, probability, "confidence of refined", "neither"),
        (relative_error(parts.final_m, sample), ERROR, "error of refined", "max"),
    )
    for axes, (values, own, title, beyond) in zip(lower[1:], compared, strict=True):
        shown = show_map(axes, values, own, title)
        colour_bar(figure, shown, [axes], own, "bottom", beyond)
    mark(lower[1], parts.hidden, COLOURS[5])


def _curves(figure: Any, history: Sequence[StepReport], values: dict[str, list[float]]) -> None:
    """One small plot a term, each with its own unit, from 0."""
    figure.suptitle("terms of the loss in every guided step", fontsize=9)
    repeated = len({report.step for report in history}) < len(history)
    count = [i + 1 if repeated else report.step + 1 for i, report in enumerate(history)]
    panels = figure.subplots(1, len(values), squeeze=False)[0]
    for index, (axes, (name, own)) in enumerate(zip(panels, values.items(), strict=True)):
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
    """What the default preset makes of the first sample, part by part."""
    sample = samples(options)[0]
    parts = term_by_term(sample, options.settings, PriorCache())
    depths = {"first": parts.first_m, "denoised": parts.denoised_m, "final": parts.final_m}
    abs_rel = {n: evaluate_depth(m, sample.depth_m, sample.valid)["abs_rel"] for n, m in depths.items()}
    values = {name: [float(r.terms[name]) for r in parts.history] for name in parts.history[0].terms}
    values["weighted sum"] = [float(report.loss) for report in parts.history]
    high = CELL_IN * sample.left.shape[0] / sample.left.shape[1]
    heights = 2 * high + 1.55, 1.5
    figure = new_figure(6 * CELL_IN + 0.9, sum(heights))
    upper, lower = figure.subfigures(2, 1, height_ratios=heights)
    _maps(upper, sample, parts, abs_rel)
    _curves(lower, parts.history, values)
    weight = parts.match_weight[np.isfinite(parts.match_weight)]
    numbers = {"sample": sample.label, "abs_rel": abs_rel, "matched": weight.size / parts.match_weight.size}
    numbers["match_weight"] = float(weight.mean()) if weight.size else 0.0
    return figure, numbers | {"hidden": float(parts.hidden.mean()), "terms": values}
