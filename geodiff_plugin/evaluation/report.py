"""What a run leaves behind: tables as ``.md``, ``.tex``, ``.json``, and a page for the docs.

Hop: tables + command + versions -> files.
Paper: none.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin.commands.report import versions
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.formats import atomic_path

__all__ = ["markdown_page", "run_facts", "write_text", "write_tables"]


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


def markdown_page(title: str, facts: dict[str, Any], tables: Sequence[Table], remarks: Sequence[str]) -> str:
    """One page: how it was made, remarks, then the tables.

    Args:
        title: heading.
        facts: of ``run_facts``.
        tables: in reading order.
        remarks: sentences that belong above the tables, e.g. how many samples were broken.
    """
    named = ", ".join(f"{name} {value}" for name, value in facts["versions"].items())
    head = [
        f"# {title}",
        "",
        f"    {facts['command']}",
        "",
        f"{facts['date']}; {named}; {facts['machine']}.",
        "",
    ]
    for remark in remarks:
        head += [remark, ""]
    return "\n".join(head) + "\n" + "\n".join(table.markdown() for table in tables)


def write_tables(
    out: Path,
    title: str,
    facts: dict[str, Any],
    tables: Sequence[Table],
    remarks: Sequence[str],
    stem: str = "table",
) -> str:
    """Write ``table.md``, ``table.tex`` and ``table.json`` (or another ``stem``) into ``out``.

    Returns:
        The Markdown page.
    """
    page = markdown_page(title, facts, tables, remarks)
    write_text(out / f"{stem}.md", page)
    write_text(out / f"{stem}.tex", "\n".join(table.latex() for table in tables))
    plain = facts | {"remarks": list(remarks), "tables": [table.as_json() for table in tables]}
    write_text(out / f"{stem}.json", json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
    return page
