"""Interface of a converter: how a checkpoint is recognised and what is written.

Data flow: unpickled checkpoint -> whether it is of this kind -> a folder.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Converter", "write_card"]


@dataclass(frozen=True)
class Converter:
    """One kind.

    Attributes:
        recognises: whether an unpickled checkpoint is of this kind, by its keys.
        write: checkpoint, an empty folder to fill, and what the user gave with ``--with`` (a file, folder or
            hub id of a part that the checkpoint lacks) or ``None``; a ``ValueError`` says what is wrong.
    """

    recognises: Callable[[Mapping[str, Any]], bool]
    write: Callable[[Mapping[str, Any], Path, str | None], None]


def write_card(folder: Path, licence: str, text: str) -> None:
    """``README.md`` with the licence where it is looked for on load.

    Args:
        folder: of the weights.
        licence: its identifier, such as ``"mit"``.
        text: where the weights come from, a sentence or two.
    """
    (folder / "README.md").write_text(f"---\nlicense: {licence}\n---\n\n{text}\n", encoding="utf-8")
