"""Triton's interpreter within a process that has imported Triton without it."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import pytest


@contextmanager
def interpreted(name: str) -> Iterator[ModuleType]:
    """The module of kernels of that name; within the block kernels run on CPU tensors in the interpreter.

    Triton reads ``TRITON_INTERPRET`` when it is imported, and its own functions are compiled ones otherwise.
    So these are replaced within the block, and modules of kernels are imported again.
    """
    tl = pytest.importorskip("triton").language
    from triton.runtime.interpreter import InterpretedFunction
    from triton.runtime.jit import JITFunction

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_INTERPRET", "1")
        for owner in (tl, tl.standard, tl.math, tl.tensor):
            for attribute, value in list(vars(owner).items()):
                if isinstance(value, JITFunction):
                    patch.setattr(owner, attribute, InterpretedFunction(value.fn))
        for module in _kernel_modules():
            patch.delitem(sys.modules, module)
            patch.delattr(*_place_of(module), raising=False)
        try:
            yield importlib.import_module(name)
        finally:
            for module in _kernel_modules():
                del sys.modules[module]
                delattr(*_place_of(module))


def _kernel_modules() -> list[str]:
    """The modules of Triton kernels that are imported."""
    return [name for name in sys.modules if name.startswith("geodiff_plugin.") and ".kernels." in name]


def _place_of(module: str) -> tuple[ModuleType, str]:
    package, _, name = module.rpartition(".")
    return importlib.import_module(package), name
