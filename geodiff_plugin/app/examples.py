"""Pairs to try the page with; ``python -m tests.scenes.make_examples`` renders them anew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER

__all__ = ["EXAMPLES", "Example"]

FOLDER = Path(__file__).resolve().parent / "pairs"


@dataclass(frozen=True)
class Example:
    """One pair.

    Attributes:
        label: what the page calls it.
        paths: left image, right image, calibration.
    """

    label: str
    paths: tuple[str, str, str]


def _example(label: str, folder: Path, suffix: str) -> Example:
    left, right = (str(folder / f"{side}.{suffix}") for side in ("left", "right"))
    return Example(label, (left, right, str(folder / "calib.txt")))


EXAMPLES = (
    _example("A room, 12 cm apart", DEMO_PAIR_FOLDER, "png"),
    _example("A table, 6 cm apart", FOLDER / "table", "jpg"),
    _example("A street, 50 cm apart", FOLDER / "street", "jpg"),
)
