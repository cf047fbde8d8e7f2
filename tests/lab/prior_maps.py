"""Guided calls with depth maps that have errors, compared with the map itself and the default prior.

The maps are ground truth, holes filled with the nearest depth, times an error of ``MAP_ERRORS``, or maps from
a folder, such as a stereo network's. The table is in docs/reference/results.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.evaluation.baselines import NotApplicable, Prediction, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.baselines.guided import guided_map
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, data_of, find_pairs, load
from geodiff_plugin.evaluation.experiment import Experiment, Page, cell_key, run_experiment
from geodiff_plugin.evaluation.metrics import evaluate_depth, filled
from geodiff_plugin.evaluation.tables import Table, grouped
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.jobs.journal import Item, Record
from tests.lab.options import MAP_ERRORS, MapError, PriorMapsOptions
from tests.lab.strength import SMOOTH

#: Row of a pair without a map: the default method.
DEFAULT_PRIOR = "default"
#: Side of a square patch, as a fraction of the longer image side.
PATCH = 0.1
#: Fraction of the patches with an error.
PATCHED = 0.3

NOTE = (
    "AbsRel in metres. far: ground truth with depth beyond the median times 0.9; smooth: times a smooth "
    "field of 1, 5, 10 or 15 %; patches: 30 % of the image in squares of a tenth of its longer side, each "
    "times a lognormal factor (0.4). Ratio: the result over the better of map and default."
)

Predict = Callable[[StereoSample, Settings, PriorCache], Prediction]


def map_with_error(sample: StereoSample, error: MapError, seed: int = 0) -> np.ndarray:
    """Return ground truth without holes times an error, ``(H, W)`` float64, metres."""
    depth_m = filled(sample.depth_m, sample.valid)
    rng = np.random.default_rng([seed, 53])
    height, width = depth_m.shape
    side = max(height, width)
    field = ndimage.gaussian_filter(rng.normal(size=depth_m.shape), SMOOTH * side, mode="reflect")
    log_error = error.smooth * (field - field.mean()) / field.std()
    patch = max(1, round(PATCH * side))
    cells = -(-height // patch), -(-width // patch)
    values = rng.normal(size=cells) * (rng.uniform(size=cells) < PATCHED)
    log_error += error.patches * np.kron(values, np.ones((patch, patch)))[:height, :width]
    far = np.where(depth_m > np.median(depth_m[sample.valid]), error.far, 1.0)
    return depth_m * far * np.exp(log_error)


def _predicted(name: str, options: PriorMapsOptions) -> list[Predict]:
    """Return the predictions to score for a row: the map alone, if any, and the guided result."""
    if name == DEFAULT_PRIOR:
        return [find_method("guided").run]
    if name not in MAP_ERRORS:
        return [find_method(f"{use}:{name}").run for use in ("files", "prior-map")]
    error = MAP_ERRORS[name]

    def alone(sample: StereoSample, *_: Any) -> Prediction:
        return Prediction(map_with_error(sample, error, options.seed))

    def guided(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        depth_m = map_with_error(sample, error, options.seed).astype(np.float32)
        return guided_map(depth_m, "depth", sample, settings, priors, GeometryGuidance)

    return [alone, guided]


def _measure(name: str, options: PriorMapsOptions, read: Any, ref: SampleRef, priors: PriorCache) -> Record:
    """Measure AbsRel of one map on a pair, alone and guided; empty if there is no map for it."""
    sample, scores = read(ref), []
    try:
        for predict in _predicted(name, options):
            depth_m = predict(sample, options.settings, priors).depth_m
            assert depth_m is not None  # metric maps
            scores.append(evaluate_depth(depth_m, sample.depth_m, sample.valid)["abs_rel"])
    except NotApplicable:
        return {}
    return {"result": scores[-1]} | ({"map": scores[0]} if len(scores) > 1 else {})


def ratios(records: Iterable[Record]) -> list[Record]:
    """Join the maps of every pair with its default: records with ``default`` and ``ratio``, worst last."""
    rows = list[Record]()
    for of_pair in grouped(records, "pair").values():
        default = next(float(r["result"]) for r in of_pair if r["error"] == DEFAULT_PRIOR)
        for record in of_pair:
            if "map" in record:
                ratio = record["result"] / min(record["map"], default)
                rows.append(record | {"default": default, "ratio": ratio})
    return sorted(rows, key=lambda row: row["ratio"])


def prior_maps_tables(records: Sequence[Record]) -> list[Table]:
    """Make a table with a row per pair and map, worst ratio last."""
    header = ("pair", "map", "AbsRel: map", "default", "result", "ratio")
    rows = []
    for row in ratios(records):
        cells = (f"{row[name]:.4f}" for name in ("map", "default", "result"))
        rows.append((row["pair"], row["error"], *cells, f"{row['ratio']:.2f}"))
    return [Table("Guided depth maps", header, tuple(rows), NOTE)]


def run(name: str, options: PriorMapsOptions) -> Page | None:
    """Measure every map on every pair, and write the page; errors as in ``run_experiment``."""
    refs = [ref for root in options.data or (data_of(options),) for ref in find_pairs(root)]
    refs = [ref for ref in refs if not options.scenes or any(word in ref.label for word in options.scenes)]
    refs = refs[: options.limit]
    if not refs:
        bad_value("--data", "a folder with pairs", " ".join(map(str, options.data)))
    priors, read, cells = PriorCache(), lru_cache(maxsize=1)(load), []
    settings, guided = options.settings, find_method("guided")
    prior = priors.fingerprint(settings)
    for ref, error in product(refs, (DEFAULT_PRIOR, *options.errors, *options.maps)):
        chosen = guided if error in (DEFAULT_PRIOR, *MAP_ERRORS) else find_method(f"prior-map:{error}")
        key = cell_key(ref, error, chosen.configuration(settings), prior)
        head = {"pair": ref.label, "error": error}
        work = partial(_measure, error, options, read, ref, priors)
        cells.append(Item(key, work, name=", ".join(head.values()), head=head))
    remark = f"Default prior {settings.prior}, seed {options.seed}."
    return run_experiment(
        name, options, Experiment("Prior maps", cells, prior_maps_tables, lambda _: [remark])
    )
