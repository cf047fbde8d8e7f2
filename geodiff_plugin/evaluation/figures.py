"""The paper's figures on any data set, one function each, one table (Figures 5 and 6, S7.3, S9, S11)."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import check_choice
from geodiff_plugin.algorithm.terms import masked_mean, photometric_map
from geodiff_plugin.evaluation.baselines import METHODS, NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load
from geodiff_plugin.evaluation.datasets.changed import changed_ref
from geodiff_plugin.evaluation.experiment import measure_cells, method_cells, run_facts
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.evaluation.options import FigureOptions, all_refs, select
from geodiff_plugin.evaluation.tables import (
    ValueOf,
    count_of_pairs,
    headline,
    mean_with_interval,
)
from geodiff_plugin.formats import as_image_01, atomic_path
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.geometry import project, resize_intrinsics, transform, unproject, warp_right_to_left
from geodiff_plugin.plotting import colour_depth, colour_share, depth_range, grid, ticks
from geodiff_plugin.runner import Record
from geodiff_plugin.scale.space import SPACES, smooth_floor

#: A picture or a figure of matplotlib, and what it shows as JSON values.
Drawing = tuple[Any, dict[str, Any]]
DPI = 90
#: Colours of lines, in order (Okabe and Ito's, distinguishable for the colour-blind), and their markers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = "osD^vP"
EXPOSURE_METHODS = ("paper", "guided", "sgbm")
#: Half and twice the light, and the steps between; also exponents.
GAINS = (0.5, 0.7, 1.0, 1.4, 2.0)
PRESETS = ("guided", "paper")


def _new_figure(width_in: float, height_in: float) -> Any:
    """An empty figure that lays itself out; it belongs to no global state."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def _save_png(picture: Any, path: Path) -> None:
    """Write a picture whole or not at all, in 256 colours, which are enough and a third of the size."""
    if isinstance(picture, Figure):
        drawn = io.BytesIO()
        picture.savefig(drawn, format="png", metadata={"Software": None})
        picture = Image.open(drawn).convert("RGB")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        picture.quantize(256, kmeans=1, dither=Image.Dither.NONE).save(temporary, format="PNG", optimize=True)


def _style(index: int) -> dict[str, Any]:
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)], "markersize": 4}


def _name_axes(axes: Any, x_name: str, y_name: str, x: Sequence[float] = ()) -> None:
    """Names, and for a logarithmic abscissa its values."""
    if x:
        axes.set_xscale("log")
        axes.set_xticks(x, labels=[f"{value:g}" for value in x])
        axes.minorticks_off()
    axes.set_xlabel(x_name, fontsize=9)
    axes.set_ylabel(y_name, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def _plain_log_axis(axis: Any, low: float, high: float) -> None:
    """A logarithmic axis with round numbers instead of powers."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    values = ticks(low, max(high, 1.01 * low), 7)
    axis.set_ticks(values, labels=[f"{value:g}" for value in values])
    axis.set_minor_locator(NullLocator())


def _references(options: FigureOptions) -> list[SampleRef]:
    """The samples that a figure shows, their poses perturbed where the options say so."""
    return options.changed(select(all_refs(options), options))


def _records(options: FigureOptions, refs: Sequence[SampleRef], methods: Sequence[str]) -> list[Record]:
    return measure_cells(method_cells(refs, methods, options.settings, options.out), options) or []


def _curve(
    axes: Any,
    x: Sequence[float],
    groups: Sequence[Sequence[Record]],
    value_of: ValueOf,
    index: int,
    name: str,
) -> list[float | None]:
    """A line through the mean of each group, with a band where all have intervals; returns the means."""
    of_groups = [[value_of(record) for record in group if record["status"] == "ok"] for group in groups]
    means = [mean_with_interval([v for v in values if v is not None]) for values in of_groups]
    known = [(at, mean) for at, mean in zip(x, means, strict=True) if mean.count]
    at, marks = [place for place, _ in known], _style(index)
    if known:
        axes.plot(at, [mean.value for _, mean in known], label=find_method(name).title, **marks)
    if known and all(mean.low is not None for _, mean in known):
        low, high = [mean.low for _, mean in known], [mean.high for _, mean in known]
        axes.fill_between(at, low, high, color=marks["color"], alpha=0.15, linewidth=0)
    return [mean.value if mean.count else None for mean in means]


def draw_inner_steps(options: FigureOptions) -> Drawing:
    """Error and seconds against updates per denoising step, for both presets."""
    updates, refs = sorted(set(options.updates)), _references(options)
    methods = {preset: [f"{preset}:inner_steps={n}" for n in updates] for preset in PRESETS}
    records = _records(options, refs, [name for names in methods.values() for name in names])
    figure = _new_figure(7.6, 3.1)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs], "updates": updates}
    numbers |= {preset: {} for preset in PRESETS}
    quantities: dict[str, tuple[str, ValueOf]] = {
        "abs_rel": ("AbsRel", headline),
        "seconds": ("seconds a pair", itemgetter("seconds")),
    }
    panels = figure.subplots(1, 2)
    for axes, (key, (title, value_of)) in zip(panels, quantities.items(), strict=True):
        for index, (preset, names) in enumerate(methods.items()):
            groups = [[record for record in records if record["method"] == name] for name in names]
            numbers[preset][key] = _curve(axes, updates, groups, value_of, index, preset)
        _name_axes(axes, "updates per denoising step", title, updates)
        axes.set_ylim(bottom=0)
    panels[1].legend(fontsize=8)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    return figure, numbers


def draw_exposure(options: FigureOptions) -> Drawing:
    """Error against gain and against gamma of the right view; the left view stays as it is."""
    methods, refs = options.methods or EXPOSURE_METHODS, _references(options)
    changes = {"gain": [(gain, 1.0) for gain in GAINS], "gamma": [(1.0, gamma) for gamma in GAINS]}
    every = dict.fromkeys(changes["gain"] + changes["gamma"])
    exposed = {change: [changed_ref(ref, "right_exposure", change) for ref in refs] for change in every}
    records = _records(options, [ref for changed in exposed.values() for ref in changed], methods)
    figure = _new_figure(7.6, 3.1)
    numbers: dict[str, Any] = {"samples": [ref.label for ref in refs]}
    panels, drawn = figure.subplots(1, 2, sharey=True), list[float]()
    for axes, name in zip(panels, changes, strict=True):
        numbers[name] = {"values": list(GAINS)}
        samples = [{ref.name for ref in exposed[change]} for change in changes[name]]
        for index, method in enumerate(methods):
            measured = [record for record in records if record["method"] == method]
            groups = [[record for record in measured if record["sample"] in names] for names in samples]
            numbers[name][method] = _curve(axes, GAINS, groups, headline, index, method)
            drawn += [value for value in numbers[name][method] if value]
        _name_axes(axes, f"{name} of the right view", "AbsRel" if name == "gain" else "", GAINS)
    if drawn:  # errors of good and bad methods are decades apart
        _plain_log_axis(panels[0].yaxis, min(drawn), max(drawn))
    panels[0].legend(fontsize=8)
    figure.suptitle(count_of_pairs(len(refs)), fontsize=9)
    return figure, numbers


LIGHT = np.array([-0.4, -0.5, 0.77])


def shaded(depth_m: np.ndarray, focal_px: float) -> np.ndarray:
    """``(H, W)`` in [0, 1]: the surface lit from the upper left, so that roughness shows."""
    rows, columns = np.gradient(np.log(np.maximum(depth_m, 1e-6)))
    normal = np.stack([-columns * focal_px, -rows * focal_px, np.ones_like(rows)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.clip(normal @ LIGHT, 0.0, 1.0)


def draw_strength(
    records: Sequence[Record], oracle: str, pictures: Mapping[str, np.ndarray], path: Path
) -> None:
    """Write the PNG of ``geodiff eval strength``: errors against that of the method ``oracle``.

    ``pictures`` are shaded crops by their titles.
    """
    figure = _new_figure(11.0, 4.4)
    grid = figure.add_gridspec(2, 4)
    axes = figure.add_subplot(grid[:, :2])
    errors: dict[str, dict[str, list[float]]] = {}
    for record in records:
        of_method = errors.setdefault(record["method"], {})
        of_method.setdefault(record["strength"], []).append(record["abs_rel"])
    at = {strength: float(np.mean(values)) for strength, values in errors.pop(oracle).items()}
    ordered = sorted(at, key=at.__getitem__)
    for index, (method, values) in enumerate(errors.items()):
        means = [float(np.mean(values[strength])) for strength in ordered]
        axes.plot([at[s] for s in ordered], means, label=find_method(method).title, **_style(index))
    ends = (min(at.values()) * 0.8, max(at.values()) * 1.2)
    axes.plot(ends, ends, color="0.6", linestyle="--", linewidth=1, label=find_method(oracle).title)
    axes.set(xscale="log", yscale="log")
    _name_axes(axes, "AbsRel of the prior, aligned by an oracle", "AbsRel in metres")
    axes.legend(fontsize=8)
    for k, (title, picture) in enumerate(pictures.items()):
        panel = figure.add_subplot(grid[k // 2, 2 + k % 2])
        panel.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        panel.set_title(title, fontsize=8)
        panel.set_axis_off()
    _save_png(figure, path)


#: Candidates, as many as the one-number search of the paper preset has; weight of SSIM; pictures shown.
CANDIDATES, ETA, SHOWN = 80, 0.85, 4


def sweep_g_s(
    sample: StereoSample, relative: np.ndarray, space: str, largest_m: float
) -> tuple[dict[str, np.ndarray], dict[int, np.ndarray]]:
    """Scale a relative map by every candidate: ``x = g_s * x_rel``, without shift.

    A map that falls with depth has no depth at 0 without a shift: it gets that of raw scale and shift 0.

    ``relative`` is ``(H, W)``, about [0, 1], affine in ``space``; candidates go from 1 m to ``largest_m``.

    Returns:
        ``(M,)`` each: ``g_s_m`` metres, ``loss`` (Eq. 14) over the ``visible`` share of pixels, ``abs_rel``;
        and by index some ``(H, W, 3)`` left images in [0, 1], re-rendered from the right one.

    Source: S7.3. Deviation: L_geo is the mean over the visible pixels, not over all
    (docs/reference/paper-map.md, E8).
    """
    left, right = (as_image_01(image, "image")[None] for image in (sample.left, sample.right))
    matrices = (sample.K_left, sample.K_right, np.linalg.inv(sample.E))
    cameras = [torch.as_tensor(matrix, dtype=torch.float32)[None] for matrix in matrices]
    x = smooth_floor(torch.from_numpy(np.asarray(relative, np.float32))[None, None])
    candidates = torch.from_numpy(np.geomspace(1.0, largest_m, CANDIDATES).astype(np.float32))
    scale, shift = torch.ones(1), torch.zeros(1)
    if not SPACES[space].grows_with_depth:
        scale = shift = F.softplus(torch.zeros(1))

    def at(g_s: torch.Tensor) -> tuple[torch.Tensor, Any]:
        depth_m = SPACES[space].forward(scale * x + shift, g_s)
        return depth_m, warp_right_to_left(right, depth_m, *cameras)

    rows = []
    for g_s in candidates:
        depth_m, warped = at(g_s)
        loss = float(masked_mean(photometric_map(left, warped.image, ETA), warped.visible))
        error = evaluate_depth(depth_m[0, 0].numpy(), sample.depth_m, sample.valid)["abs_rel"]
        rows.append((float(g_s), loss, float(warped.visible.float().mean()), error))
    sweep = dict(zip(("g_s_m", "loss", "visible", "abs_rel"), np.array(rows).T, strict=True))
    # Both optima, the last candidate, and others evenly between.
    chosen = dict.fromkeys([int(sweep["loss"].argmin()), int(sweep["abs_rel"].argmin()), CANDIDATES - 1])
    chosen |= dict.fromkeys(np.linspace(0, CANDIDATES - 1, SHOWN + 1).round().astype(int)[1:].tolist())
    shown = sorted(list(chosen)[:SHOWN])
    return sweep, {i: at(candidates[i])[1].image[0].permute(1, 2, 0).numpy() for i in shown}


def _sweep_curves(axes: Any, g_s_m: np.ndarray, loss: np.ndarray, abs_rel: np.ndarray) -> None:
    """Loss above error on one logarithmic axis, both optima marked in both."""
    best = (int(loss.argmin()), "--", "least L_geo"), (int(abs_rel.argmin()), ":", "least AbsRel")
    curves = (loss, "L_geo (visible)"), (abs_rel, "AbsRel")
    for axis, (values, name), line_colour in zip(axes, curves, COLOURS, strict=False):
        axis.plot(g_s_m, values, color=line_colour)
        for (index, line, what), colour in zip(best, COLOURS, strict=False):
            label = f"{what}: g_s = {g_s_m[index]:.3g} m"
            axis.axvline(g_s_m[index], color=colour, linestyle=line, linewidth=1.2, label=label)
        axis.set_xlim(0.95 * g_s_m[0], 1.05 * g_s_m[-1])  # an optimum at an end is seen too
        _name_axes(axis, "", name)
    axes[0].legend(fontsize=8)
    _plain_log_axis(axes[0].xaxis, float(g_s_m[0]), float(g_s_m[-1]))
    _plain_log_axis(axes[1].yaxis, float(abs_rel.min()), float(abs_rel.max()))
    axes[1].set_xlabel("global scale g_s, m", fontsize=9)


def draw_gs_sweep(options: FigureOptions) -> Drawing:
    """L_geo and AbsRel of the first sample against g_s, with re-rendered left images (fig:lossAbs1)."""
    sample = load(_references(options)[0]).check_truth()
    prior = METHODS["prior-aligned"].run(sample, options.settings, PriorCache())
    assert prior.relative is not None
    sweep, rendered = sweep_g_s(sample, prior.relative, prior.space, options.max)
    figure = _new_figure(8.6, 4.9)
    upper, lower = figure.subfigures(2, 1, height_ratios=[2.0, 1.0])
    _sweep_curves(upper.subplots(2, 1, sharex=True), sweep["g_s_m"], sweep["loss"], sweep["abs_rel"])
    shown: list[tuple[str, np.ndarray]] = [("left image", sample.left)]
    for index, picture in rendered.items():
        title = f"g_s = {sweep['g_s_m'][index]:.3g} m\n{sweep['visible'][index]:.0%} in view"
        shown.append((title, picture))
    for axes, (title, picture) in zip(lower.subplots(1, len(shown)), shown, strict=True):
        axes.imshow(picture, interpolation="antialiased")
        axes.set_title(title, fontsize=9)
        axes.set(xticks=[], yticks=[])
    return figure, {"sample": sample.label} | {name: values.tolist() for name, values in sweep.items()}


ABLATION_METHODS = ("prior-aligned", "reprojection-only", "guided")
QUALITATIVE_METHODS = ("prior-aligned", "paper", "sweep-sgm", "guided")
YAW_DEGREES, PITCH_DEGREES = -25.0, 12.0
#: A picture of points is drawn this much smaller than the map that they come from, which closes its holes.
SHRINK = 0.6
#: The largest relative error that has a colour of its own.
WORST_SHOWN = 0.5


def orbit(centre_m: float) -> np.ndarray:
    """``T_view_from_left`` ``(4, 4)`` of a camera that swung left and up around a point on the axis."""
    T, centre = np.eye(4), np.array([0.0, 0.0, centre_m])
    T[:3, :3] = Rotation.from_euler("yx", [YAW_DEGREES, PITCH_DEGREES], degrees=True).as_matrix()
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


def render_cloud(
    depth_m: np.ndarray, image: np.ndarray, K: np.ndarray, T_view_from_left: np.ndarray
) -> np.ndarray:
    """Points of a depth map, in the colours of its image, from another camera, the nearest in every pixel.

    Returns:
        ``(H', W', 3)`` uint8, ``SHRINK`` times the size, white where no point lies.
    """
    height, width = depth_m.shape
    size = (round(height * SHRINK), round(width * SHRINK))
    known = np.isfinite(depth_m) & (depth_m > 0)
    z_left = torch.from_numpy(np.where(known, depth_m, 1.0).astype(np.float32))[None, None]
    K_left, T = (torch.from_numpy(matrix.astype(np.float32))[None] for matrix in (K, T_view_from_left))
    points = transform(unproject(z_left, K_left), T)
    uv, z = project(points, resize_intrinsics(K_left, (height, width), size))
    at = uv.round().long().view(-1, 2)
    inside = (at >= 0).all(1) & (at[:, 0] < size[1]) & (at[:, 1] < size[0])
    keep = inside & torch.from_numpy(known).view(-1)
    target, z = (at[:, 1] * size[1] + at[:, 0])[keep], z.view(-1)[keep]
    colours = torch.from_numpy(np.ascontiguousarray(image)).view(-1, 3)[keep]
    # Far to near, and a stable sort: the last point written into a pixel is its nearest one.
    order = torch.argsort(z, descending=True, stable=True).numpy()
    picture = np.full((size[0] * size[1], 3), 255, np.uint8)
    picture[target.numpy()[order]] = colours.numpy()[order]
    return picture.reshape(*size, 3)


def _answer(
    sample: StereoSample, name: str, settings: Settings, priors: PriorCache
) -> tuple[str, np.ndarray | None, float | None]:
    """Title, depth ``(H, W)`` and AbsRel of a method, both ``None`` where it cannot work on the sample.

    Relative depth gets scale and shift from the truth; an empty map has no AbsRel.
    """
    method = find_method(name)
    try:
        prediction = method.run(sample, method.own_settings(settings), priors)
    except NotApplicable as reason:
        return f"{method.title}: {reason}", None, None
    depth_m = prediction.depth_m
    if depth_m is None:
        assert prediction.relative is not None
        depth_m = align(prediction.relative, sample.depth_m, sample.valid, prediction.space)
    abs_rel = evaluate_depth(depth_m, sample.depth_m, sample.valid)["abs_rel"]
    if math.isnan(abs_rel):
        return method.title, depth_m, None
    return f"{method.title}, AbsRel {abs_rel:.3f}", depth_m, abs_rel


def _relative_error(depth_m: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """``(H, W)``, NaN without truth or prediction."""
    return np.where(depth_m > 0, np.abs(depth_m - truth) / truth, np.nan)


def _rows(
    sample: StereoSample, answers: Sequence[tuple[str, np.ndarray | None, Any]], clouds: bool
) -> tuple[list[np.ndarray], list[str]]:
    """Pictures of a sample, with titles: depth beside the left image, errors beside the truth, clouds."""
    truth = np.where(sample.valid, sample.depth_m, np.nan)
    near, far = depth_range(truth)
    depths = [np.full(truth.shape, np.nan) if depth_m is None else depth_m for _, depth_m, _ in answers]
    pictures = [sample.left]
    pictures += [colour_depth(depth_m, near=near, far=far) for depth_m in (*depths, truth)]
    pictures += [colour_share(_relative_error(depth_m, truth), WORST_SHOWN) for depth_m in depths]
    titles = [sample.name, *(title for title, _, _ in answers), f"truth, {near:.3g} m to {far:.3g} m"]
    titles += [f"error, 0 to {WORST_SHOWN:.0%} of the depth"] * len(answers)
    if clouds:
        view = orbit(float(np.median(sample.depth_m[sample.valid])))
        pictures += [render_cloud(depth_m, sample.left, sample.K_left, view) for depth_m in (truth, *depths)]
        titles += ["from the left, above"] * (1 + len(answers))
    return pictures, titles


def _side_by_side(options: FigureOptions, methods: Sequence[str]) -> Drawing:
    samples, priors = [load(ref).check_truth() for ref in _references(options)], PriorCache()
    cells, titles, numbers = list[np.ndarray](), list[str](), dict[str, Any]()
    for sample in samples:
        answers = [_answer(sample, name, options.settings, priors) for name in methods]
        pictures, headings = _rows(sample, answers, options.clouds)
        cells, titles = cells + pictures, titles + headings
        numbers[sample.label] = {n: abs_rel for n, (_, _, abs_rel) in zip(methods, answers, strict=True)}
    return grid(cells, titles, columns=1 + len(methods)), {"abs_rel": numbers}


def draw_ablation(options: FigureOptions) -> Drawing:
    """The prior, the reprojection loss without diffusion, and both together."""
    return _side_by_side(options, options.methods or ABLATION_METHODS)


def draw_qualitative(options: FigureOptions) -> Drawing:
    """Every chosen method."""
    return _side_by_side(options, options.methods or QUALITATIVE_METHODS)


FIGURES: dict[str, Callable[[FigureOptions], Drawing]] = {
    "gs-sweep": draw_gs_sweep,
    "inner-steps": draw_inner_steps,
    "ablation": draw_ablation,
    "exposure": draw_exposure,
    "qualitative": draw_qualitative,
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
    _save_png(figure, path)
    facts = run_facts(name, options)
    write_text(path.with_suffix(".json"), json.dumps(facts | numbers, indent=1) + "\n")
    return path
