"""Build the ``geodiff eval`` commands (S5, experiments) from ``evaluation.options.COMMANDS``."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.cli.terminal import EXIT_SOME_FAILED, new_table, print_lines, show
from geodiff_plugin.evaluation.options import COMMANDS
from geodiff_plugin.findings import some_names
from geodiff_plugin.formats import check_out
from geodiff_plugin.jobs import say
from geodiff_plugin.options import Command
from geodiff_plugin.settings import setting

if TYPE_CHECKING:
    from geodiff_plugin.evaluation.experiment import Page


@dataclass(frozen=True, kw_only=True)
class _ListOptions:
    data: Path | None = setting(None, "Folder of datasets.")


def run_and_show(measure: Callable[[Any], Any], options: Any) -> None:
    """Run an evaluation and print the page or the path of the figure, unless ``quiet`` is set.

    Skipped samples are reported at the end and lead to exit code ``EXIT_SOME_FAILED``.
    """
    check_out(options.out)
    result = measure(options)
    if isinstance(result, Path) and not options.quiet:
        click.echo(result)
    elif result is not None and not options.quiet:
        _print_page(result)
        click.echo(f"-> {options.out}/")
    if broken := getattr(result, "broken", ()):
        count = "1 broken sample was" if len(broken) == 1 else f"{len(broken)} broken samples were"
        say(f"geodiff: {count} skipped: {some_names(broken)}. Run the same command again to retry.")
        sys.exit(EXIT_SOME_FAILED)


def _print_page(page: Page) -> None:
    """Print the title, origin, remarks and tables of a page."""
    from rich.text import Text

    origin = (Text(page.facts["command"], style="dim"), Text(page.origin(), style="dim"))
    show(Text(page.title, style="bold"), *origin, *page.remarks)
    for table in page.tables:
        shown = new_table(table.full_header(), table.title)
        for row in table.rows:
            shown.add_row(*row)
        show("", shown, Text(table.note, style="dim"))


def _list(options: _ListOptions) -> None:
    from geodiff_plugin.evaluation.baselines import FAMILIES, METHODS
    from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs

    rows = []
    for name, dataset in DATASETS.items():
        count = 0 if options.data is None else len(find_pairs(options.data, [name]))
        there = "not found" if options.data is not None else "no --data set"
        if count or not dataset.needs_folder:
            there = f"{count or 'any number of'} {'sample' if count == 1 else 'samples'}"
        rows.append((name, f"{there}\n{dataset.obtain}"))
    rows += [("", ""), *((name, method.summary) for name, method in METHODS.items())]
    for name, family in FAMILIES.items():
        about = getattr(family, "func", family).__doc__  # the docstring of a partial's function
        summary = re.split(r"[.;]", about or " ", maxsplit=1)[0]
        rows.append((f"{name}:...", f"{summary[0].lower()}{summary[1:]}"))
    rows.append(("METHOD@PRIOR", "a method with a different prior from --prior"))
    rows.append(("METHOD#SEED", "a method with a different seed from --seed; METHOD@PRIOR#SEED for both"))
    print_lines(rows)


LIST = Command(_ListOptions, _list, "List datasets and methods.")
_COMMANDS = {name: each._replace(run=partial(run_and_show, each.run)) for name, each in COMMANDS.items()}
eval_app = new_group("Evaluate this package and other methods on datasets.", _COMMANDS | {"list": LIST})
