"""Pairs that were used to tune the defaults, and held-out pairs that nothing was tuned on."""

from __future__ import annotations

import tomllib
from pathlib import Path

#: Split -> dataset -> names of its samples, from ``splits.toml``.
SPLITS: dict[str, dict[str, list[str]]] = tomllib.loads(
    Path(__file__).with_name("splits.toml").read_text(encoding="utf-8")
)
#: What the pairs of each split are, for tables.
TITLES = {"tuned": "used to tune the defaults", "unseen": "held out"}


def split_of(dataset: str, sample: str) -> str | None:
    """Return the split that lists a sample; ``None`` for others, such as your own pairs."""
    return next((name for name, listed in SPLITS.items() if sample in listed.get(dataset, ())), None)
