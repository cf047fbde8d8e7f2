"""Hyperparameters as text: parsed from ``KNOB=VALUE``, and listed in tables.

Data flow: ``KNOB=VALUE`` -> ``GuidanceConfig`` -> tables of docs/reference/knobs.md and ``geodiff info
    --knobs``.
Paper: the column of docs/reference/knobs.md.

    python -m geodiff_plugin.guidance.knobs docs/reference/knobs.md

writes the tables anew between the page's marks.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.guidance.config import LEAVES, STAGES, GuidanceConfig
from geodiff_plugin.guidance.fields import Knob, close_names
from geodiff_plugin.guidance.presets import DEFAULT, PAPER

__all__ = ["config_from_text", "knob_lines", "knob_tables", "value_of", "with_tables"]

#: Leaves that are dicts: one entry is written as ``weights.TERM=VALUE``.
BY_NAME = ("weights", "options")
#: A link of the page to another one; a terminal has no use for it.
LINK = re.compile(r" \(\[[^]]*\]\([^)]*\)\)")
BEGIN, END = "<!-- made by geodiff_plugin.guidance.knobs -->", "<!-- end -->"


def config_from_text(entries: Iterable[str], base: GuidanceConfig, name: str) -> GuidanceConfig:
    """A configuration with leaves set otherwise, as they are written on a command line.

    Args:
        entries: ``KNOB=VALUE`` each; ``weights.TERM=VALUE`` changes one weight.
        base: what they change.
        name: the option, for messages.

    Returns:
        The configuration; a value is JSON, or text where it is none.

    Raises:
        InputError: another form, a knob that does not exist, a value that it cannot have.
    """
    changes: dict[str, Any] = {}
    for entry in entries:
        knob, equals, written = entry.partition("=")
        leaf, _, part = knob.partition(".")
        if not equals or leaf not in LEAVES or (leaf in BY_NAME) != bool(part):
            cure = close_names(knob, [n for n in LEAVES if n not in BY_NAME] + [f"{n}.NAME" for n in BY_NAME])
            bad_value(name, "KNOB=VALUE with a knob of GeometryGuidance", repr(entry), cure)
        try:
            value = json.loads(written)
        except (ValueError, RecursionError):
            value = written
        changes[leaf] = changes.get(leaf, base.leaves()[leaf]) | {part: value} if part else value
    return base.changed(**changes)


def value_of(name: str, config: GuidanceConfig) -> Any:
    """A leaf's value, or that of ``weights.TERM``; what is open as it is settled with matches.

    Raises:
        InputError: no such leaf.
        KeyError: no such term.
    """
    leaf, _, part = name.partition(".")
    if leaf not in LEAVES:
        bad_value("a knob", "one that exists", repr(name), close_names(name, LEAVES))
    value = config.leaves()[leaf]
    if part:
        return value[part]
    return getattr(config.plan_updates(points_given=False), leaf, None) if value is None else value


def _stages() -> Iterator[tuple[str, str, list[Field[Any]]]]:
    """Name, summary and leaves of every stage, those above the stages first."""
    own = [one for one in fields(GuidanceConfig) if one.name in LEAVES and not LEAVES[one.name]]
    yield "", "Above the stages", own
    for stage, kind in STAGES.items():
        yield stage, (kind.__doc__ or "").partition("\n")[0].rstrip("."), list(fields(kind))


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(_shown(v) for v in value)})"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(v)}" for name, v in value.items()) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def knob_tables() -> str:
    """Markdown tables of every leaf, a stage each: name, default, paper, range, what it does."""
    default, paper, lines = DEFAULT.leaves(), PAPER.leaves(), []
    plan = PAPER.plan_updates(points_given=False)
    for stage, summary, own in _stages():
        title = f"`{stage}`: {summary[0].lower()}{summary[1:]}" if stage else summary
        lines += [f"### {title}", "", "| knob | default | paper | range | what it does |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        for one in own:
            knob, value = Knob.of(one), default[one.name]
            said = paper[one.name] if paper[one.name] is not None else getattr(plan, one.name, None)
            shown = f"`None`: {knob.unset}" if value is None else _shown(value)
            cells = (f"`{one.name}`", shown, knob.paper.format(_shown(said)), knob.values, knob.doc)
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def knob_lines() -> list[str]:
    """The same for a terminal: one line a leaf, with its default."""
    default, lines = DEFAULT.leaves(), []
    for stage, summary, own in _stages():
        lines += ["", f"{stage + ': ' if stage else ''}{summary}"]
        for one in own:
            knob = Knob.of(one)
            shown = knob.unset if default[one.name] is None else _shown(default[one.name])
            doc = LINK.sub("", knob.doc)
            lines.append(f"  {one.name} = {shown}  [{knob.values}]  {doc}".replace("`", ""))
    return lines[1:]


def with_tables(page: str) -> str:
    """A page with the tables between its marks made anew.

    Raises:
        InputError: a page without the marks.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        bad_value("the page", f"one with the marks {BEGIN} and {END}", "one without")
    return f"{before}{BEGIN}\n\n{knob_tables()}\n{END}{after}"


if __name__ == "__main__":
    target = Path(sys.argv[1])
    target.write_text(with_tables(target.read_text(encoding="utf-8")), encoding="utf-8")
