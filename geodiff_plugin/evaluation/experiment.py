"""An experiment: cells (samples x methods x settings), each measured once, and tables of their records.

Every command of the evaluation declares one ``Experiment``. Its cells are the items of one ``Runner``, so
that all of them resume, are shared by several processes and report failures in the same way.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.outside import map_name
from geodiff_plugin.evaluation.datasets import DATASETS, load
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.evaluation.metrics import crop_mask
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.evaluation.table import Table
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.runner import Item, Journal, Record, Runner, fingerprint, this_process
from geodiff_plugin.runtime.machine import PeakMemory

__all__ = ["RECORDS_NAME", "Experiment", "cell_key", "headline", "last_of", "method_cells", "measure_cells"]

RECORDS_NAME = "samples.jsonl"
"""Journal of methods on samples, which several commands share."""


@dataclass(frozen=True)
class Experiment:
    """What a command of the evaluation measures and shows.

    Attributes:
        name: stem of the page's files.
        title: heading of the page.
        cells: what is measured; the payload of each is a function without arguments that returns the body of
            its
            record.
        tables: of the records of all cells, in their order.
        remarks: sentences above the tables, likewise.
        purpose: what the page is for.
        journal: name of the file of records; ``<name>.jsonl`` by default.
    """

    name: str
    title: str
    cells: Sequence[Item]
    tables: Callable[[list[Record]], Sequence[Table]]
    remarks: Callable[[list[Record]], Sequence[str]] = field(default=lambda records: ())
    purpose: str = ""
    journal: str = ""

    def run(self, options: Any, command: str) -> Page | None:
        """Measure the cells that have no record yet, and write the page.

        Args:
            options: with ``out`` and ``quiet``, and where the command has them ``results`` and
                ``skip_broken``.
            command: that repeats the run.

        Returns:
            The page; ``None`` in every process but the first.

        Raises:
            ValueError: bad options, or a broken sample without ``skip_broken``.
            OSError: missing or unreadable files, likewise.
        """
        records = measure_cells(self.cells, options, self.journal or f"{self.name}.jsonl")
        if records is None:
            return None
        tables = tuple(table for table in self.tables(records) if table.rows)
        page = Page(self.title, run_facts(command), tables, tuple(self.remarks(records)), self.purpose)
        write_page(page, options.out, self.name, getattr(options, "results", None))
        return page


def measure_cells(cells: Sequence[Item], options: Any, journal: str = RECORDS_NAME) -> list[Record] | None:
    """The records of cells, in order; ``None`` in every process but the first.

    A cell that stands several times, or under several names (``guided@bundled`` beside ``guided``), is
    measured once; a record has the ``head`` of its cell, whichever of them it was made for.
    """
    unique = {cell.key: cell for cell in cells}
    runner = Runner(
        list(unique.values()),
        Journal(options.out / journal),
        noun="cell",
        survives=(OSError, ValueError) if getattr(options, "skip_broken", False) else (),
        progress=not options.quiet,
        show=_running_means,
        whole=_has_map,
    )
    records = {record["key"]: record for record in runner.run(lambda cell: cell.payload())}
    if runner.process.index > 0:
        return None
    return [records[cell.key] | dict(cell.head) for cell in cells if cell.key in records]


def headline(record: Record) -> float | None:
    """AbsRel over all pixels with truth: not aligned, or aligned for a method without metres."""
    if record["status"] != "ok":
        return None
    both = record["all_pixels"]
    return (both["raw"] or both["aligned"])["abs_rel"]


def _running_means(records: Sequence[Record]) -> dict[str, str]:
    """AbsRel so far of every method."""
    values: dict[str, list[float]] = {}
    for record in records:
        value = headline(record) if "all_pixels" in record else record.get("abs_rel")
        if value is not None:
            values.setdefault(record.get("method", "AbsRel"), []).append(value)
    return {name: f"{np.mean(each):.3f}" for name, each in values.items()}


def cell_key(ref: SampleRef, method: str, configuration: dict[str, Any], prior: str = "") -> str:
    """Name of a result: the same inputs give the same key, anything else another.

    Args:
        ref: the sample; not where its files lie but what is in them counts, and its other entries (cameras,
            views). A folder counts by the files of it that the sample names as well.
        method: its name.
        configuration: everything that changes the method's result beside the prior, JSON values.
        prior: name and fingerprint of the prior, empty for a method without one.
    """
    files = {name: value for name, value in ref.files.items() if value is not None}
    return fingerprint(method, configuration, prior, __version__, ref.dataset, ref.name, files)


def last_of(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """``make`` that remembers what it made last, for the same object: one sample serves all its methods."""
    kept: list[Any] = [None, None]

    def get(source: Any) -> Any:
        if kept[0] is not source:
            kept[:] = [None, None]  # two samples are not in memory at a time
            kept[:] = [source, make(source)]
        return kept[1]

    return get


@lru_cache(maxsize=1)
def _cropped(sample: StereoSample, crop: str) -> StereoSample:
    """The sample with the truth inside of a crop only; images and cameras stay whole."""
    valid = sample.valid & crop_mask(crop, sample.valid.shape)
    if not valid.any():
        bad_value(f"the truth of {sample.label}", f"known somewhere in the crop {crop}", "unknown there")
    return sample if crop == "none" else replace(sample, valid=valid)


def method_cells(
    refs: Sequence[SampleRef],
    methods: Sequence[str],
    settings: Settings,
    out: Path,
    *,
    crop: str = "none",
    save_depth: bool = False,
) -> list[Item]:
    """A cell for every method on every sample, all of ``RECORDS_NAME``.

    Args:
        refs: samples.
        methods: names that ``find_method`` knows.
        settings: the user's choices, the same for every method.
        out: folder of the records.
        crop: region of the image that is scored, one of ``metrics.CROPS``.
        save_depth: write each metric depth map to ``out/depth/<method>/<dataset>_<sample>.npy``, where the
            method ``files:out/depth/<method>`` finds it; a record without its map is made again.

    Returns:
        Cells whose records have ``status`` ``"ok"``, ``"not applicable"`` (``reason``) or ``"broken"``
        (``error``); for the numbers see ``scoring.score``.

    Raises:
        ValueError: an unknown method; two samples of one name.
    """
    process, priors, read = this_process(), PriorCache(), last_of(load)
    if process.count > 1 and settings.device == "cuda":
        settings = replace(settings, device=f"cuda:{process.local % torch.cuda.device_count()}")
    cells = []
    for ref in refs:
        for method in map(find_method, methods):
            chosen = method.own_settings(settings)
            prior = f"{chosen.prior} {priors.fingerprint(chosen)}" if method.uses_prior else ""
            configured = replace(
                chosen, device=chosen.device.partition(":")[0] if process.count > 1 else chosen.device
            )
            configuration = method.configuration(configured) | ({} if crop == "none" else {"crop": crop})
            key = cell_key(ref, method.base_name, configuration, prior)
            path = None
            if save_depth:
                folder = re.sub(r"[^\w.=+-]+", "_", method.name)
                path = out / "depth" / folder / f"{map_name(ref.dataset, ref.name)}.npy"
            head = {"dataset": ref.dataset, "sample": ref.name, "method": method.name}
            work = partial(_measure, ref, read, method, chosen, priors, crop, path)
            cells.append(Item(key, work, name=f"{ref.label}, {method.name}", words=(method.name,), head=head))
    return cells


def _has_map(cell: Item, record: Record) -> bool:
    """Whether the map that a cell is to save is there, and not that of other settings in its place."""
    path = (
        cell.payload.args[-1] if isinstance(cell.payload, partial) and cell.payload.func is _measure else None
    )
    if path is None or record["status"] != "ok" or record["all_pixels"]["raw"] is None:
        return True
    return path.is_file() and record.get("map") == file_digest(path)


def _measure(
    ref: SampleRef,
    read: Callable[[SampleRef], StereoSample],
    method: Method,
    settings: Settings,
    priors: PriorCache,
    crop: str,
    path: Path | None,
) -> Record:
    """Run and score one method on one sample; its seconds are those that it takes alone."""
    sample, process = read(ref), {"process": this_process().index}
    priors.evidence.take_spared_seconds()
    start = time.perf_counter()
    try:
        with PeakMemory(torch.device(settings.device)) as memory:
            prediction = method.run(sample, settings, priors)
    except NotApplicable as reason:
        return {"rectified": sample.rectified, "status": "not applicable", "reason": str(reason)} | process
    seconds = time.perf_counter() - start + priors.evidence.take_spared_seconds()
    scores = score(_cropped(sample, crop), prediction, DATASETS[sample.dataset].cap_m)
    notes = {"sample": dict(sample.notes), "method": dict(prediction.notes)}
    cost = {"seconds": round(seconds, 3), "peak_bytes": memory.peak_bytes}
    saved = {} if path is None else _save(path, prediction)
    return {"rectified": sample.rectified, "status": "ok", **cost, **scores, "notes": notes} | saved | process


def _save(path: Path, prediction: Prediction) -> Record:
    if prediction.depth_m is None:
        return {}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth_npy(path, prediction.depth_m)
    return {"map": file_digest(path)}
