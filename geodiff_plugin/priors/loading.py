"""Strict loading: every weight has a place, every place a weight; errors of libraries in one sentence."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import diffusers
import torch
import transformers
from safetensors import SafetensorError

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.pipelines import direct_scheduler

__all__ = [
    "build_pipeline",
    "check_device",
    "check_finite",
    "check_weights",
    "component_class",
    "load_component",
    "reading",
]

#: What the libraries are known to raise over a damaged or foreign folder.
ERRORS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    ImportError,
    RuntimeError,  # RecursionError and torch's are among them
    SafetensorError,
)
LONGEST_REASON = 200


def _reason(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = lines[0] if lines else type(error).__name__
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}..."


@contextmanager
def reading(what: str, expected: str, got: str, cure: str) -> Iterator[None]:
    """Turn an error of a library into one sentence.

    Args:
        what: is read, the subject of the sentence.
        expected: of it.
        got: came instead; the library's own first line is added.
        cure: what to do.

    Raises:
        ValueError: in the place of anything in ``ERRORS``.
    """
    try:
        yield
    except ERRORS as error:
        reason = _reason(error)
    else:
        return
    bad_value(what, expected, f"{got} ({reason})", cure)


def check_finite(module: torch.nn.Module, where: str | Path) -> None:
    """Refuse weights with NaN or infinity in them, naming the first.

    Raises:
        ValueError: there is any.
    """
    for name, weight in module.named_parameters():
        if weight.numel() and weight.is_floating_point() and weight.device.type != "meta":
            low, high = weight.detach().aminmax()  # one pass; NaN comes through
            if not bool(torch.isfinite(low) & torch.isfinite(high)):
                cure = "The file is damaged, or was trained or converted so: fetch it anew."
                bad_value(f"weights in {where}", "finite", f"NaN or infinity in {name}", cure)


def check_device(device: str | torch.device) -> torch.device:
    """A device that this machine has.

    Raises:
        ValueError: it has not.
    """
    try:
        found = torch.device(device)
        torch.empty(1, device=found)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as error:
        reason = _reason(error)
    else:
        return found
    bad_value("device", "one that PyTorch has on this machine", f"{str(device)!r} ({reason})", "Try 'cpu'.")


#: Keys listed in an error before it says how many more there are.
LISTED_KEYS = 12
CURE = "Is a file of it cut off, or of another version? Save or fetch the folder anew."
LIBRARIES = {
    "diffusers": diffusers,
    "transformers": transformers,
    direct_scheduler.__name__: direct_scheduler,  # ours, and as small as a scheduler can be
}


def check_weights(missing: Any, unexpected: Any, where: str) -> None:
    """Refuse weights that do not fit, listing them.

    Args:
        missing: names that the module has and the file has not.
        unexpected: names that the file has and the module has not.
        where: the folder or file, for the message.

    Raises:
        ValueError: there is any.
    """
    parts = []
    for label, keys in (("missing", sorted(missing)), ("unexpected", sorted(unexpected))):
        if keys:
            more = f" and {len(keys) - LISTED_KEYS} more" if len(keys) > LISTED_KEYS else ""
            parts.append(f"{label}: {', '.join(map(str, keys[:LISTED_KEYS]))}{more}")
    if parts:
        cure = "These weights are of another architecture, or the file is damaged."
        bad_value(f"weights in {where}", "those of its config, name by name", "; ".join(parts), cure)


def component_class(layout: Layout, name: str) -> type[Any]:
    """The class of a component as ``model_index.json`` names it, out of diffusers or transformers.

    Raises:
        ValueError: not named, or of another library.
    """
    entry = layout.index.get(name)
    library, cls = entry if isinstance(entry, list) and len(entry) == 2 else ("", "")
    found = getattr(LIBRARIES.get(str(library)), str(cls), None)
    if not isinstance(found, type) or not hasattr(found, "from_pretrained"):
        bad_value(
            f"component {name!r} in {layout.folder / 'model_index.json'}",
            "a class of diffusers or transformers",
            repr(entry),
            "Code that comes with weights is never run.",
        )
    return found


def load_component(
    layout: Layout, name: str, cls: type[Any], dtype: torch.dtype, extra: dict[str, Any] | None = None
) -> Any:
    """One component of a folder; a module's weights are checked name by name, and it is in eval mode.

    Args:
        layout: of the folder.
        name: of the subfolder; ``""`` for the folder itself.
        cls: with ``from_pretrained``.
        dtype: of a module's weights.
        extra: further arguments of ``from_pretrained`` (a quantisation).

    Raises:
        ValueError: weights missing, left over, cut off or not finite; files that cannot be read.
    """
    folder = str(layout.folder / name)
    damaged = reading(f"component {name or 'model'!r} of {layout.name}", "one that can be read", folder, CURE)
    # Said aloud, since transformers asks at the terminal where it is not.
    untrusted = {"trust_remote_code": False} if cls.__module__.startswith("transformers.") else {}
    is_module = issubclass(cls, torch.nn.Module)
    if not is_module:
        with damaged:
            return cls.from_pretrained(folder, local_files_only=True, **untrusted)
    if not any((layout.folder / name).glob("*.safetensors")):
        cure = "`geodiff convert SRC DST` once makes such a folder of .bin, .ckpt or .pth."
        bad_value(f"weights in {folder}", "safetensors", "none of them", cure)
    options: dict[str, Any] = {"use_safetensors": True, "local_files_only": True} | (extra or {})
    if layout.variant is not None:
        options["variant"] = layout.variant
    with damaged:
        module, found = cls.from_pretrained(
            folder, dtype=dtype, output_loading_info=True, **options, **untrusted
        )
    if found.get("mismatched_keys"):
        check_weights((), [entry[0] for entry in found["mismatched_keys"]], folder)
    check_weights(found["missing_keys"], found["unexpected_keys"], folder)
    check_finite(module, folder)
    return module.eval()


def build_pipeline(
    cls: type[Any],
    layout: Layout,
    dtype: torch.dtype,
    classes: dict[str, type[Any]] | None = None,
    **options: Any,
) -> Any:
    """A pipeline from the components that its constructor names and the options that the index holds.

    Args:
        cls: pipeline class; its constructor's parameters are components and options.
        layout: of the folder.
        dtype: of the weights.
        classes: for components whose class is not what the index says.
        **options: constructor arguments, components too, that go before the folder's; ``None`` is left out.

    Raises:
        ValueError: a component that the folder lacks, weights that do not fit.
    """
    options = {name: value for name, value in options.items() if value is not None}
    arguments: dict[str, Any] = {}
    classes = classes or {}
    for name, parameter in list(inspect.signature(cls.__init__).parameters.items())[1:]:
        entry = layout.index.get(name)
        if name in options:
            arguments[name] = options[name]
        elif name in classes:
            arguments[name] = load_component(layout, name, classes[name], dtype)
        elif isinstance(entry, list) and entry[0] is not None:
            arguments[name] = load_component(layout, name, component_class(layout, name), dtype)
        elif entry is not None and not isinstance(entry, list):
            arguments[name] = entry
        elif parameter.default is parameter.empty:
            bad_value(str(layout.folder), f"a folder with the component {name!r}", "none of that name")
    try:
        return cls(**arguments)
    except (AttributeError, KeyError, TypeError) as error:  # our own classes say what they refuse
        wrong = str(error)
    bad_value(str(layout.folder / "model_index.json"), f"the index of a {cls.__name__}", wrong, CURE)
