"""``geodiff convert``: a checkpoint of an author's code to the folder that ``--prior`` takes.

Hop: .ckpt or .pth file, or a folder of .bin weights -> a new folder of safetensors, whole or not at all.
Paper: none.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.commands.converters import CONVERTERS
from geodiff_plugin.commands.converters.folder import convert_folder
from geodiff_plugin.commands.converters.reading import read_checkpoint

__all__ = ["run_convert"]

#: Keys of an unknown checkpoint that the error names.
NAMED_KEYS = 8


def run_convert(source: Path, target: Path, part: str | None) -> None:
    """Convert and say where it is.

    Args:
        source: checkpoint file, or a folder in diffusers' layout with .bin weights.
        target: the folder to appear; must not exist.
        part: file, folder or hub id of what the checkpoint lacks (DepthFM's VAE), ``None`` for the usual one.

    Raises:
        ValueError: ``target`` exists or has no parent; ``source`` is no checkpoint, of no known kind, or its
            weights do not fit. Nothing is left behind.
    """
    if target.exists():
        bad_value("DST", "a folder that does not exist yet", target, "Name another, or remove it first.")
    if not target.parent.is_dir():
        bad_value("DST", "in an existing folder", target, f"Make the folder {target.parent} first.")
    unfinished = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        kind = _fill(source, unfinished, part)
        unfinished.chmod(0o755)  # mkdtemp's is its owner's alone
        os.replace(unfinished, target)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    print(f"{source} ({kind}) -> {target}; use it with --prior {target}")


def _fill(source: Path, folder: Path, part: str | None) -> str:
    """Convert into an empty folder; what kind it was."""
    if source.is_dir():
        convert_folder(source, folder)
        return "folder"
    checkpoint = read_checkpoint(source)
    for kind, converter in CONVERTERS.items():
        if converter.recognises(checkpoint):
            converter.write(checkpoint, folder, part)
            return kind
    keys = list(map(str, checkpoint))
    got = ", ".join(keys[:NAMED_KEYS]) + (
        f" and {len(keys) - NAMED_KEYS} more" if len(keys) > NAMED_KEYS else ""
    )
    bad_value(
        "SRC",
        f"a checkpoint of a known kind ({', '.join(CONVERTERS)})",
        f"{source} with the keys {got or 'of an empty mapping'}",
        "docs/priors.md tells which prior comes from where.",
    )
