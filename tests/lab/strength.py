"""Guidance with emulated priors of a chosen error (docs/appendix/strength.md).

Only the network is emulated: it answers ``(1 - follow) z0* + follow z0(z_t)``, ``z0*`` the code of the
erroneous ground truth, ``z0(z_t)`` implied by its input, so that the next step sees an edit of one step.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from scipy import ndimage
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.algorithm.denoising import output_from
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.evaluation import tables
from geodiff_plugin.evaluation.baselines import NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, data_of, find_pairs, load
from geodiff_plugin.evaluation.experiment import DENSE, Experiment, Page, cell_key, in_metres, run_experiment
from geodiff_plugin.evaluation.metrics import evaluate_depth, filled, to_space
from geodiff_plugin.evaluation.tables import CellOf, Table, max_of, mean_of, method_title
from geodiff_plugin.jobs.journal import Item, Record
from geodiff_plugin.priors import prior_of
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.noise_levels import noise_level
from tests.lab.edges import edge_error, surface_error
from tests.lab.options import STRENGTHS, Strength, StrengthOptions

NOTE = (
    "Prior error: mean absolute error of the log depth, half of it smooth and half constant over image "
    "segments; blur: 1 % and a blurred map; gamma: a map raised to the power 1.6, which no scale and shift "
    "can undo. AbsRel and δ1 in metres without alignment, except for the prior with oracle. At edges: AbsRel "
    "within 3 px of ground-truth edges. Surfaces: error of the slope of log depth away from edges, per mille "
    "per pixel."
)

COLUMNS: dict[str, CellOf] = {
    "prior error": lambda group: str(group[0]["strength"]),
    "method": method_title,
    "AbsRel": mean_of("abs_rel", 4),
    "δ1": mean_of("delta1", 4),
    "at edges": mean_of("edges", 4),
    "surfaces": mean_of("surfaces", 2),
    "worst AbsRel": max_of("abs_rel"),
}
#: What a prior calls 0 and 1: the quantiles of Marigold's training; the rest of the map lies beyond them.
ENDS = (0.02, 0.98)
#: Standard deviation of the smooth half of the error, as a fraction of the longer side.
SMOOTH = 0.12
#: Spacing of the segments of the other half, as a fraction of the longer side.
SEGMENTS = 0.16
#: Standard deviation of the blur, as a fraction of the longer side.
BLUR = 0.012


def relative_map(sample: StereoSample, strength: Strength, space: str, seed: int = 0) -> np.ndarray:
    """``(H, W)`` float64 in [0, 1], the map of a prior that errs in a given way, alike in every space."""
    log_depth = np.log(filled(sample.depth_m, sample.valid))
    rng = np.random.default_rng([seed, 47])
    log_depth = log_depth + strength.error * _error(log_depth, rng)
    values = to_space(np.exp(log_depth), space)
    if strength.blurred:
        values = ndimage.gaussian_filter(values, BLUR * max(values.shape), mode="nearest")
    low, high = np.quantile(values, ENDS)
    return np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0) ** strength.gamma


def _error(log_depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """``(H, W)`` of mean absolute value 1, median 0: half smooth, half constant over parts of one depth."""
    height, width = log_depth.shape
    side = max(height, width)
    smooth = ndimage.gaussian_filter(rng.normal(size=(height, width)), SMOOTH * side, mode="reflect")
    span = max(float(np.ptp(np.quantile(log_depth, ENDS))), 1e-3)
    seeds = max(4, round(height * width / (SEGMENTS * side) ** 2))
    centres = np.stack([rng.uniform(0, height, seeds), rng.uniform(0, width, seeds)], 1)
    depths = log_depth[tuple(centres.astype(int).T)]
    rows, columns = np.mgrid[:height, :width]
    best, label = np.full((height, width), np.inf), np.zeros((height, width), int)
    for k, ((row, column), depth) in enumerate(zip(centres, depths, strict=True)):
        away = ((rows - row) ** 2 + (columns - column) ** 2) / (SEGMENTS * side) ** 2
        away = away + (4.0 * (log_depth - depth) / span) ** 2
        closer = away < best
        best[closer], label[closer] = away[closer], k
    segments = rng.normal(size=seeds)[label]
    field = sum(part / max(float(part.std()), 1e-9) for part in (smooth, segments))
    field -= np.median(field)
    return field / max(float(np.abs(field).mean()), 1e-9)


class _Denoiser(ModelMixin, ConfigMixin):
    """Stands where the U-Net stands; ``code`` is what it answers with."""

    @register_to_config
    def __init__(self, follow: float = 0.3) -> None:
        super().__init__()
        self.unit = torch.nn.Parameter(torch.ones(()))
        self.scheduler: Any = None
        self.code: Tensor | None = None
        self._noise: Tensor | None = None
        self._last: Tensor | None = None

    def forward(self, sample: Tensor, timestep: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor]:
        assert self.code is not None  # set by ``EmulatedPrior.answer``
        z_t = sample[:, -self.code.shape[1] :].float()
        level = noise_level(self.scheduler, timestep)
        z0 = self.code.expand_as(z_t)
        starts = self._last is None or timestep >= self._last  # a schedule falls, so this one is new
        self._last = timestep
        if not starts and self._noise is not None:
            implied = (z_t - level.sigma * self._noise) / level.alpha
            z0 = (1.0 - self.config.follow) * z0 + self.config.follow * implied
        self._noise = (z_t - level.alpha * z0) / level.sigma  # what its input holds next to that
        return (output_from(z0, self._noise, level)[0].to(sample.dtype),)


class EmulatedPrior(PriorCache):
    """The bundled pipeline with an emulated network, affine in ``space``, whatever prior is asked for."""

    def __init__(self, space: str = "disparity", follow: float = 0.3) -> None:
        super().__init__()
        self.space, self.pipe = space, enable_geometry_guidance(load_bundled_prior())
        self.pipe.register_to_config(prediction_type=space)
        self.pipe.unet = _Denoiser(follow)
        self.pipe.unet.scheduler = self.pipe.scheduler
        self.pipe.set_progress_bar_config(disable=True)

    def get(self, settings: Settings) -> Any:
        """The emulated pipeline, whatever prior the settings name."""
        return self.pipe

    @torch.no_grad()
    def answer(self, sample: StereoSample, strength: Strength, resolution: int, seed: int = 0) -> None:
        """Let the network answer for a sample, in calls whose ``processing_resolution`` is this one."""
        relative = torch.from_numpy(relative_map(sample, strength, self.space, seed))[None, None].float()
        image = torch.from_numpy(sample.left).permute(2, 0, 1)[None].float() / 255.0
        padded, padding, _ = self.pipe.image_processor.preprocess(image, resolution, "bilinear", "cpu")
        size = tuple(side - pad for side, pad in zip(padded.shape[-2:], padding, strict=True))
        small = F.interpolate(relative, size, mode="bilinear", antialias=True)
        small = F.pad(small, (0, padding[1], 0, padding[0]), mode="replicate")
        self.pipe.unet.code = prior_of(self.pipe).encode(small).float()


def _measure(
    prior: EmulatedPrior, options: StrengthOptions, read: Any, ref: SampleRef, strength: str, name: str
) -> Record:
    """Measure one method at one strength on a pair with dense ground truth; relative depth is aligned."""
    sample, method = read(ref), find_method(name)
    ground_truth = (sample.depth_m, sample.valid)
    if sample.valid.mean() < DENSE:
        bad_value("--data", f"pairs with truth on {DENSE:.0%} of their pixels or more", sample.label)
    prior.answer(sample, STRENGTHS[strength], options.resolution, options.seed)
    try:
        prediction = method.run(sample, method.adapted(options.settings), prior)
    except NotApplicable as reason:
        bad_value("--methods", "methods that work on every pair", f"{name}, not on {sample.label}: {reason}")
    depth_m = in_metres(prediction, *ground_truth)
    scores = evaluate_depth(depth_m, *ground_truth)
    kind = {"rectified": bool(sample.rectified), "rendered": sample.dataset == "synthetic"}
    errors = {"edges": edge_error(depth_m, *ground_truth), "surfaces": surface_error(depth_m, *ground_truth)}
    return kind | {"abs_rel": scores["abs_rel"], "delta1": scores["delta1"]} | errors


def against_table(title: str, records: Sequence[Record], reference: str = "guided") -> Table:
    """Paired differences in AbsRel, the reference minus every other method, at each strength."""
    header = ("prior error", "against", "pairs", "mean difference [95 %]", "% of its error", "pairs won")
    note = "Negative: smaller error than the other method. Significant if the interval excludes 0."
    rows = list[tuple[str, ...]]()
    for strength, of_strength in tables.grouped(records, "strength").items():
        # Every method has every pair, in one order; two pairs of two folders may have one name.
        errors = {
            method: {str(i): float(record["abs_rel"]) for i, record in enumerate(group)}
            for method, group in tables.grouped(of_strength, "method").items()
        }
        own = errors.pop(reference, {})
        for method, other in errors.items() if own else ():
            difference = tables.paired_difference(own, other)
            fraction = 100.0 * difference.value / float(np.mean(list(other.values())))
            won = f"{sum(own[i] < other[i] for i in own)} of {len(own)}"
            cells = (str(len(own)), difference.cell(4, "+"), f"{fraction:+.1f}", won)
            rows.append((str(strength), find_method(method).title, *cells))
    return Table(
        f"{title}: {find_method(reference).title} against each other method", header, tuple(rows), note
    )


def strength_tables(records: Sequence[Record]) -> list[Table]:
    """Two tables a group of pairs: strengths by methods, and the default against the others."""
    groups = {
        "All pairs": list(records),
        "Rendered, rectified": [r for r in records if r["rendered"] and r["rectified"]],
        "Rendered, any pose": [r for r in records if r["rendered"] and not r["rectified"]],
        "Real": [r for r in records if not r["rendered"]],
    }
    names, page = ("strength", "method"), list[Table]()
    for title, group in groups.items():
        if group:
            # Not by label: pairs of one name in two folders are two.
            pairs = tables.count_of_pairs(max(map(len, tables.grouped(group, *names).values())))
            page.append(tables.table_of_groups(title, group, names, COLUMNS, f"{pairs}. {NOTE}"))
            page.append(against_table(title, group))
    return page


def run(name: str, options: StrengthOptions) -> Page | None:
    """Measure every method at every strength, and write the page; errors as ``run_experiment``."""
    for method in map(find_method, options.methods):
        if not method.uses_prior or method.prior is not None:
            bad_value("--methods", "methods that use a prior, none named after an @", repr(method.name))
    refs = [ref for root in options.data or (data_of(options),) for ref in find_pairs(root)[: options.limit]]
    if not refs:
        bad_value("--data", "a folder with pairs", " ".join(map(str, options.data)))
    prior, read, cells = EmulatedPrior(options.space, options.follow), lru_cache(maxsize=1)(load), []
    for ref, strength, method_name in product(refs, options.strengths, options.methods):
        method = find_method(method_name)
        configuration = method.configuration(method.adapted(options.settings))
        emulated = f"emulated {options.space} {options.follow} {strength} {options.seed}"
        head = {"pair": ref.label, "strength": strength, "method": method_name}
        work = partial(_measure, prior, options, read, ref, strength, method_name)
        key = cell_key(ref, method_name, configuration, emulated)
        cells.append(Item(key, work, name=", ".join(head.values()), head=head))

    said = f"Emulated priors, affine in {options.space}, input weight {options.follow:g}; "
    said += f"processed at {options.resolution} px, {options.steps} steps, seed {options.seed}."
    of_priors = Experiment("Effect of prior quality", cells, strength_tables, lambda _: [said])
    return run_experiment(name, options, of_priors)
