"""Configuration files of a folder of weights, read once.

Data flow: folder -> ``Layout`` -> configs by component.
Paper: none.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value

__all__ = ["Layout"]

LICENCE_LINE = re.compile(r"^license:\s*(\S.*?)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Layout:
    """A folder that may hold a prior.

    Attributes:
        folder: where it lies on this machine.
        name: as the user typed it, a hub id or a path.
        variant: of the weight files, such as ``"fp16"``.
    """

    folder: Path
    name: str
    variant: str | None = None

    def read_json(self, path: str) -> dict[str, Any]:
        """A JSON file below the folder; empty if there is none.

        Raises:
            ValueError: it is there and holds no JSON object.
        """
        file = self.folder / path
        if not file.is_file():
            return {}
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            bad_value(str(file), "a JSON object", "something else", "Save or fetch the folder anew.")
        return content

    @cached_property
    def index(self) -> dict[str, Any]:
        """``model_index.json``: components and options of a pipeline; empty without the file."""
        return self.read_json("model_index.json")

    def config(self, component: str) -> dict[str, Any]:
        """Config of a component by the name of its subfolder, a scheduler's too; ``""`` is the folder itself.

        Empty where there is none, so that ``config("unet").get("in_channels") == 8`` is a safe question.
        """
        prefix = f"{component}/" if component else ""
        return self.read_json(f"{prefix}config.json") or self.read_json(f"{prefix}scheduler_config.json")

    def has(self, component: str) -> bool:
        """Whether there is such a subfolder (or file)."""
        return (self.folder / component).exists()

    @cached_property
    def licence(self) -> str | None:
        """``license:`` of the model card's front matter, if it has one."""
        card = self.folder / "README.md"
        if not card.is_file():
            return None
        text = card.read_text(encoding="utf-8", errors="replace")
        front = text.split("---")[1] if text.startswith("---") and text.count("---") > 1 else ""
        found = LICENCE_LINE.search(front)
        return found.group(1) if found else None
