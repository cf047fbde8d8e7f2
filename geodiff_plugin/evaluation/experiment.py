"""An experiment: cells (samples x methods x settings), measured and scored once, and its page of tables.

The cells of every command are the items of one ``Runner``: all resume, and processes may share them.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin import __version__
from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Camera, PosedCamera
from geodiff_plugin.evaluation import metrics
from geodiff_plugin.evaluation.baselines import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    find_method,
)
from geodiff_plugin.evaluation.baselines.unguided import sweep
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef, StereoSample, load
from geodiff_plugin.evaluation.datasets.sample import depth_to_disparity
from geodiff_plugin.evaluation.options import command_line
from geodiff_plugin.evaluation.tables import Table, label_of
from geodiff_plugin.formats import file_digest, write_depth_npy, write_text
from geodiff_plugin.jobs import BROKEN, Item, Journal, Record, Runner, Shard, fingerprint
from geodiff_plugin.matching import match_volume
from geodiff_plugin.matching.matches import RELIABLE
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from geodiff_plugin.runtime.machine import PeakMemory, versions

#: Journal of methods on samples, shared by several commands.
RECORDS_NAME = "samples.jsonl"
Tables = Callable[[list[Record]], Sequence[Table]]
#: Material classes that Booster's authors count as transparent or mirror when scoring depth.
TOM_CLASSES = (2, 3)
#: Number of points of the risk-coverage curves in records.
RISK_STEPS = 20
#: Minimum fraction of pixels with ground truth for edge metrics.
DENSE = 0.5

Scores = dict[str, float | None]


def run_facts(command: str, options: Any) -> dict[str, Any]:
    """Return command line, date, versions and machine of a run."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads"
    machine += f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    line = {"command": command_line(command, options), "date": date.today().isoformat()}
    return line | {"versions": versions() | {"opencv": cv2.__version__}, "machine": machine}


@dataclass(frozen=True)
class Page:
    """Result of a command: ``run_facts``, remarks above the tables, and the tables in reading order."""

    title: str
    facts: dict[str, Any]
    tables: tuple[Table, ...]
    remarks: tuple[str, ...]
    broken: tuple[str, ...] = ()  # skipped samples

    def origin(self) -> str:
        """Return date, versions and machine in one line."""
        named = ", ".join(f"{name} {value}" for name, value in self.facts["versions"].items())
        return f"{self.facts['date']}; {named}; {self.facts['machine']}."


def write_page(
    command: str, options: Any, title: str, tables: Iterable[Table], remarks: Sequence[str]
) -> Page:
    """Write non-empty tables to ``--out`` as Markdown (also to ``--results``), LaTeX and JSON."""
    shown = tuple(table for table in tables if table.rows)
    page = Page(title, run_facts(command, options), shown, tuple(remarks))
    head = [f"# {title}", f"    {page.facts['command']}", page.origin(), *remarks]
    text = "".join(f"{line}\n\n" for line in head) + "\n".join(table.markdown() for table in shown)
    path = options.out / f"{'table' if command == 'pairs' else command}.md"
    for target in filter(None, (path, options.results)):
        write_text(target, text)
    write_text(path.with_suffix(".tex"), "\n".join(table.latex() for table in shown))
    plain = page.facts | {"remarks": list(remarks), "tables": list(map(asdict, shown))}
    write_text(path.with_suffix(".json"), json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
    return page


@dataclass(frozen=True)
class Experiment:
    """Measurements of a command, and the presentation of their records on its page."""

    title: str
    cells: Sequence[Item]
    tables: Tables
    remarks: Callable[[list[Record]], Sequence[str]] = lambda records: ()  # remarks above the tables
    journal: str = ""  # file of the records in ``--out`` (default: the command's name)


def run_experiment(command: str, options: Any, experiment: Experiment) -> Page | None:
    """Measure cells without a record, and write the page; ``None`` while other shards have cells left."""
    records = measure_cells(experiment.cells, options, experiment.journal or f"{command}.jsonl")
    if records is None:
        return None
    tables, remarks = experiment.tables(records), experiment.remarks(records)
    page = write_page(command, options, experiment.title, tables, remarks)
    broken = dict.fromkeys(label_of(record) for record in records if record.get("status") == BROKEN)
    return replace(page, broken=tuple(broken))


def measure_cells(cells: Sequence[Item], options: Any, journal: str = RECORDS_NAME) -> list[Record] | None:
    """Return the records of cells, in order, measuring each key once; ``None`` as in ``run_experiment``.

    With several processes (``RANK``, ``WORLD_SIZE``) each takes every N-th sample.
    """
    shard = Shard.of(None)
    every = list({cell.key: cell for cell in cells}.values())
    samples = dict.fromkeys(_sample_of(cell) for cell in every)
    mine = set(shard.part(list(samples)))
    with Journal(options.out / journal, shard) as records, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Do not trust this depth")  # verdicts are in the records
        runner = Runner(
            [cell for cell in every if _sample_of(cell) in mine],
            records,
            noun="cell",
            is_recoverable=() if getattr(options, "stop_on_broken", True) else (OSError, ValueError),
            progress=not options.quiet,
            whole=_has_map,
        )
        own = {record["key"]: record for record in runner.run(lambda cell: cell.payload())}
        made = {key: record for (key, _), record in records.read().items()} | own
    if not all(cell.key in made for cell in every):
        return None
    return [made[cell.key] | dict(cell.head) for cell in cells]


def _sample_of(cell: Item) -> str:
    """Return the key shared by cells of one sample, which one process measures so that it is read once."""
    return str(cell.head.get("sample", cell.key))


def out_of_view(sample: StereoSample) -> np.ndarray:
    """``(H, W)`` bool: pixels with ground truth that project behind the right camera or outside its image."""
    height, width = sample.right.shape[:2]
    right = PosedCamera(sample.K_right, (width, height), E=sample.E_scored)
    px, _ = right.project(right.from_world(Camera(sample.K_left).unproject(sample.depth_m)))
    return sample.valid & ~right.contains(px)


@lru_cache(maxsize=1)
def matched(sample: StereoSample) -> np.ndarray | None:
    """``(H, W)`` bool: reliable matches of the package's sweep, on the CPU with ground-truth poses."""
    try:
        volume = sweep(replace(sample, E=sample.E_scored), "cpu")
    except ValueError:
        return None
    matches = match_volume(volume)
    reliable = (matches.confidence >= RELIABLE).float()
    return F.interpolate(reliable[None], sample.depth_m.shape, mode="nearest-exact")[0, 0].numpy() > 0


def regions(sample: StereoSample) -> dict[str, np.ndarray]:
    """Return region masks for AbsRel, ``(H, W)`` bool, within ``sample.valid``, as far as known."""
    masks = {"out_of_view": out_of_view(sample)}
    by_match = matched(sample)
    if by_match is not None:
        masks |= {"matched": by_match, "unmatched": ~by_match}
    if sample.occluded is not None:
        hidden = sample.occluded & ~masks["out_of_view"]
        masks |= {"occluded": hidden, "visible": ~hidden & ~masks["out_of_view"]}
    if sample.material is not None:
        tom = np.isin(sample.material, TOM_CLASSES)
        masks |= {"tom": tom, "not_tom": ~tom}
        for value in np.unique(sample.material[sample.valid]):
            masks[f"material_{int(value)}"] = sample.material == value
    return {name: sample.valid & mask for name, mask in masks.items()}


def _plain(scores: Mapping[str, float | None]) -> Scores:
    """Round to 7 digits; replace NaN by ``None`` for JSON."""
    return {k: None if v is None or math.isnan(v) else float(f"{v:.7g}") for k, v in scores.items()}


def _positive(depth_m: np.ndarray | None) -> np.ndarray:
    """Replace values that are not positive by NaN."""
    assert depth_m is not None  # a prediction has metres or a relative map
    return np.where(metrics.answered(depth_m), depth_m, np.nan)


def disparity_scores(sample: StereoSample, depth_m: np.ndarray) -> dict[str, Scores]:
    """``DISPARITY_METRICS`` of a rectified sample, for ``all`` pixels with ground truth and by region."""
    (pred_px, true_px), valid = _disparities(sample, depth_m), sample.valid
    masks = {"all": valid}
    hidden = sample.occluded
    if hidden is None and valid.mean() > DENSE:
        hidden = metrics.occluded_by_ground_truth(true_px, valid)
    if hidden is not None:
        masks["visible"] = valid & ~hidden & ~out_of_view(sample)
    edge = metrics.near_disparity_steps(true_px, valid)
    masks |= {"edge": edge, "flat": valid & ~edge}
    step_px = float(sample.notes.get("disparity_step_px", 0.0))
    return {
        name: _plain(metrics.evaluate_disparity(pred_px, true_px, mask, step_px))
        for name, mask in masks.items()
        if mask.any()
    }


def _disparities(sample: StereoSample, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return predicted and true disparity, ``(H, W)`` pixels, of a rectified sample; NaN in holes."""
    cameras = (sample.K_left, sample.K_right, sample.E_scored)
    true_px = depth_to_disparity(np.where(sample.valid, sample.depth_m, 1.0), *cameras)
    return depth_to_disparity(_positive(depth_m), *cameras), true_px


def benchmark_scores(sample: StereoSample, prediction: Prediction) -> Scores | None:
    """Return the fraction of bad pixels by the rules of the sample's benchmark; ``None`` if it has none.

    ``all``: pixels with ground truth, ``None`` if occluded pixels have none. ``noc``: without pixels that the
    data set marks as occluded, ``None`` without such a mask.
    """
    limit_px = DATASETS[sample.dataset].bad_px
    if limit_px is None or prediction.depth_m is None or not sample.rectified:
        return None
    pred_px, true_px = _disparities(sample, prediction.depth_m)
    masks = {"all": None if sample.notes.get("noc_only") else sample.valid}
    masks["noc"] = None if sample.occluded is None else sample.valid & ~sample.occluded
    scores: Scores = {"bad_px": limit_px}
    for name, mask in masks.items():
        scores[name] = None if mask is None else metrics.bad_fraction(pred_px, true_px, mask, limit_px)
    return _plain(scores)


def _metric_scores(sample: StereoSample, prediction: Prediction, kept: np.ndarray) -> dict[str, Any]:
    """Return the metrics of metric maps only; see ``score``."""
    depth_m, ground_truth, valid = prediction.depth_m, sample.depth_m, sample.valid
    names = ("disparity", "ause", "confidence", "ause_confidence", "risk_coverage", "boundaries")
    record: dict[str, Any] = dict.fromkeys(names)
    if depth_m is None:
        return record
    if sample.rectified:
        by_mask = disparity_scores(sample, depth_m)
        record["disparity"] = by_mask.pop("all") | {"regions": by_mask}
    if prediction.uncertainty is not None:
        record |= _plain({"ause": metrics.ause(depth_m, ground_truth, kept, prediction.uncertainty)})
    if (confidence := prediction.confidence) is not None:
        deciles = metrics.confidence_deciles(depth_m, ground_truth, kept, confidence, RIGHT_WITHIN)
        record["confidence"] = [_plain(decile) for decile in deciles]
        orders = {"ause": -confidence, "random": None}
        areas = {name: metrics.ause(depth_m, ground_truth, kept, order) for name, order in orders.items()}
        record["ause_confidence"] = _plain(areas)
        curve = metrics.risk_coverage(depth_m, ground_truth, kept, -confidence, RISK_STEPS)
        record["risk_coverage"] = {
            name: [float(f"{value:.7g}") for value in getattr(curve, name)] for name in ("risk", "oracle")
        }
    if valid.mean() > DENSE:
        f1 = {"f1": metrics.boundary_f1(depth_m, ground_truth, valid)}
        record["boundaries"] = _plain(f1 | metrics.boundary_errors(depth_m, ground_truth, valid))
    return record


def in_metres(prediction: Prediction, ground_truth: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return ``(H, W)`` metres as predicted; relative depth is aligned with ground truth."""
    if prediction.depth_m is not None:
        return prediction.depth_m
    assert prediction.relative is not None  # a prediction has one of the two
    return metrics.align(prediction.relative, ground_truth, kept, prediction.space)


def score(sample: StereoSample, prediction: Prediction, cap_m: float | None) -> dict[str, Any]:
    """Return all metrics of one prediction as JSON values; ``None`` if not applicable.

    ``capped`` ignores ground truth from ``cap_m`` metres on, as do ``regions``. ``ValueError`` for a map of
    the wrong shape or a sample without ground truth.
    """
    ground_truth, valid = sample.depth_m, sample.valid
    for name in ("depth_m", "relative", "uncertainty", "confidence"):
        values = getattr(prediction, name)
        if values is not None and values.shape != ground_truth.shape:
            bad_value(f"prediction.{name}", f"of the left image's shape {ground_truth.shape}", values.shape)
    sample.check_ground_truth()
    values, depth_m, space = prediction.relative, prediction.depth_m, prediction.space
    if values is None:
        # Metric maps are aligned in the prior's space, as its relative map would be.
        values = depth_m if space == "depth" else metrics.to_space(_positive(depth_m), space)

    def both(cap: float | None) -> dict[str, Scores | None]:
        aligned_m = metrics.align(values, ground_truth, metrics.counted(ground_truth, valid, cap), space)
        raw = None if depth_m is None else _plain(metrics.evaluate_depth(depth_m, ground_truth, valid, cap))
        return {"raw": raw, "aligned": _plain(metrics.evaluate_depth(aligned_m, ground_truth, valid, cap))}

    record: dict[str, Any] = {"all_pixels": both(None)}
    record["capped"] = record["all_pixels"] if cap_m is None else both(cap_m)
    kept = metrics.counted(ground_truth, valid, cap_m)
    shown_m = in_metres(prediction, ground_truth, kept)
    errors = {}
    for name, mask in regions(sample).items():
        if (mask & kept).any():
            errors[name] = metrics.evaluate_depth(shown_m, ground_truth, mask & kept, cap_m)["abs_rel"]
    return record | _metric_scores(sample, prediction, kept) | {"regions": _plain(errors)}


def cell_key(ref: SampleRef, method: str, configuration: dict[str, Any], prior: str = "") -> str:
    """Return the key of a result, from the content of a sample's files (not paths) and all settings."""
    files = {name: value for name, value in ref.files.items() if value is not None}
    return fingerprint(method, configuration, prior, __version__, ref.dataset, ref.name, files)


def _measure(
    ref: SampleRef,
    read: Callable[[SampleRef], StereoSample],
    method: Method,
    settings: Settings,
    priors: PriorCache,
    path: Path | None,
) -> Record:
    """Run one method on one sample and score it; save its depth map to ``path``, if given."""
    sample = read(ref)
    process = {"process": Shard.of(None).index}
    try:
        prediction, cost = _timed_run(method, sample, settings, priors)
    except NotApplicable as reason:
        return {"rectified": sample.rectified, "status": "not applicable", "reason": str(reason)} | process
    scores = score(sample, prediction, DATASETS[sample.dataset].cap_m)
    scores["benchmark"] = benchmark_scores(sample, prediction)
    notes = {"notes": {"sample": dict(sample.notes), "method": dict(prediction.notes)}}
    saved = {} if path is None or prediction.depth_m is None else {"map": _save_map(path, prediction.depth_m)}
    return {"rectified": sample.rectified, "status": "ok"} | cost | scores | notes | saved | process


def _timed_run(
    method: Method, sample: StereoSample, settings: Settings, priors: PriorCache
) -> tuple[Prediction, dict[str, float]]:
    """Return the prediction of a method with its seconds and peak memory.

    The seconds include work that the cache of evidence saved, as if the method had run alone.
    """
    priors.evidence.take_spared_seconds()  # sets them to zero
    start = time.perf_counter()
    with PeakMemory(torch.device(settings.device)) as memory:
        prediction = method.run(sample, settings, priors)
    seconds = time.perf_counter() - start + priors.evidence.take_spared_seconds()
    return prediction, {"seconds": round(seconds, 3), "peak_bytes": memory.peak_bytes}


def _save_map(path: Path, depth_m: np.ndarray) -> str:
    """Write a depth map and return the digest of its file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth_npy(path, depth_m)
    return file_digest(path)


def _has_map(cell: Item, record: Record) -> bool:
    """Whether the map that a cell saves exists, and has the same settings."""
    path = cell.payload.keywords.get("path")
    if path is None or record["status"] != "ok" or record["all_pixels"]["raw"] is None:
        return True
    return path.is_file() and record.get("map") == file_digest(path)


def map_path(out: Path, method: str, dataset: str, sample: str) -> Path:
    """Return the file in ``--out`` to which the depth map of a method on a sample is saved."""
    return out / "depth" / re.sub(r"[^\w.=+-]+", "_", method) / f"{dataset}_{sample}.npy"


def method_cells(
    refs: Sequence[SampleRef], methods: Sequence[str], settings: Settings, out: Path, save_depth: bool = False
) -> list[Item]:
    """Return a cell per method and sample in ``RECORDS_NAME``; with ``save_depth`` also saves maps."""
    # One sample, read once, is used for all its methods.
    shard = Shard.of(None)
    priors = PriorCache()
    read = lru_cache(maxsize=1)(load)
    several = not shard.whole
    if several and settings.device == "cuda":
        settings = replace(settings, device=f"cuda:{shard.local % torch.cuda.device_count()}")
    cells = []
    for ref, method in product(refs, map(find_method, methods)):
        chosen = method.adapted(settings)
        prior = f"{chosen.prior} {priors.fingerprint(chosen)}" if method.uses_prior else ""
        device = chosen.device.partition(":")[0] if several else chosen.device
        configuration = method.configuration(replace(chosen, device=device))
        path = map_path(out, method.name, ref.dataset, ref.name) if save_depth else None
        work = partial(_measure, ref, read, method, chosen, priors, path=path)
        head = {"dataset": ref.dataset, "sample": ref.name, "method": method.name}
        key = cell_key(ref, method.base_name, configuration, prior)
        name = f"{ref.label}, {method.name}"
        cells.append(Item(key, work, name=name, words=(method.name,), head=head))
    return cells
