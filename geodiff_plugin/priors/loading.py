"""From a name, a path or a hub id to a pipeline whose weights were checked one by one."""

from __future__ import annotations

import inspect
import json
import os
import re
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors import components

#: Hosts with a switch for their progress bars.
HOSTS = (diffusers_logging, transformers_logging)
BUNDLED_FOLDER = Path(__file__).resolve().parents[1] / "bundled" / "prior"

#: Priors that people ask for and that cannot be run: pattern of the last part of the name -> reason.
REFUSED = {
    r"apdepth": "its U-Net takes the depth of a Depth Anything V2 Giant, whose weights were never released",
    r"lotus-?2": "it is a LoRA on FLUX.1-dev, which is gated and needs some 40 GB; Lotus v1 and v2 work",
    r"marigold.*-hr\b.*": "no code that runs it was published; marigold-depth-v1-1 takes any resolution",
    r"geowizard-e2e-ft": "it needs GeoWizard's networks with another start; take marigold-e2e-ft-depth",
    r"diffusion-?depth|ddp": "its toolchain of 2023 (torch 1.10, mmseg) cannot be installed any more",
    r"(lotus|.*e2e-ft)-normals?.*": "it predicts normals; take its sibling for depth",
}
SMALL_FILES = ["*.json", "*.txt", "*.md"]
WEIGHTS = ["*/*.safetensors", "model*.safetensors"]
#: Second copies of the same weights, which only ``variant`` asks for.
OTHER_VARIANTS = ["*.fp16.*safetensors", "*.bf16.*safetensors", "*.fp16-*.safetensors", "*non_ema*"]
#: What ``model_index.json`` may name: the two hosts, and the small components of this package.
LIBRARIES = {"diffusers": diffusers, "transformers": transformers, components.__name__: components}

CURE = "Is a file of it cut off, or of another version? Save or fetch the folder anew."


@contextmanager
def reading(what: str, expected: str, got: str, cure: str) -> Iterator[None]:
    """Turn what a library raises over a bad file into the sentence of ``bad_value``, with its first line."""
    try:
        yield
    except Exception as error:  # libraries raise nearly everything
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[0] if lines else type(error).__name__
    else:
        return
    bad_value(what, expected, f"{got} ({reason})", cure)


@contextmanager
def no_bars() -> Iterator[None]:
    """Switch off the progress bars of diffusers and transformers inside, and leave them as they were."""
    shown = [host for host in HOSTS if host.is_progress_bar_enabled()]
    hub_is_quiet = are_progress_bars_disabled()
    for host in shown:
        host.disable_progress_bar()
    try:
        yield
    finally:
        for host in shown:
            host.enable_progress_bar()
        if hub_is_quiet and shown:  # transformers' switch is the hub's as well
            disable_progress_bars()


@dataclass(frozen=True)
class Layout:
    """A folder that may hold a prior; its ``name`` is what the user typed, a hub id or a path."""

    folder: Path
    name: str
    variant: str | None = None

    def read_json(self, path: str) -> dict[str, Any]:
        """A JSON object in a file below the folder, empty if there is none; ``ValueError`` over another."""
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
        """Config of a component by its subfolder, ``""`` for the folder itself; empty where there is none."""
        prefix = f"{component}/" if component else ""
        return self.read_json(f"{prefix}config.json") or self.read_json(f"{prefix}scheduler_config.json")

    @cached_property
    def licence(self) -> str:
        """``license:`` of the model card's front matter, or ``"licence unknown"``."""
        try:
            card = metadata_load(self.folder / "README.md") or {}
        except (OSError, ValueError, YAMLError):
            card = {}
        return str(card.get("license") or "licence unknown")


def refuse(name: str) -> None:
    """Say why a prior that is known not to work does not, by a ``ValueError``; others pass."""
    last = Path(name).name.lower()
    for pattern, reason in REFUSED.items():
        if re.fullmatch(pattern, last):
            bad_value("prior", "one that can be run", repr(name), f"It is refused because {reason}.")


def fetch(name: str, hub: dict[str, Any], weights: bool = False, variant: str | None = None) -> Path:
    """The folder of a prior, from the hub by options of ``snapshot_download``, with its configs at least."""
    if name == "bundled":
        return BUNDLED_FOLDER
    if os.path.isdir(name):
        return Path(name)
    if os.path.isfile(name):
        cure = "Name its folder. A downloaded checkpoint becomes one by `geodiff convert`."
        bad_value("prior", "'bundled', a folder or a hub id", f"the file {name}", cure)
    if name.count("/") > 1 or name.startswith((".", "/", "~")):
        bad_value("prior", "'bundled', a folder that is there, or a hub id", repr(name), "Check the path.")
    patterns, ignored = list(SMALL_FILES), None
    if weights and variant is None:
        patterns, ignored = patterns + WEIGHTS, OTHER_VARIANTS
    elif weights:
        patterns += [f"*.{variant}.safetensors", f"*.{variant}-*.safetensors"]
    expected = "'bundled', a folder or a hub id that is cached or can be reached"
    cure = "Fetch it once with `hf download ID` while online, give a folder, or use --prior bundled."
    with reading("prior", expected, repr(name), cure):
        folder = snapshot_download(name, allow_patterns=patterns, ignore_patterns=ignored, **hub)
    return Path(folder)


def check_weights(missing: Any, unexpected: Any, where: str) -> None:
    """Refuse weights in ``where`` that do not fit their module by a ``ValueError`` that lists their names."""
    named = {"missing": sorted(map(str, missing)), "unexpected": sorted(map(str, unexpected))}
    parts = [f"{label}: {', '.join(keys)}" for label, keys in named.items() if keys]
    if parts:
        cure = "These weights are of another architecture, or the file is damaged."
        bad_value(f"weights in {where}", "those of its config, name by name", "; ".join(parts), cure)


def _component_class(pipeline_class: type[Any], layout: Layout, name: str) -> type[Any]:
    """The class of a component, as ``model_index.json`` names it, out of ``LIBRARIES`` alone.

    In a pipeline of ours the constructor's annotation stands in for any other, and for a base class of it.
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
        cure = "Code that comes with weights is never run."
        bad_value(what, "a class of diffusers or transformers", repr(entry), cure)
    return named


def _annotated(pipeline_class: type[Any]) -> dict[str, type[Any]]:
    """Component classes by the names of a constructor's parameters; none of a pipeline of diffusers."""
    if pipeline_class.__module__.startswith("diffusers."):
        return {}
    classes = {}
    for name, hint in typing.get_type_hints(pipeline_class.__init__).items():
        for cls in (hint, *typing.get_args(hint)):  # with None it is optional
            if hasattr(cls, "from_pretrained"):
                classes[name] = cls
    return classes


def load_component(
    layout: Layout, name: str, cls: type[Any], dtype: torch.dtype, unread: str | None = None
) -> Any:
    """One component of a subfolder (``""``: the folder); a module's weights are checked name by name.

    With ``unread``, part of the names of weights that no forward reads, those may lack, and any be left over.
    """
    folder = str(layout.folder / name)
    damaged = reading(f"component {name or 'model'!r} of {layout.name}", "one that can be read", folder, CURE)
    options: dict[str, Any] = {"local_files_only": True}
    if cls.__module__.startswith("transformers."):  # which asks at the terminal where it is not told
        options["trust_remote_code"] = False
    if not (issubclass(cls, torch.nn.Module) or cls.__name__.startswith("AutoModel")):
        with damaged:
            return cls.from_pretrained(folder, **options)
    if not any((layout.folder / name).glob("*.safetensors")):
        cure = "`geodiff convert SRC DST` once makes such a folder of .bin, .ckpt or .pth."
        bad_value(f"weights in {folder}", "safetensors", "none of them", cure)
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
    """A pipeline from the components that its constructor names and the options that the index holds.

    ``options`` are arguments of the constructor that go before the folder's; ``None`` is left out.
    """
    arguments = {name: value for name, value in options.items() if value is not None}
    annotated = _annotated(cls)
    for name, parameter in list(inspect.signature(cls.__init__).parameters.items())[1:]:
        entry = layout.index.get(name)
        is_component = isinstance(entry, list) and entry[0] is not None
        if name in arguments:
            continue
        if is_component or (name in annotated and (layout.folder / name).exists()):
            arguments[name] = load_component(layout, name, _component_class(cls, layout, name), dtype)
        elif entry is not None and not isinstance(entry, list):
            arguments[name] = entry
        elif parameter.default is parameter.empty:
            bad_value(str(layout.folder), f"a folder with the component {name!r}", "none of that name")
    try:
        return cls(**arguments)
    except (AttributeError, KeyError, TypeError) as error:  # our own classes say what they refuse
        wrong = str(error)
    bad_value(str(layout.folder / "model_index.json"), f"the index of a {cls.__name__}", wrong, CURE)
