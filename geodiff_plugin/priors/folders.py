"""Folders of weights: from a name, a path or a hub id to configs and files."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download
from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError, RepositoryNotFoundError

from geodiff_plugin._checks import InputError, bad_value

__all__ = ["BUNDLED_FOLDER", "Layout", "REFUSED", "fetch_small_files", "fetch_weights", "refuse"]

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


BUNDLED_FOLDER = Path(__file__).resolve().parents[1] / "bundled" / "prior"

#: Priors that people ask for and that cannot be run: pattern of the last part of the name -> reason.
REFUSED = {
    r"apdepth": "its U-Net takes the depth of a Depth Anything V2 Giant, whose weights were never released",
    r"lotus-?2": "it is a LoRA on FLUX.1-dev, which is gated and needs some 40 GB; Lotus v1 and v2 work",
    r"marigold.*-hr\b.*": "no code that runs it was published; marigold-depth-v1-1 takes any resolution",
    r"geowizard-e2e-ft": "it needs GeoWizard's networks with another start; take marigold-e2e-ft-depth, "
    "whose authors report it as better",
    r"diffusion-?depth": "its 2023 toolchain (torch 1.10, mmdet3d, compiled extensions) cannot be installed "
    "any more, and its metric depth is of KITTI or NYU alone",
    r"ddp": "its 2023 toolchain (mmsegmentation, mmcv) cannot be installed any more, and its metric depth is "
    "of KITTI or NYU alone",
}

SMALL_FILES = ["*.json", "*.txt", "*.md"]
WEIGHTS = ["*/*.safetensors", "model*.safetensors"]
#: Second copies of the same weights, which only ``variant`` asks for.
OTHER_VARIANTS = ["*.fp16.*safetensors", "*.bf16.*safetensors", "*.fp16-*.safetensors", "*non_ema*"]


def refuse(name: str) -> None:
    """Say why a prior that is known not to work does not.

    Raises:
        ValueError: it is one.
    """
    last = Path(name).name.lower()
    for pattern, reason in REFUSED.items():
        if re.fullmatch(pattern, last):
            bad_value("prior", "one that can be run", repr(name), f"It is refused because {reason}.")


def fetch_small_files(name: str, hub: dict[str, Any]) -> Path:
    """The folder of a prior, with at least its configs.

    Args:
        name: ``"bundled"``, a folder, or a hub id.
        hub: options of ``snapshot_download`` (``revision``, ``token``, ``cache_dir``, ``local_files_only``).

    Raises:
        ValueError: no such folder; a hub id that is neither cached nor can be reached.
    """
    if name == "bundled":
        return BUNDLED_FOLDER
    if os.path.isdir(name):
        return Path(name)
    if name.count("/") > 1 or name.startswith((".", "/", "~")):
        bad_value("prior", "'bundled', a folder that is there, or a hub id", repr(name), "Check the path.")
    return _snapshot(name, hub, SMALL_FILES, None)


def fetch_weights(name: str, folder: Path, variant: str | None, hub: dict[str, Any]) -> Path:
    """The folder with the weights in it; nothing happens for one that is no snapshot of the hub.

    Args:
        name: as typed.
        folder: from ``fetch_small_files``.
        variant: of the weight files, such as ``"fp16"``.
        hub: as there.

    Raises:
        ValueError: neither cached nor reachable.
    """
    if name == "bundled" or folder == Path(name):
        return folder
    if variant is None:
        return _snapshot(name, hub, SMALL_FILES + WEIGHTS, OTHER_VARIANTS)
    chosen = [f"*.{variant}.safetensors", f"*.{variant}-*.safetensors"]
    return _snapshot(name, hub, SMALL_FILES + chosen, None)


def _snapshot(name: str, hub: dict[str, Any], allow: list[str], ignore: list[str] | None) -> Path:
    try:
        return Path(snapshot_download(name, allow_patterns=allow, ignore_patterns=ignore, **hub))
    except (
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        HFValidationError,
        OSError,
        ConnectionError,
    ) as error:
        cure = "Fetch it once with `hf download ID` while online, give a folder, or use --prior bundled."
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            "prior must be 'bundled', a folder or a hub id that is cached or can be reached; "
            f"got {name!r} ({reason}). {cure}"
        ) from error
