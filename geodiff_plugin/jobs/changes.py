"""How what is in a folder differs from what a run would make of it, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def option_changes(made: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Options, by their flags, with other values in ``made``; ``None`` is an option that was not typed."""
    changes = []
    for flag, value in wanted.items():
        was = made.get(flag)
        if was != value:
            typed = f"the default of {flag}" if was is None else f"{flag} {was}"
            changes.append(f"made with {typed} instead of {'the default' if value is None else value}")
    return changes


def input_change(name: str) -> str:
    """Something that was read has another content than it had."""
    return f"made before {name} changed"
