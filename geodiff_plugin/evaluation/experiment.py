"""An experiment: cells (samples x methods x settings), each measured and scored once, and its page of tables.

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
from geodiff_plugin._checks import bad_value
from geodiff_plugin.capture.agreement import seen_in
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
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Record, Shard, fingerprint
from geodiff_plugin.jobs.runner import Runner
from geodiff_plugin.matching import match_volume
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from geodiff_plugin.runtime.machine import PeakMemory, versions
from geodiff_plugin.types import DepthFrame

#: Journal of methods on samples, which several commands share.
RECORDS_NAME = "samples.jsonl"
Tables = Callable[[list[Record]], Sequence[Table]]
#: Material classes that Booster's authors call transparent or mirror when they score depth.
TOM_CLASSES = (2, 3)
#: Share of pixels with truth from which on its edges are there to be measured.
DENSE = 0.5
#: Confidence from which on a match of our plane sweep counts as one.
RELIABLE_MATCH = 0.5

Scores = dict[str, float | None]


def run_facts(command: str, options: Any) -> dict[str, Any]:
    """Command line, date, versions and machine of a run."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads"
    machine += f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    line = {"command": command_line(command, options), "date": date.today().isoformat()}
    return line | {"versions": versions() | {"opencv": cv2.__version__}, "machine": machine}


@dataclass(frozen=True)
class Page:
    """What a command measured: ``run_facts``, sentences above the tables, and the tables in reading order."""

    title: str
    facts: dict[str, Any]
    tables: tuple[Table, ...]
    remarks: tuple[str, ...]
    broken: tuple[str, ...] = ()  # samples that are left out

    def origin(self) -> str:
        """One line: date, versions, machine."""
        named = ", ".join(f"{name} {value}" for name, value in self.facts["versions"].items())
        return f"{self.facts['date']}; {named}; {self.facts['machine']}."


def write_page(
    command: str, options: Any, title: str, tables: Iterable[Table], remarks: Sequence[str]
) -> Page:
    """Write the tables that have rows into ``--out``: Markdown, which ``--results`` gets too, LaTeX, JSON."""
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
    """What a command measures, and how its page shows the records of that."""

    title: str
    cells: Sequence[Item]
    tables: Tables
    remarks: Callable[[list[Record]], Sequence[str]] = lambda records: ()  # sentences above the tables
    journal: str = ""  # file of the records in ``--out``, by default of the command's name


def run_experiment(command: str, options: Any, experiment: Experiment) -> Page | None:
    """Measure the cells without a record, and write the page; ``None`` while other shards have cells left."""
    records = measure_cells(experiment.cells, options, experiment.journal or f"{command}.jsonl")
    if records is None:
        return None
    tables, remarks = experiment.tables(records), experiment.remarks(records)
    page = write_page(command, options, experiment.title, tables, remarks)
    broken = dict.fromkeys(label_of(record) for record in records if record.get("status") == BROKEN)
    return replace(page, broken=tuple(broken))


def measure_cells(cells: Sequence[Item], options: Any, journal: str = RECORDS_NAME) -> list[Record] | None:
    """The records of cells, in order, those of one key measured once; ``None`` as ``run_experiment``.

    Of several processes (``RANK``, ``WORLD_SIZE``) each takes every so many-th sample.
    """
    shard, every = Shard.of(None), list({cell.key: cell for cell in cells}.values())
    samples = dict.fromkeys(_sample_of(cell) for cell in every)
    mine = set(shard.part(list(samples)))
    with Journal(options.out / journal, shard) as records, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Do not trust this depth")  # verdicts are in the records
        runner = Runner(
            [cell for cell in every if _sample_of(cell) in mine],
            records,
            noun="cell",
            survives=() if getattr(options, "stop_on_broken", True) else (OSError, ValueError),
            progress=not options.quiet,
            whole=_has_map,
        )
        own = {record["key"]: record for record in runner.run(lambda cell: cell.payload())}
        made = {key: record for (key, _), record in records.read().items()} | own
    if not all(cell.key in made for cell in every):
        return None
    return [made[cell.key] | dict(cell.head) for cell in cells]


def _sample_of(cell: Item) -> str:
    """What cells have in common that one process should measure, as it is read once for all of them."""
    return str(cell.head.get("sample", cell.key))


def out_of_view(sample: StereoSample) -> np.ndarray:
    """``(H, W)`` bool: pixels with truth that the true depth puts behind or beside the right image."""
    left = DepthFrame("left", sample.depth_m, sample.valid, sample.K_left, np.eye(4))
    right = DepthFrame("right", sample.right[..., 0], sample.right[..., 0], sample.K_right, sample.E_scored)
    return sample.valid & ~seen_in(left, right).inside


@lru_cache(maxsize=1)
def matched(sample: StereoSample) -> np.ndarray | None:
    """``(H, W)`` bool: where our sweep, on the CPU and by the true poses, has a reliable match."""
    try:
        volume = sweep(replace(sample, E=sample.E_scored), "cpu")
    except ValueError:
        return None
    matches = match_volume(volume)
    reliable = (matches.confidence >= RELIABLE_MATCH).float()
    return F.interpolate(reliable[None], sample.depth_m.shape, mode="nearest-exact")[0, 0].numpy() > 0


def regions(sample: StereoSample) -> dict[str, np.ndarray]:
    """Masks by which AbsRel is split, ``(H, W)`` bool, within ``sample.valid``, as far as they are known."""
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
    """Rounded to 7 digits; NaN becomes ``None``, which JSON has a word for."""
    return {k: None if v is None or math.isnan(v) else float(f"{v:.7g}") for k, v in scores.items()}


def _positive(depth_m: np.ndarray | None) -> np.ndarray:
    """The map with NaN where it is not a positive number."""
    assert depth_m is not None  # a prediction has metres where it has no relative map
    return np.where(metrics.answered(depth_m), depth_m, np.nan)


def disparity_scores(sample: StereoSample, depth_m: np.ndarray) -> dict[str, Scores]:
    """``DISPARITY_METRICS`` of a rectified sample, of ``all`` pixels with truth and by region."""
    cameras, valid = (sample.K_left, sample.K_right, sample.E_scored), sample.valid
    true_px = depth_to_disparity(np.where(valid, sample.depth_m, 1.0), *cameras)
    pred_px = depth_to_disparity(_positive(depth_m), *cameras)
    masks, hidden = {"all": valid}, sample.occluded
    if hidden is None and valid.mean() > DENSE:
        hidden = metrics.hidden_by_truth(true_px, valid)
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


def _metric_scores(sample: StereoSample, prediction: Prediction, kept: np.ndarray) -> dict[str, Any]:
    """What only a map in metres has: see ``score``."""
    depth_m, truth, valid = prediction.depth_m, sample.depth_m, sample.valid
    names = ("disparity", "ause", "confidence", "ause_confidence", "boundaries")
    record: dict[str, Any] = dict.fromkeys(names)
    if depth_m is None:
        return record
    if sample.rectified:
        by_mask = disparity_scores(sample, depth_m)
        record["disparity"] = by_mask.pop("all") | {"regions": by_mask}
    if prediction.uncertainty is not None:
        record |= _plain({"ause": metrics.ause(depth_m, truth, kept, prediction.uncertainty)})
    if (confidence := prediction.confidence) is not None:
        deciles = metrics.confidence_deciles(depth_m, truth, kept, confidence, RIGHT_WITHIN)
        record["confidence"] = [_plain(decile) for decile in deciles]
        orders = {"ause": -confidence, "random": None}
        areas = {name: metrics.ause(depth_m, truth, kept, order) for name, order in orders.items()}
        record["ause_confidence"] = _plain(areas)
    if valid.mean() > DENSE:
        f1 = {"f1": metrics.boundary_f1(depth_m, truth, valid)}
        record["boundaries"] = _plain(f1 | metrics.boundary_errors(depth_m, truth, valid))
    return record


def in_metres(prediction: Prediction, truth: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """``(H, W)`` metres as they come out; of relative depth, aligned with the truth."""
    if prediction.depth_m is not None:
        return prediction.depth_m
    assert prediction.relative is not None  # a prediction has one of the two
    return metrics.align(prediction.relative, truth, kept, prediction.space)


def score(sample: StereoSample, prediction: Prediction, cap_m: float | None) -> dict[str, Any]:
    """Every metric of one prediction, as JSON values; ``None`` where it does not apply.

    ``capped`` is without truth from ``cap_m`` metres on, and so are ``regions``. ``ValueError`` for a map of
    the wrong shape or a sample without truth.
    """
    truth, valid = sample.depth_m, sample.valid
    for name in ("depth_m", "relative", "uncertainty", "confidence"):
        values = getattr(prediction, name)
        if values is not None and values.shape != truth.shape:
            bad_value(f"prediction.{name}", f"of the left image's shape {truth.shape}", values.shape)
    sample.check_truth()
    values, depth_m, space = prediction.relative, prediction.depth_m, prediction.space
    if values is None:
        # Metres are aligned in the prior's own space, as its relative map would be.
        values = depth_m if space == "depth" else metrics.to_space(_positive(depth_m), space)

    def both(cap: float | None) -> dict[str, Scores | None]:
        aligned_m = metrics.align(values, truth, metrics.counted(truth, valid, cap), space)
        raw = None if depth_m is None else _plain(metrics.evaluate_depth(depth_m, truth, valid, cap))
        return {"raw": raw, "aligned": _plain(metrics.evaluate_depth(aligned_m, truth, valid, cap))}

    record: dict[str, Any] = {"all_pixels": both(None)}
    record["capped"] = record["all_pixels"] if cap_m is None else both(cap_m)
    kept = metrics.counted(truth, valid, cap_m)
    shown_m, errors = in_metres(prediction, truth, kept), {}
    for name, mask in regions(sample).items():
        if (mask & kept).any():
            errors[name] = metrics.evaluate_depth(shown_m, truth, mask & kept, cap_m)["abs_rel"]
    return record | _metric_scores(sample, prediction, kept) | {"regions": _plain(errors)}


def cell_key(ref: SampleRef, method: str, configuration: dict[str, Any], prior: str = "") -> str:
    """Name of a result: it changes with what is in a sample's files, wherever they lie, and all else."""
    files = {name: value for name, value in ref.files.items() if value is not None}
    return fingerprint(method, configuration, prior, __version__, ref.dataset, ref.name, files)


def _measure(
    ref: SampleRef, read: Any, method: Method, settings: Settings, priors: PriorCache, path: Path | None
) -> Record:
    """Run one method on one sample and score it; the seconds are those that the method takes alone."""
    sample, process = read(ref), {"process": Shard.of(None).index}
    priors.evidence.take_spared_seconds()
    start = time.perf_counter()
    try:
        with PeakMemory(torch.device(settings.device)) as memory:
            prediction = method.run(sample, settings, priors)
    except NotApplicable as reason:
        return {"rectified": sample.rectified, "status": "not applicable", "reason": str(reason)} | process
    seconds = time.perf_counter() - start + priors.evidence.take_spared_seconds()
    cost = {"seconds": round(seconds, 3), "peak_bytes": memory.peak_bytes}
    scores = score(sample, prediction, DATASETS[sample.dataset].cap_m)
    notes: dict[str, Any] = {"notes": {"sample": dict(sample.notes), "method": dict(prediction.notes)}}
    if path is not None and prediction.depth_m is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_depth_npy(path, prediction.depth_m)
        notes["map"] = file_digest(path)
    return {"rectified": sample.rectified, "status": "ok"} | cost | scores | notes | process


def _has_map(cell: Item, record: Record) -> bool:
    """Whether the map that a cell is to save is there, and not that of other settings in its place."""
    path = cell.payload.keywords.get("path")
    if path is None or record["status"] != "ok" or record["all_pixels"]["raw"] is None:
        return True
    return path.is_file() and record.get("map") == file_digest(path)


def method_cells(
    refs: Sequence[SampleRef], methods: Sequence[str], settings: Settings, out: Path, save_depth: bool = False
) -> list[Item]:
    """A cell for every method on every sample, all of ``RECORDS_NAME``; with ``save_depth`` also maps."""
    # One sample, read once, serves all its methods.
    shard, priors, read = Shard.of(None), PriorCache(), lru_cache(maxsize=1)(load)
    several = not shard.whole
    if several and settings.device == "cuda":
        settings = replace(settings, device=f"cuda:{shard.local % torch.cuda.device_count()}")
    cells = []
    for ref, method in product(refs, map(find_method, methods)):
        chosen = method.adapted(settings)
        prior = f"{chosen.prior} {priors.fingerprint(chosen)}" if method.uses_prior else ""
        device = chosen.device.partition(":")[0] if several else chosen.device
        configuration = method.configuration(replace(chosen, device=device))
        folder = out / "depth" / re.sub(r"[^\w.=+-]+", "_", method.name)
        path = folder / f"{ref.dataset}_{ref.name}.npy" if save_depth else None
        work = partial(_measure, ref, read, method, chosen, priors, path=path)
        head = {"dataset": ref.dataset, "sample": ref.name, "method": method.name}
        key, name = cell_key(ref, method.base_name, configuration, prior), f"{ref.label}, {method.name}"
        cells.append(Item(key, work, name=name, words=(method.name,), head=head))
    return cells
