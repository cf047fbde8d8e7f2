"""A page of the evaluation as rich tables on the terminal."""

from __future__ import annotations

from rich.text import Text

from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.evaluation.experiment import Page

__all__ = ["print_page"]


def print_page(page: Page) -> None:
    """Print the title, how the page was made, its remarks and its tables."""
    show(
        Text(page.title, style="bold"),
        Text(page.facts["command"], style="dim"),
        Text(page.origin(), style="dim"),
        *page.remarks,
    )
    for table in page.tables:
        shown = new_table(table.full_header(), table.title)
        for index, row in enumerate(table.rows):
            shown.add_row(*row, end_section=index + 1 in table.rules)
        show("", shown, Text(table.note, style="dim"))
