"""An experiment: cells (samples x methods x settings), each measured once, and tables of their records.

Every command of the evaluation declares one ``Experiment``. Its cells are the items of one ``Runner``, so
that all of them resume, are shared by several processes and report failures in the same way.
"""

from __future__ import annotations

import json
import os
import platform
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import Method, NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.baselines.unguided import map_name
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef, StereoSample, load
from geodiff_plugin.evaluation.metrics import crop_mask
from geodiff_plugin.evaluation.options import command_line
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.evaluation.tables import Table
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.runner import Item, Journal, Record, Runner, fingerprint, this_process
from geodiff_plugin.runtime.machine import PeakMemory, versions

RECORDS_NAME = "samples.jsonl"
"""Journal of methods on samples, which several commands share."""


def run_facts(command: str, options: Any) -> dict[str, Any]:
    """Command line, date, versions and machine of a run."""
    used = versions()
    try:
        used["opencv"] = version("opencv-python-headless")
    except PackageNotFoundError:
        used["opencv"] = "not installed"
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads"
    if torch.cuda.is_available():
        machine += f", {torch.cuda.get_device_name()}"
    return {
        "command": command_line(command, options),
        "date": date.today().isoformat(),
        "versions": used,
        "machine": machine,
    }


@dataclass(frozen=True)
class Page:
    """What a command of the evaluation measured.

    Attributes:
        title: heading.
        facts: of ``run_facts``.
        tables: in reading order.
        remarks: sentences that belong above the tables, e.g. how many samples were broken.
        purpose: what the page is for, its first line; "" where the title says it.
    """

    title: str
    facts: dict[str, Any]
    tables: tuple[Table, ...]
    remarks: tuple[str, ...] = ()
    purpose: str = ""

    def origin(self) -> str:
        """One line: date, versions, machine."""
        named = ", ".join(f"{name} {value}" for name, value in self.facts["versions"].items())
        return f"{self.facts['date']}; {named}; {self.facts['machine']}."

    def markdown(self) -> str:
        """What it is for, how it was made, the remarks, then the tables."""
        head = [f"# {self.title}", *([self.purpose] if self.purpose else [])]
        head += [f"    {self.facts['command']}", self.origin(), *self.remarks]
        return "".join(f"{line}\n\n" for line in head) + "\n".join(t.markdown() for t in self.tables)

    def write(self, out: Path, stem: str, results: Path | None = None) -> Page:
        """Write ``<stem>.md``, ``.tex`` and ``.json`` into ``out``, the page to ``results`` too."""
        for path in (out / f"{stem}.md", *([] if results is None else [results])):
            write_text(path, self.markdown())
        write_text(out / f"{stem}.tex", "\n".join(table.latex() for table in self.tables))
        tables = [table.as_json() for table in self.tables]
        plain = self.facts | {"remarks": list(self.remarks), "tables": tables}
        write_text(out / f"{stem}.json", json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
        return self


@dataclass(frozen=True)
class Experiment:
    """What a command of the evaluation measures and shows.

    Attributes:
        name: stem of the page's files.
        title: heading of the page.
        cells: what is measured; the payload of each is a function without arguments that returns the body of
            its record.
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

    def run(self, command: str, options: Any) -> Page | None:
        """Measure the cells that have no record yet, and write the page.

        Args:
            command: of ``geodiff eval``.
            options: its dataclass, with ``out``, ``results`` and ``quiet``, maybe ``skip_broken``.

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
        page = Page(
            self.title, run_facts(command, options), tables, tuple(self.remarks(records)), self.purpose
        )
        return page.write(options.out, self.name, options.results)


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
        whole=_has_map,
    )
    records = {record["key"]: record for record in runner.run(lambda cell: cell.payload())}
    if runner.process.index > 0:
        return None
    return [records[cell.key] | dict(cell.head) for cell in cells if cell.key in records]


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
def cropped(sample: StereoSample, crop: str) -> StereoSample:
    """The sample with the truth inside of a crop only; images and cameras stay whole."""
    valid = sample.valid & crop_mask(crop, sample.valid.shape)
    if not valid.any():
        bad_value(f"the truth of {sample.label}", f"known somewhere in the crop {crop}", "unknown there")
    return sample if crop == "none" else replace(sample, valid=valid)


@dataclass(frozen=True, eq=False)
class _MethodCell:
    """One method on one sample, scored in a crop; its map goes to ``path`` where one is given."""

    ref: SampleRef
    read: Callable[[SampleRef], StereoSample]
    method: Method
    settings: Settings
    priors: PriorCache
    crop: str
    path: Path | None

    def __call__(self) -> Record:
        """Run and score; the seconds are those that the method takes alone."""
        sample, process = self.read(self.ref), {"process": this_process().index}
        self.priors.evidence.take_spared_seconds()
        start = time.perf_counter()
        try:
            with PeakMemory(torch.device(self.settings.device)) as memory:
                prediction = self.method.run(sample, self.settings, self.priors)
        except NotApplicable as reason:
            why = {"status": "not applicable", "reason": str(reason)}
            return {"rectified": sample.rectified} | why | process
        seconds = time.perf_counter() - start + self.priors.evidence.take_spared_seconds()
        scores = score(cropped(sample, self.crop), prediction, DATASETS[sample.dataset].cap_m)
        notes = {"sample": dict(sample.notes), "method": dict(prediction.notes)}
        cost = {"seconds": round(seconds, 3), "peak_bytes": memory.peak_bytes}
        saved = {}
        if self.path is not None and prediction.depth_m is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_depth_npy(self.path, prediction.depth_m)
            saved = {"map": file_digest(self.path)}
        head = {"rectified": sample.rectified, "status": "ok"}
        return head | cost | scores | {"notes": notes} | saved | process


def _has_map(cell: Item, record: Record) -> bool:
    """Whether the map that a cell is to save is there, and not that of other settings in its place."""
    path = getattr(cell.payload, "path", None)
    if path is None or record["status"] != "ok" or record["all_pixels"]["raw"] is None:
        return True
    return path.is_file() and record.get("map") == file_digest(path)


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
        crop: region of the image that is scored, one of ``options.CROPS``.
        save_depth: write each metric depth map to ``out/depth/<method>/<dataset>_<sample>.npy``, where the
            method ``files:out/depth/<method>`` finds it; a record without its map is made again.

    Returns:
        Cells whose records have ``status`` ``"ok"``, ``"not applicable"`` (``reason``) or ``"broken"``
        (``error``); for the numbers see ``scoring.score``.
    """
    process, priors, read = this_process(), PriorCache(), last_of(load)
    several = process.count > 1
    if several and settings.device == "cuda":
        settings = replace(settings, device=f"cuda:{process.local % torch.cuda.device_count()}")
    cells = []
    for ref in refs:
        for method in map(find_method, methods):
            chosen = method.own_settings(settings)
            prior = f"{chosen.prior} {priors.fingerprint(chosen)}" if method.uses_prior else ""
            device = chosen.device.partition(":")[0] if several else chosen.device
            cropping = {} if crop == "none" else {"crop": crop}
            configuration = method.configuration(replace(chosen, device=device)) | cropping
            folder = out / "depth" / re.sub(r"[^\w.=+-]+", "_", method.name)
            path = folder / f"{map_name(ref.dataset, ref.name)}.npy" if save_depth else None
            work = _MethodCell(ref, read, method, chosen, priors, crop, path)
            head = {"dataset": ref.dataset, "sample": ref.name, "method": method.name}
            key, name = cell_key(ref, method.base_name, configuration, prior), f"{ref.label}, {method.name}"
            cells.append(Item(key, work, name=name, words=(method.name,), head=head))
    return cells
