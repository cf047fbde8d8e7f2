"""``geodiff convert``: weights in their authors' format to a folder for ``--prior``."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.cli.converters import depthfm, ppd, read_checkpoint, save_weights
from geodiff_plugin.cli.converters.marigold_v2 import MARIGOLD_V2, convert_marigold_v2

#: Kind -> module with the ``KEYS`` that tell it, and ``write(checkpoint, folder, part)``.
CONVERTERS = {"depthfm": depthfm, "ppd": ppd}
#: Keys of an unknown checkpoint that the error names.
NAMED_KEYS = 8
#: What is copied beside weights: configs, vocabularies, licences.
COPIED = (".json", ".txt", ".md", ".model", ".safetensors")


def run_convert(paths: Sequence[Path], part: str | None = None, space: str | None = None) -> None:
    """Convert and say where it is; nothing is left behind where that fails.

    ``part`` is the file, folder or hub id of what the checkpoint lacks; ``None`` for the usual one.
    """
    layered = len(paths) == 4 and str(paths[0]) == MARIGOLD_V2
    if not layered and len(paths) != 2:
        expected = f"SRC DST, or {MARIGOLD_V2} BASE CHECKPOINT DST"
        bad_value("paths", expected, " ".join(map(str, paths)) or "none")
    if not layered and space:
        bad_value("--space", f"for {MARIGOLD_V2} alone", f"given for {paths[0]}")
    source, target = paths[-2:]
    if os.path.lexists(target):
        bad_value("DST", "a folder that does not exist yet", target, "Name another, or remove it first.")
    try:
        unfinished = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        cure = f"Name another, or make the folder {target.parent} first."
        bad_value("DST", "a folder that can be made", f"{target} ({error.strerror})", cure)
    kind = MARIGOLD_V2 if layered else "folder"
    try:
        if layered:
            convert_marigold_v2(paths[1], source, unfinished, part, space)
        elif os.path.isdir(source):
            _convert_folder(source, unfinished)
        else:
            kind = _convert_file(source, unfinished, part)
        unfinished.chmod(0o755)  # mkdtemp's is its owner's alone
        os.replace(unfinished, target)
    except InputError:
        raise
    except (KeyError, RuntimeError, AttributeError, TypeError) as error:  # of networks that it does not fit
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        bad_value("SRC", "a whole checkpoint of its kind", f"{source} ({reason})", "Fetch it anew.")
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    print(f"{source} ({kind}) -> {target}; use it with --prior {target}")


def _convert_file(source: Path, folder: Path, part: str | None) -> str:
    """Convert a checkpoint into an empty folder; what kind it was."""
    checkpoint = read_checkpoint(source)
    for kind, converter in CONVERTERS.items():
        if set(checkpoint) >= converter.KEYS:
            converter.write(checkpoint, folder, part)
            return kind
    got = f"{source} with the keys {', '.join(map(str, list(checkpoint)[:NAMED_KEYS])) or 'of nothing'}"
    cure = "docs/reference/priors.md tells which prior comes from where."
    bad_value("SRC", f"a checkpoint of a known kind ({', '.join(CONVERTERS)})", got, cure)


def _safe_name(name: str) -> str:
    """Of ``pytorch_model.bin`` (transformers) or ``diffusion_pytorch_model.bin`` (diffusers), or a shard."""
    name = name.replace(".bin", ".safetensors")
    return name.replace("pytorch_model", "model") if name.startswith("pytorch_model") else name


def _convert_folder(source: Path, folder: Path) -> None:
    """Write the same folder, of one component or several, with safetensors in place of ``.bin`` files."""
    if not any(source.rglob("*.bin")):
        expected, cure = "a checkpoint file, or a folder with .bin weights", "Give it to --prior as it is."
        bad_value("SRC", expected, f"the folder {source} without: it needs no conversion", cure)
    for path in sorted(p for p in source.rglob("*") if p.is_file()):
        target = folder / path.relative_to(source)
        safe = target.with_name(_safe_name(path.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".bin":
            if not (source / safe.relative_to(folder)).is_file():  # else it is copied
                save_weights(read_checkpoint(path), safe)
        elif path.name.endswith(".bin.index.json"):
            index = json.loads(path.read_text(encoding="utf-8"))
            index["weight_map"] = {key: _safe_name(name) for key, name in index["weight_map"].items()}
            safe.write_text(json.dumps(index, indent=2), encoding="utf-8")
        elif path.suffix in COPIED or path.name.upper().startswith("LICEN"):
            shutil.copyfile(path, target)
