"""Names of a package that are imported on first use, so that importing the package stays quick."""

from __future__ import annotations

import gc
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any


def modules_of(package: str, names_of: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """The module of every public name of a package; ``names_of`` has the names of each module."""
    return {name: f"{package}.{module}" for module, names in names_of.items() for name in names}


def importer(package: str, module_of: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package: it imports a name from its module and keeps it."""

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return get


def imported(where: str) -> Any:
    """Something of this package by its dotted name (``cli.info.run_info``), imported now."""
    module, _, name = where.rpartition(".")
    return getattr(importlib.import_module(f"geodiff_plugin.{module}"), name)


#: Whether ``uncollected`` has done so. (``gc.get_freeze_count`` would count the objects one by one.)
_left_out = False


@contextmanager
def uncollected() -> Iterator[None]:
    """Around the imports of a program: the garbage collector leaves out what the first ones make.

    They make half a million objects of torch and its relatives, which stay to the end of the process. The
    collector would look through them again and again, which takes a fifth of the time of the imports. This is
    only for processes of our own, such as a command's: what is garbage before the imports stays as well.
    """
    global _left_out
    if _left_out or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
        gc.freeze()
        _left_out = True
    finally:
        gc.enable()
