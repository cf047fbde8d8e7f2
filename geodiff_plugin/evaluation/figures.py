"""The paper's figures for any data set, one function each, in a table (Figures 5 and 6, S7.3, S9, S11)."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import check_choice
from geodiff_plugin.algorithm.terms import masked_mean, photometric_map
from geodiff_plugin.cameras import Camera, PosedCamera
from geodiff_plugin.capture.agreement import rendered
from geodiff_plugin.config import PAPER
from geodiff_plugin.evaluation.baselines import METHODS, NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load, select
from geodiff_plugin.evaluation.experiment import in_metres, measure_cells, method_cells, run_facts
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions
from geodiff_plugin.evaluation.tables import (
    ValueOf,
    count_of_pairs,
    grouped,
    headline,
    mean_risk,
    mean_with_interval,
)
from geodiff_plugin.formats import as_image_01, atomic_path, write_text
from geodiff_plugin.geometry import plane_rays, warp_right_to_left
from geodiff_plugin.jobs import Record
from geodiff_plugin.plotting import colour_depth, colour_fraction, depth_range, grid, ticks
from geodiff_plugin.scale.space import SPACES, smooth_floor
from geodiff_plugin.types import DepthFrame

#: Line colours in order (Okabe and Ito, suitable for colour-blind readers), and their markers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = "osD^vP"
PRESETS = ("guided", "paper")


class Drawing(NamedTuple):
    """An image or matplotlib figure, and its values for JSON."""

    rgb: Any
    numbers: dict[str, Any]


def _new_figure(width_in: float, height_in: float) -> Any:
    """Create an empty figure with automatic layout, without global state."""
    return Figure(figsize=(width_in, height_in), dpi=90, layout="constrained")


def _rasterised(figure: Figure) -> Image.Image:
    """Render a figure to pixels, without global state."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def _save_png(rgb: Any, path: Path) -> None:
    """Write an image completely or not at all."""
    image = _rasterised(rgb) if isinstance(rgb, Figure) else rgb
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        image.save(temporary, format="PNG", optimize=True)


def _name_axes(axes: Any, x_name: str, y_name: str, x: Sequence[float] = ()) -> None:
    """Set axis labels, and the ticks of a logarithmic abscissa."""
    if x:
        axes.set_xscale("log")
        axes.set_xticks(x, labels=[f"{value:g}" for value in x])
        axes.minorticks_off()
    axes.set_xlabel(x_name, fontsize=9)
    axes.set_ylabel(y_name, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def _plain_log_axis(axis: Any, low: float, high: float) -> None:
    """Set up a logarithmic axis with plain numbers instead of powers."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    values = ticks(low, max(high, 1.01 * low), 7)
    axis.set_ticks(values, labels=[f"{value:g}" for value in values])
    axis.set_minor_locator(NullLocator())


def _records(options: FigureOptions, refs: Sequence[SampleRef], methods: Sequence[str]) -> list[Record]:
    return measure_cells(method_cells(refs, methods, options.settings, options.out), options) or []


def _curves(
    axes: Any, x: Sequence[float], groups: Mapping[str, Sequence[Sequence[Record]]], value_of: ValueOf
) -> dict[str, list[float | None]]:
    """Draw a line per method through the means of its groups, with a band if all have intervals."""
    drawn: dict[str, list[float | None]] = {}
    for index, (name, of_method) in enumerate(groups.items()):
        done = [[value_of(record) for record in group if record["status"] == "ok"] for group in of_method]
        means = list(map(mean_with_interval, done))
        colour = COLOURS[index % len(COLOURS)]
        marks = {"color": colour, "marker": MARKERS[index % len(MARKERS)], "markersize": 4}
        axes.plot(x, [mean.value for mean in means], label=find_method(name).title, **marks)
        if all(mean.low is not None for mean in means):
            low, high = [mean.low for mean in means], [mean.high for mean in means]
            axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        drawn[name] = [mean.value if mean.count else None for mean in means]
    return drawn


def draw_guidance_steps(options: FigureOptions) -> Drawing:
    """Plot error and seconds against updates per denoising step, for both presets."""
    updates = sorted(set(options.updates))
    refs = select(options)
    methods = {preset: [f"{preset}:guidance_steps={n}" for n in updates] for preset in PRESETS}
    records = grouped(_records(options, refs, list(chain(*methods.values()))), "method")
    groups = {preset: [records.get(name, []) for name in names] for preset, names in methods.items()}
    figure = _new_figure(7.6, 3.1)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    panels = figure.subplots(1, 2)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs], "updates": updates}
    errors = _curves(panels[0], updates, groups, headline)
    seconds = _curves(panels[1], updates, groups, itemgetter("seconds"))
    for axes, title in zip(panels, ("AbsRel", "s/pair"), strict=True):
        _name_axes(axes, "updates per denoising step", title, updates)
        axes.set_ylim(bottom=0)
    panels[1].legend(fontsize=8)
    curves = {p: {"abs_rel": errors[p], "seconds": seconds[p]} for p in PRESETS}
    return Drawing(figure, numbers | curves)


#: Number of images below the curves, in addition to the left image.
SHOWN = 4


def sweep_g_s(
    sample: StereoSample, relative: np.ndarray, space: str, largest_m: float
) -> tuple[dict[str, np.ndarray], dict[int, np.ndarray]]:
    """Scale a relative map ``(H, W)``, affine in ``space``, by candidates from 1 m to ``largest_m`` (S7.3).

    Without shift; maps that decrease with depth use raw scale and shift 0. ``loss`` is Eq. 14 over the
    ``visible`` pixels (docs/explanation/method.md, E8); some re-rendered left images by index.
    """
    left, right = (as_image_01(image, "image")[None] for image in (sample.left, sample.right))
    rays = plane_rays(left, [Camera(sample.K_left)], [Camera(sample.K_right)], [np.linalg.inv(sample.E)])
    x = smooth_floor(torch.from_numpy(np.asarray(relative, np.float32))[None, None])
    candidates = torch.from_numpy(np.geomspace(1.0, largest_m, PAPER.g_s_candidates).astype(np.float32))
    if not SPACES[space].grows_with_depth:
        x = F.softplus(torch.zeros(1)) * x + F.softplus(torch.zeros(1))

    def at(g_s: torch.Tensor) -> tuple[torch.Tensor, Any]:
        depth_m = SPACES[space].forward(x, g_s)
        return depth_m, warp_right_to_left(right, depth_m, rays)

    rows = []
    for g_s in candidates:
        depth_m, warped = at(g_s)
        loss = float(masked_mean(photometric_map(left, warped.image, PAPER.ssim_weight), warped.visible))
        error = evaluate_depth(depth_m[0, 0].numpy(), sample.depth_m, sample.valid)["abs_rel"]
        rows.append((float(g_s), loss, float(warped.visible.float().mean()), error))
    sweep = dict(zip(("g_s_m", "loss", "visible", "abs_rel"), np.array(rows).T, strict=True))
    # both optima, the last candidate, and others evenly between
    last = len(candidates) - 1
    chosen = dict.fromkeys([int(sweep["loss"].argmin()), int(sweep["abs_rel"].argmin()), last])
    chosen |= dict.fromkeys(np.linspace(0, last, SHOWN + 1).round().astype(int)[1:].tolist())
    shown = sorted(list(chosen)[:SHOWN])
    return sweep, {i: at(candidates[i])[1].image[0].permute(1, 2, 0).numpy() for i in shown}


def _sweep_curves(axes: Any, g_s_m: np.ndarray, loss: np.ndarray, abs_rel: np.ndarray) -> None:
    """Plot loss above error on a common logarithmic axis, with both optima marked in both."""
    best = (int(loss.argmin()), "--", "min L_geo"), (int(abs_rel.argmin()), ":", "min AbsRel")
    curves = (loss, "L_geo (visible)"), (abs_rel, "AbsRel")
    for axis, (values, name), line_colour in zip(axes, curves, COLOURS, strict=False):
        axis.plot(g_s_m, values, color=line_colour)
        for (index, line, what), colour in zip(best, COLOURS, strict=False):
            label = f"{what}: g_s = {g_s_m[index]:.3g} m"
            axis.axvline(g_s_m[index], color=colour, linestyle=line, linewidth=1.2, label=label)
        axis.set_xlim(0.95 * g_s_m[0], 1.05 * g_s_m[-1])  # an optimum at an end is visible too
        _name_axes(axis, "", name)
    axes[0].legend(fontsize=8)
    _plain_log_axis(axes[0].xaxis, float(g_s_m[0]), float(g_s_m[-1]))
    _plain_log_axis(axes[1].yaxis, float(abs_rel.min()), float(abs_rel.max()))
    axes[1].set_xlabel("global scale g_s, m", fontsize=9)


def draw_gs_sweep(options: FigureOptions) -> Drawing:
    """Plot L_geo and AbsRel of the first sample against g_s, with re-rendered left images (fig:lossAbs1)."""
    sample = load(select(options)[0]).check_ground_truth()
    prior = METHODS["prior-aligned"].run(sample, options.settings, PriorCache())
    assert prior.relative is not None  # an unguided call has no metric scale
    sweep, rendered = sweep_g_s(sample, prior.relative, prior.space, options.max)
    figure = _new_figure(8.6, 4.9)
    upper, lower = figure.subfigures(2, 1, height_ratios=[2.0, 1.0])
    _sweep_curves(upper.subplots(2, 1, sharex=True), sweep["g_s_m"], sweep["loss"], sweep["abs_rel"])
    shown: list[tuple[str, np.ndarray]] = [("left image", sample.left)]
    for index, rgb in rendered.items():
        title = f"g_s = {sweep['g_s_m'][index]:.3g} m\n{sweep['visible'][index]:.0%} in view"
        shown.append((title, rgb))
    for axes, (title, rgb) in zip(lower.subplots(1, len(shown)), shown, strict=True):
        axes.imshow(rgb, interpolation="antialiased")
        axes.set_title(title, fontsize=9)
        axes.set(xticks=[], yticks=[])
    curves = {name: values.tolist() for name, values in sweep.items()}
    return Drawing(figure, {"sample": sample.label} | curves)


#: Maximum relative error of the colour scale.
MAX_ERROR_SHOWN = 0.5


def orbit(centre_m: float) -> np.ndarray:
    """Return ``T_view_from_left`` ``(4, 4)`` of a camera orbiting left and up around a point on the axis."""
    T = np.eye(4)
    centre = np.array([0.0, 0.0, centre_m])
    T[:3, :3] = Rotation.from_euler("yx", [-25.0, 12.0], degrees=True).as_matrix()
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def render_cloud(
    depth_m: np.ndarray, image: np.ndarray, K: np.ndarray, T_view_from_left: np.ndarray
) -> np.ndarray:
    """Render the points of a depth map, coloured by its image (uint8), from a camera with the same K."""
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.nan)
    left, view = (
        DepthFrame("", depth_m, depth_m, PosedCamera(K, depth_m.shape[::-1], E=E))
        for E in (np.eye(4), np.linalg.inv(T_view_from_left))
    )
    seen_m, rgb = rendered(left, view, image)
    return np.where(seen_m[..., None] > 0, rgb, np.uint8(255))


class _Answer(NamedTuple):
    """Result of a method on a sample; an empty map without AbsRel if not applicable."""

    title: str
    depth_m: np.ndarray
    abs_rel: float | None


def _answer(sample: StereoSample, name: str, settings: Settings, priors: PriorCache) -> _Answer:
    method = find_method(name)
    try:
        prediction = method.run(sample, method.adapted(settings), priors)
    except NotApplicable as reason:
        return _Answer(f"{method.title}: {reason}", np.full(sample.depth_m.shape, np.nan), None)
    depth_m = in_metres(prediction, sample.depth_m, sample.valid)
    abs_rel = evaluate_depth(depth_m, sample.depth_m, sample.valid)["abs_rel"]
    if math.isnan(abs_rel):
        return _Answer(method.title, depth_m, None)
    return _Answer(f"{method.title}, AbsRel {abs_rel:.3f}", depth_m, abs_rel)


def _rows(
    sample: StereoSample, answers: Sequence[_Answer], clouds: bool
) -> tuple[list[np.ndarray], list[str], list[tuple[float, float] | None]]:
    """Return titled images of a sample: left image and depths, ground truth and errors, clouds.

    The last list has the range of the colours of each of these rows, if it needs a bar.
    """
    ground_truth = np.where(sample.valid, sample.depth_m, np.nan)
    near, far = depth_range(ground_truth)
    depths = [answer.depth_m for answer in answers]
    images = [sample.left]
    images += [colour_depth(depth_m, near=near, far=far) for depth_m in (*depths, ground_truth)]
    errors = [
        np.where(depth_m > 0, np.abs(depth_m - ground_truth) / ground_truth, np.nan) for depth_m in depths
    ]
    images += [colour_fraction(error, MAX_ERROR_SHOWN) for error in errors]
    titles = [
        sample.name,
        *(answer.title for answer in answers),
        f"ground truth, {near:.3g} m to {far:.3g} m",
    ]
    titles += [f"error, 0 to {MAX_ERROR_SHOWN:.0%} of the depth"] * len(answers)
    if clouds:
        view = orbit(float(np.median(sample.depth_m[sample.valid])))
        images += [
            render_cloud(depth_m, sample.left, sample.K_left, view) for depth_m in (ground_truth, *depths)
        ]
        titles += ["view from above left"] * (1 + len(answers))
    return images, titles, [(near, far), None, *[None] * clouds]


def draw_side_by_side(shown: Sequence[str], options: FigureOptions) -> Drawing:
    """Draw depth and errors of every method per sample; ``shown`` are methods without an option."""
    methods = options.methods or shown
    priors = PriorCache()
    cells = list[np.ndarray]()
    titles = list[str]()
    ranges = list[tuple[float, float] | None]()
    numbers = dict[str, Any]()
    for sample in [load(ref).check_ground_truth() for ref in select(options)]:
        answers = [_answer(sample, name, options.settings, priors) for name in methods]
        images, headings, of_rows = _rows(sample, answers, options.clouds)
        cells, titles, ranges = cells + images, titles + headings, ranges + of_rows
        numbers[sample.label] = {n: a.abs_rel for n, a in zip(methods, answers, strict=True)}
    sheet = grid(cells, titles, columns=1 + len(methods), depth_ranges=ranges)
    return Drawing(sheet, {"abs_rel": numbers})


def draw_risk_coverage(options: FigureOptions) -> Drawing:
    """Plot AbsRel of the most confident pixels against their fraction, and the best possible order."""
    refs = select(options)
    methods = list(options.methods or ("guided", "fast"))
    curves = mean_risk(_records(options, refs, methods))
    figure = _new_figure(5.2, 3.4)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    axes = figure.subplots()
    for (name, curve), colour in zip(curves.items(), COLOURS, strict=False):
        percent = 100.0 * (1.0 - np.arange(len(curve["risk"])) / len(curve["risk"]))
        axes.plot(percent, curve["risk"], color=colour, label=find_method(name).title)
        axes.plot(percent, curve["oracle"], color=colour, linestyle=":", label="ordered by error")
    _name_axes(axes, "coverage: most confident pixels, %", "AbsRel of these pixels")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)
    plain = {name: {of: list(map(float, values)) for of, values in c.items()} for name, c in curves.items()}
    return Drawing(figure, {"samples": [ref.label for ref in refs], "curves": plain})


#: All figures by name.
FIGURES: dict[str, Callable[[FigureOptions], Drawing]] = {
    "gs-sweep": draw_gs_sweep,
    "guidance-steps": draw_guidance_steps,
    "risk-coverage": draw_risk_coverage,
    "ablation": partial(draw_side_by_side, ("prior-aligned", "reprojection-only", "guided")),
    "qualitative": partial(draw_side_by_side, ("prior-aligned", "paper", "sweep-sgm", "guided")),
}


def run_figure(name: str, options: FigureOptions) -> Path:
    """Draw the figure ``options.name``, write it as PNG and its values as JSON; return the PNG's path."""
    figure, numbers = FIGURES[check_choice(options.name, "the figure", FIGURES)](options)
    path = options.out / f"figure-{options.name}.png"
    _save_png(figure, path)
    facts = run_facts(name, options)
    write_text(path.with_suffix(".json"), json.dumps(facts | numbers, indent=1) + "\n")
    return path
