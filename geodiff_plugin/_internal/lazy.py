"""Import names of a package on first use, so that importing the package is fast."""

from __future__ import annotations

import atexit
import gc
import importlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any

#: Pattern of an import for type checkers, ``from module import name as name``, below ``if TYPE_CHECKING``.
_DECLARED = re.compile(r"^    from (\S+) import (\w+) as \2\r?$", re.MULTILINE)


def declared(package: str) -> dict[str, str]:
    """Map the public names of a package, which it imports for type checkers, to their modules.

    A package therefore lists its names only once, visible to type checkers. The source is searched with a
    regular expression, which takes a hundredth of the time of parsing it.
    """
    spec: Any = sys.modules[package].__spec__
    source = spec.loader.get_data(spec.origin).decode()
    return {name: module for module, name in _DECLARED.findall(source)}


def importer(package: str, module_of: Mapping[str, str]) -> Callable[[str], Any]:
    """Create the ``__getattr__`` of a package, which imports a name from its module and caches it."""

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return get


def imported(where: str) -> Any:
    """Import an object of this package by its dotted name (``cli.info.run_info``)."""
    module, _, name = where.rpartition(".")
    return getattr(importlib.import_module(f"geodiff_plugin.{module}"), name)


#: Package that diffusers and transformers import if it is installed. This package loads no LoRA weights.
NOT_NEEDED = "peft"
#: Module that diffusers' schedulers import for one of their options.
RARELY_USED = "scipy.stats"


class _StandIn(ModuleType):
    """Takes the place of a module until it is used, and imports it then."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # of ``inspect``, which looks at all modules
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


@contextmanager
def fewer_imports() -> Iterator[None]:
    """Import diffusers without two of its imports that commands do not need, a fifth of its import time.

    Inside the block, ``NOT_NEEDED`` counts as not installed. ``RARELY_USED`` is imported when it is used,
    also after the block, because diffusers imports further schedulers when it loads one. Use it only in
    processes of this package, such as commands: diffusers could not load LoRA weights.
    """
    if RARELY_USED not in sys.modules:
        sys.modules[RARELY_USED] = _StandIn(RARELY_USED)
    if NOT_NEEDED in sys.modules:
        yield
        return
    sys.modules[NOT_NEEDED] = None  # type: ignore[assignment]  # cannot be imported
    try:
        yield
    finally:
        del sys.modules[NOT_NEEDED]


#: Whether ``gc_frozen`` has frozen the garbage collector. ``gc.get_freeze_count`` is slow.
_frozen = False


def _unfrozen_for_nanobind() -> None:
    """Unfreeze the types of Triton from 3.9 on at exit: its bindings (nanobind) report frozen ones as leaked.

    Without such bindings nothing is done, because the collection of all frozen objects takes about a second.
    """
    bindings: Any = sys.modules.get("triton._C.libtriton")
    module = getattr(getattr(bindings, "ir", None), "module", None)
    if type(module).__module__ == "nanobind":
        gc.unfreeze()


@contextmanager
def gc_frozen() -> Iterator[None]:
    """Exclude the objects that a program's first imports create from garbage collection.

    Importing torch and related packages creates half a million objects that live until the process ends.
    Without this, the collector traverses them repeatedly, which takes a fifth of the import time. Use it only
    in processes of this package, such as commands, because garbage from before the imports is kept, too.
    """
    global _frozen
    if _frozen or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
        gc.freeze()
        atexit.register(_unfrozen_for_nanobind)
        _frozen = True
    finally:
        gc.enable()
