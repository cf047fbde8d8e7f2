"""The page of a run, written as Markdown, LaTeX and JSON."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin.evaluation.table import Table
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.runtime.machine import versions

__all__ = ["Page", "run_facts", "write_page", "write_text"]


def run_facts(command: str) -> dict[str, Any]:
    """Command, date, versions and machine of a run."""
    found = versions()
    try:
        found["opencv"] = version("opencv-python-headless")
    except PackageNotFoundError:
        found["opencv"] = "not installed"
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} torch threads"
    if torch.cuda.is_available():
        machine += f", {torch.cuda.get_device_name()}"
    return {"command": command, "date": date.today().isoformat(), "versions": found, "machine": machine}


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all, making its folder where missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Page:
    """What a command of the evaluation found.

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
        head = [f"# {self.title}", "", *([self.purpose, ""] if self.purpose else [])]
        head += [f"    {self.facts['command']}", "", self.origin(), ""]
        for remark in self.remarks:
            head += [remark, ""]
        return "\n".join(head) + "\n" + "\n".join(table.markdown() for table in self.tables)


def write_page(page: Page, out: Path, stem: str, results: Path | None = None) -> None:
    """Write ``<stem>.md``, ``<stem>.tex`` and ``<stem>.json`` into ``out``, the page to ``results`` too."""
    write_text(out / f"{stem}.md", page.markdown())
    if results is not None:
        write_text(results, page.markdown())
    write_text(out / f"{stem}.tex", "\n".join(table.latex() for table in page.tables))
    tables = [table.as_json() for table in page.tables]
    plain = page.facts | {"remarks": list(page.remarks), "tables": tables}
    write_text(out / f"{stem}.json", json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
