"""Names of a package that are imported on first use, so that importing the package stays quick."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def modules_of(package: str, names_of: Mapping[str, str]) -> dict[str, str]:
    """The module of every public name; ``names_of`` has a module's names, separated by blanks."""
    return {name: f"{package}.{module}" for module, names in names_of.items() for name in names.split()}


def importer(package: str, module_of: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package: it imports a name from its module and keeps it."""

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return get
