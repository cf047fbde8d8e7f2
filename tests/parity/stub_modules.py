"""Empty modules in the place of packages that the authors' code imports and does not need."""

import sys
import types
from importlib.machinery import ModuleSpec
from typing import Any


def install(contents: dict[str, dict[str, Any]]) -> None:
    """Put modules into ``sys.modules``, each also as an attribute of its parent.

    Args:
        contents: dotted name -> attributes of the module; parents first.
    """
    for name, content in contents.items():
        module = types.ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)  # diffusers looks for it
        module.__dict__.update(content)
        module.__path__ = []
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
