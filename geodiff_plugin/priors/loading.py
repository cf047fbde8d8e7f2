"""Loads a pipeline from a name, a path or a hub id, and checks its weights one by one."""

from __future__ import annotations

import inspect
import json
import os
import re
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import diffusers
import torch
import transformers
from diffusers.utils import logging as diffusers_logging
from huggingface_hub import metadata_load, snapshot_download
from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars
from transformers.utils import logging as transformers_logging
from yaml import YAMLError

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.priors import components

#: Libraries with a switch for their progress bars.
HOSTS = (diffusers_logging, transformers_logging)
BUNDLED_FOLDER = Path(__file__).resolve().parents[1] / "bundled" / "prior"

#: Requested priors that cannot be run: pattern of the last part of the name -> reason.
UNSUPPORTED = {
    r"apdepth": "its U-Net takes the depth of a Depth Anything V2 Giant, whose weights were never released",
    r"lotus-?2": "it is a LoRA on FLUX.1-dev, which is gated and needs about 40 GB; Lotus v1 and v2 work",
    r"marigold.*-hr\b.*": "no code for it was published; marigold-depth-v1-1 supports any resolution",
    r"geowizard-e2e-ft": "it needs GeoWizard's networks initialized differently; use marigold-e2e-ft-depth",
    r"diffusion-?depth|ddp": "its toolchain of 2023 (torch 1.10, mmseg) can no longer be installed",
    r"(lotus|.*e2e-ft)-normals?.*": "it predicts normals; use the corresponding depth model",
}
SMALL_FILES = ["*.json", "*.txt", "*.md"]
WEIGHTS = ["*/*.safetensors", "model*.safetensors"]
#: Duplicates of the same weights, which are only loaded with ``variant``.
OTHER_VARIANTS = ["*.fp16.*safetensors", "*.bf16.*safetensors", "*.fp16-*.safetensors", "*non_ema*"]
#: Libraries that ``model_index.json`` may name: diffusers, transformers, and this package's components.
LIBRARIES = {"diffusers": diffusers, "transformers": transformers, components.__name__: components}

HINT = "A file may be truncated or from a different version. Save or download the folder again."


@contextmanager
def reading(what: str, expected: str, got: str, hint: str) -> Iterator[None]:
    """Convert a library's exception about a bad file to the message of ``bad_value``, with its first line."""
    try:
        yield
    except Exception as error:  # libraries raise nearly every type
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[0] if lines else type(error).__name__
    else:
        return
    bad_value(what, expected, f"{got} ({reason})", hint)


@contextmanager
def no_bars() -> Iterator[None]:
    """Disable the progress bars of diffusers and transformers inside the block; restores them afterwards."""
    shown = [host for host in HOSTS if host.is_progress_bar_enabled()]
    hub_is_quiet = are_progress_bars_disabled()
    for host in shown:
        host.disable_progress_bar()
    try:
        yield
    finally:
        for host in shown:
            host.enable_progress_bar()
        if hub_is_quiet and shown:  # transformers' switch also controls the hub's
            disable_progress_bars()


@dataclass(frozen=True)
class Layout:
    """A folder that may contain a prior; ``name`` is what the user typed, a hub id or a path."""

    folder: Path
    name: str
    variant: str | None = None

    def read_json(self, path: str) -> dict[str, Any]:
        """Read a JSON object from a file in the folder, empty without a file; ``ValueError`` if invalid."""
        file = self.folder / path
        if not file.is_file():
            return {}
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            bad_value(str(file), "a JSON object", "something else", "Save or download the folder again.")
        return content

    @cached_property
    def index(self) -> dict[str, Any]:
        """``model_index.json``: components and options of a pipeline; empty without the file."""
        return self.read_json("model_index.json")

    def config(self, component: str) -> dict[str, Any]:
        """Return a component's config by its subfolder, ``""`` for the folder itself; empty without one."""
        prefix = f"{component}/" if component else ""
        return self.read_json(f"{prefix}config.json") or self.read_json(f"{prefix}scheduler_config.json")

    @cached_property
    def licence(self) -> str:
        """``license:`` from the model card's front matter, or ``"licence unknown"``."""
        try:
            card = metadata_load(self.folder / "README.md") or {}
        except (OSError, ValueError, YAMLError):
            card = {}
        return str(card.get("license") or "licence unknown")


def check_supported(name: str) -> None:
    """Raise ``ValueError`` with the reason for a prior that is known not to work; others pass."""
    last = Path(name).name.lower()
    for pattern, reason in UNSUPPORTED.items():
        if re.fullmatch(pattern, last):
            bad_value("prior", "a supported prior", repr(name), f"It cannot be used: {reason}.")


def fetch(name: str, hub: dict[str, Any], weights: bool = False, variant: str | None = None) -> Path:
    """Return a prior's folder, with its configs at least; ``hub`` are options of ``snapshot_download``."""
    if name == "bundled":
        return BUNDLED_FOLDER
    if os.path.isdir(name):
        return Path(name)
    if os.path.isfile(name):
        hint = "Pass its folder. Convert a downloaded checkpoint with `geodiff convert`."
        bad_value("prior", "'bundled', a folder or a Hugging Face model ID", f"the file {name}", hint)
    if name.count("/") > 1 or name.startswith((".", "/", "~")):
        bad_value(
            "prior",
            "'bundled', an existing folder, or a Hugging Face model ID",
            repr(name),
            "Check the path.",
        )
    patterns = list(SMALL_FILES)
    ignored = None
    if weights and variant is None:
        patterns = patterns + WEIGHTS
        ignored = OTHER_VARIANTS
    elif weights:
        patterns += [f"*.{variant}.safetensors", f"*.{variant}-*.safetensors"]
    expected = "'bundled', a folder, or a Hugging Face model ID that is cached or reachable"
    hint = "Download it once with `hf download ID`, pass a folder, or use --prior bundled."
    with reading("prior", expected, repr(name), hint):
        folder = snapshot_download(name, allow_patterns=patterns, ignore_patterns=ignored, **hub)
    return Path(folder)


def check_weights(missing: Any, unexpected: Any, where: str) -> None:
    """Raise ``ValueError`` listing the weights in ``where`` that do not match their module."""
    named = {"missing": sorted(map(str, missing)), "unexpected": sorted(map(str, unexpected))}
    parts = [f"{label}: {', '.join(keys)}" for label, keys in named.items() if keys]
    if parts:
        hint = "These weights belong to a different architecture, or the file is damaged."
        bad_value(f"weights in {where}", "exactly the ones that its config requires", "; ".join(parts), hint)


def _component_class(pipeline_class: type[Any], layout: Layout, name: str) -> type[Any]:
    """Return the class of a component named in ``model_index.json``, from ``LIBRARIES`` only.

    In this package's pipelines the constructor's annotation replaces an unknown class or a base class of it.
    """
    entry = layout.index.get(name)
    library, cls = entry if isinstance(entry, list) and len(entry) == 2 else ("", "")
    named: Any = getattr(LIBRARIES.get(str(library)), str(cls), None)
    if not isinstance(named, type) or not hasattr(named, "from_pretrained"):
        named = None
    expected = _annotated(pipeline_class).get(name)
    if expected is not None and (named is None or issubclass(expected, named)):
        return expected
    if named is None:
        what = f"component {name!r} in {layout.folder / 'model_index.json'}"
        hint = "Code distributed with weights is never run."
        bad_value(what, "a class of diffusers or transformers", repr(entry), hint)
    return named


def _annotated(pipeline_class: type[Any]) -> dict[str, type[Any]]:
    """Return component classes by the names of a constructor's parameters; none for diffusers pipelines."""
    if pipeline_class.__module__.startswith("diffusers."):
        return {}
    classes = {}
    for name, hint in typing.get_type_hints(pipeline_class.__init__).items():
        for cls in (hint, *typing.get_args(hint)):  # optional ones are combined with None
            if hasattr(cls, "from_pretrained"):
                classes[name] = cls
    return classes


def load_component(
    layout: Layout, name: str, cls: type[Any], dtype: torch.dtype, unread: str | None = None
) -> Any:
    """Load one component from a subfolder (``""``: the folder), checking a module's weights by name.

    ``unread`` is part of the names of weights that no forward pass reads. They may be missing, and additional
    weights are then allowed.
    """
    folder = str(layout.folder / name)
    damaged = reading(f"component {name or 'model'!r} of {layout.name}", "a readable component", folder, HINT)
    options: dict[str, Any] = {"local_files_only": True}
    if cls.__module__.startswith("transformers."):  # it would otherwise ask on the terminal
        options["trust_remote_code"] = False
    if not (issubclass(cls, torch.nn.Module) or cls.__name__.startswith("AutoModel")):
        with damaged:
            return cls.from_pretrained(folder, **options)
    if not any((layout.folder / name).glob("*.safetensors")):
        hint = "`geodiff convert SRC DST` creates such a folder from .bin, .ckpt or .pth."
        bad_value(f"weights in {folder}", "safetensors", "none", hint)
    if layout.variant is not None:
        options["variant"] = layout.variant
    with damaged:
        module, info = cls.from_pretrained(
            folder, dtype=dtype, use_safetensors=True, output_loading_info=True, **options
        )
    if info.get("mismatched_keys"):
        check_weights((), [entry[0] for entry in info["mismatched_keys"]], folder)
    if unread is None:
        check_weights(info["missing_keys"], info["unexpected_keys"], folder)
    else:
        check_weights([key for key in info["missing_keys"] if unread not in key], (), folder)
    return module.eval()


def build_pipeline(cls: type[Any], layout: Layout, dtype: torch.dtype, **options: Any) -> Any:
    """Build a pipeline from the components that its constructor names and the options in the index.

    ``options`` are constructor arguments that override the folder's; ``None`` is ignored.
    """
    arguments = {name: value for name, value in options.items() if value is not None}
    for name, parameter in list(inspect.signature(cls.__init__).parameters.items())[1:]:
        if name in arguments:
            continue
        value = _argument(cls, layout, name, dtype)
        if value is not MISSING:
            arguments[name] = value
        elif parameter.default is parameter.empty:
            bad_value(str(layout.folder), f"a folder with the component {name!r}", "no such component")
    try:
        return cls(**arguments)
    except (AttributeError, KeyError, TypeError) as error:  # this package's classes raise their own messages
        wrong = str(error)
    bad_value(str(layout.folder / "model_index.json"), f"the index of a {cls.__name__}", wrong, HINT)


def _argument(cls: type[Any], layout: Layout, name: str, dtype: torch.dtype) -> Any:
    """Return a component or option of a folder for a constructor's argument, or ``MISSING``."""
    entry = layout.index.get(name)
    is_listed = isinstance(entry, list) and entry[0] is not None
    if is_listed or (name in _annotated(cls) and (layout.folder / name).exists()):
        return load_component(layout, name, _component_class(cls, layout, name), dtype)
    # A list names a component without a class, which its folder lacks.
    return MISSING if entry is None or isinstance(entry, list) else entry
