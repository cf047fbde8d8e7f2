"""``geodiff convert``: weights in their authors' format to a folder for ``--prior``.

Data flow: .ckpt or .pth file, folder of .bin weights, or base and LoRA -> a new folder, whole or not at all.
Paper: none.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.converters import CONVERTERS
from geodiff_plugin.cli.converters.folder import convert_folder
from geodiff_plugin.cli.converters.marigold_v2 import MARIGOLD_V2, convert_marigold_v2
from geodiff_plugin.cli.converters.reading import read_checkpoint

__all__ = ["run_convert"]

#: Keys of an unknown checkpoint that the error names.
NAMED_KEYS = 8


def run_convert(
    paths: Sequence[Path], part: str | None, space: str | None = None, lora: str | None = None
) -> None:
    """Convert and say where it is.

    Args:
        paths: checkpoint file (or a folder in diffusers' layout with .bin weights) and the folder to appear;
            or ``marigold-v2``, base, checkpoint and the folder to appear.
        part: file, folder or hub id of what the checkpoint lacks (DepthFM's VAE), ``None`` for the usual one.
        space: of Marigold V2, where the checkpoint's folder does not tell.
        lora: of Marigold V2, of ``unmerged_lora.LORAS``.

    Raises:
        ValueError: another number of paths; a target that exists or has no parent; a source that is no
            checkpoint, of no known kind, or whose weights do not fit. Nothing is left behind.
    """
    layered = len(paths) == 4 and str(paths[0]) == MARIGOLD_V2
    if not layered and len(paths) != 2:
        expected = f"SRC DST, or {MARIGOLD_V2} BASE CHECKPOINT DST"
        bad_value("paths", expected, " ".join(map(str, paths)) or "none")
    if not layered and (space or lora):
        bad_value("--space and --lora", f"for {MARIGOLD_V2} alone", f"given for {paths[0]}")
    source, target = paths[-2:]
    if os.path.lexists(target):
        bad_value("DST", "a folder that does not exist yet", target, "Name another, or remove it first.")
    if not os.path.isdir(target.parent):
        bad_value("DST", "in an existing folder", target, f"Make the folder {target.parent} first.")
    try:
        unfinished = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        bad_value("DST", "a folder that can be made", f"{target} ({error.strerror})", "Name another.")
    try:
        if layered:
            convert_marigold_v2(paths[1], source, unfinished, part, space, lora or "merged")
            kind = MARIGOLD_V2
        else:
            kind = _fill(source, unfinished, part)
        unfinished.chmod(0o755)  # mkdtemp's is its owner's alone
        os.replace(unfinished, target)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    print(f"{source} ({kind}) -> {target}; use it with --prior {target}")


def _fill(source: Path, folder: Path, part: str | None) -> str:
    """Convert into an empty folder; what kind it was."""
    if os.path.isdir(source):
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
        "docs/reference/priors.md tells which prior comes from where.",
    )
