"""An experiment: cells (samples x methods x settings), each measured once, and tables of their records.

The cells of every command are the items of one ``Runner``: all resume and are shared by several processes.
"""

from __future__ import annotations

import json
import os
import platform
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import torch

from geodiff_plugin import __version__
from geodiff_plugin.evaluation.baselines import Method, NotApplicable, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import DATASETS, SampleRef, StereoSample, load
from geodiff_plugin.evaluation.options import command_line
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.evaluation.tables import Table
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.runner import Item, Journal, Record, Runner, fingerprint, this_process
from geodiff_plugin.runtime.machine import PeakMemory, versions

#: Journal of methods on samples, which several commands share.
RECORDS_NAME = "samples.jsonl"
Tables = Callable[[list[Record]], Sequence[Table]]


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


def run_experiment(
    command: str,
    options: Any,
    title: str,
    cells: Sequence[Item],
    tables: Tables,
    remarks: Callable[[list[Record]], Sequence[str]] = lambda records: (),
    journal: str = "",
) -> Page | None:
    """Measure the cells that have no record yet, and write the page; ``None`` in any process but the first.

    The payload of each cell is a ``partial`` that returns the body of its record. ``ValueError`` or
    ``OSError`` for bad options or samples.
    """
    records = measure_cells(cells, options, journal or f"{command}.jsonl")
    return None if records is None else write_page(command, options, title, tables(records), remarks(records))


def measure_cells(cells: Sequence[Item], options: Any, journal: str = RECORDS_NAME) -> list[Record] | None:
    """The records of cells, in order, each with the ``head`` of its cell; ``None`` as ``run_experiment``.

    A cell that stands several times, or under several names, is measured once.
    """
    runner = Runner(
        list({cell.key: cell for cell in cells}.values()),
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

    What is in a sample's files counts, not where they lie. ``prior`` is its name and fingerprint.
    """
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
    """Run one method on one sample and score it; the seconds are those that the method takes alone."""
    sample, process = read(ref), {"process": this_process().index}
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
    """A cell for every method on every sample, all of ``RECORDS_NAME``.

    With ``save_depth`` metres go to ``out/depth/<method>/<dataset>_<sample>.npy``; a record without its map
    is made again. ``status`` is ``"ok"``, ``"not applicable"`` (``reason``) or ``"broken"`` (``error``).
    """
    # One sample, read once, serves all its methods.
    process, priors, read = this_process(), PriorCache(), lru_cache(maxsize=1)(load)
    several = process.count > 1
    if several and settings.device == "cuda":
        settings = replace(settings, device=f"cuda:{process.local % torch.cuda.device_count()}")
    cells = []
    for ref, method in product(refs, map(find_method, methods)):
        chosen = method.own_settings(settings)
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
